"""The record of a folder of fitted models: their detector and sensor, the parts, and which of the parts are used."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from os import PathLike
from pathlib import Path
from typing import Self

from semfov.errors import DataError, check_data
from semfov.io.compatibility import Settings
from semfov.io.files import JsonObject, inside, read_json, sha256, write_text
from semfov.io.schema import CLASSES, Array, Flag, Json, Maybe, Number, Object, Text, check_content
from semfov.io.storage import check_version, checksum
from semfov.version import __version__

FILE = "manifest.json"
_KIND = "semfov-models"
_MOST_BYTES = 2**24

PARTS = ("observation", "search", "verification", "windows")
"""Parts that a folder may hold, in the order in which they are fitted."""

_PLACE = Object({"relative": Text(), "absolute": Text()}, required=("relative", "absolute"))


_PART = Object(
    {"file": Maybe(Text()), "sha256": Maybe(Text()), "used": Flag(), "why": Text(), "settings": Object(others=Json())},
    required=("file", "sha256", "used", "why", "settings"),
)
_RECORD = {
    "kind": Text((_KIND,)),
    "version": Text(),
    "classes": CLASSES,
    "detector": Object(
        {
            "name": Text(),
            "sha256": Text(),
            "model": Maybe(Text()),
            "model_file": Maybe(_PLACE),
            "weights_file": Maybe(_PLACE),
            "options": Object(others=Json()),
        },
        required=("name", "sha256", "options"),
    ),
    # Further values depend on the sensor, which checks them when it is made.
    "sensor": Object({"name": Text(), "reference": Number(above=0)}, Json(), ("name", "reference")),
    "grid": Array(Number(1, 200), 2),
    "parts": Object(dict.fromkeys(PARTS, _PART)),
    "training": Object(others=Json()),
}


@dataclass(frozen=True)
class Part:
    """One fitted part of an agent.

    Attributes:
        file: name of its file in the folder; None for a part that was not fitted.
        sha256: of the file.
        used: whether the agent uses it.
        why: why it is used or not, in words.
        settings: JSON values of the fit.
    """

    file: str | None
    sha256: str | None
    used: bool
    why: str
    settings: JsonObject = field(default_factory=dict)


@dataclass(frozen=True)
class Manifest:
    """The record that a folder of fitted models keeps about itself.

    Attributes:
        classes: names of the detector's classes.
        detector: its name, file and options.
        sensor: settings of the sensor.
        grid: columns and rows.
        parts: the parts by name (`PARTS`).
        training: JSON values of the fit.
    """

    classes: tuple[str, ...]
    detector: Settings
    sensor: Settings
    grid: tuple[int, int]
    parts: Mapping[str, Part]
    training: JsonObject = field(default_factory=dict)

    def write(self, folder: str | PathLike[str]) -> Path:
        """Write the record into the folder atomically, and return the path of its file."""
        record = {"kind": _KIND, "version": __version__, **json.loads(json.dumps(asdict(self)))}
        path = Path(folder) / FILE
        write_text(path, json.dumps({**record, "sha256": checksum({}, record)}, indent=2) + "\n")
        return path

    @classmethod
    def read(cls, folder: str | PathLike[str]) -> Self:
        """Read the record of a folder, and verify it and the files that it names by their checksums."""
        record = _read_record(Path(folder) / FILE)
        parts = {name: Part(**part) for name, part in record["parts"].items()}
        for part in parts.values():
            _check_file(part, Path(folder))
        columns, rows = record["grid"]
        return cls(
            classes=tuple(record["classes"]),
            detector=record["detector"],
            sensor=record["sensor"],
            grid=(columns, rows),
            parts=parts,
            training=record["training"],
        )


_AGAIN = "run semfov fit again, or copy the folder again"


def _read_record(path: Path) -> JsonObject:
    """Read the record of a folder, and verify its checksum, its version and its values."""
    if path.parent.is_file():
        is_detector = path.parent.suffix in (".onnx", ".cfg")
        remedy = f"; a detector is given as detector='{path.parent}'" if is_detector else ""
        raise DataError(
            f"{path.parent}: expected {_expected_folder(path.parent)}, or the .safetensors of one, got a file{remedy}"
        )
    if not path.exists():
        raise DataError(f"{path}: no such file; expected {_expected_folder(path.parent)}")
    record: JsonObject = read_json(path, most=_MOST_BYTES)
    check_data(isinstance(record, dict), path, "an object", f"{type(record).__name__}; {_AGAIN}")
    recorded = record.pop("sha256", None)
    if recorded != checksum({}, record):
        raise DataError(f"{path}: damaged or changed, its sha256 is not the one it was written with; {_AGAIN}")
    check_version(path, record)
    check_content(path, record, Object(_RECORD, Json(), tuple(_RECORD)))
    return record


def _expected_folder(folder: Path) -> str:
    """Write which folder is expected, and what another one holds that fits also write."""
    expected = "a folder of models that semfov fit wrote"
    gaze = folder / "gaze.safetensors"
    if not gaze.is_file():
        return expected
    return f"{expected} with --data.root, got only a model of where people look (`semfov gaze --model {gaze}`)"


def _check_file(part: Part, folder: Path) -> None:
    """Raise `DataError` unless the file of a part is the one that the record lists."""
    if part.file is None:
        return
    file = inside(folder, part.file)
    if sha256(file, f"{file}, which {FILE} lists") != part.sha256:
        raise DataError(f"{file}: damaged or changed, its sha256 is not the one listed in {FILE}; {_AGAIN}")

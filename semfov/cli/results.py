"""Files of results: JSON, JSON lines, CSV, GeoJSON and COCO, written while pictures are looked at, and their list."""

import json
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TextIO

from semfov.cli.sources import PictureSource
from semfov.cli.truth import Truth
from semfov.errors import DataError, check
from semfov.io.code import package_digest
from semfov.io.files import write_text, written_alone
from semfov.io.tables import csv_text
from semfov.paths.conversion import COLUMNS
from semfov.runs.results import SceneResults
from semfov.runs.scene_run import digest_of

_RESULT_KINDS = (".coco.json", ".json", ".jsonl", ".csv", ".geojson")  # ends of the names of files of results
_SHARE = 0.05  # of the time may be spent on writing results that are not complete yet
STDOUT = Path("-")  # standard output in place of a file of results, which takes JSON lines

_BOX = ("x1", "y1", "x2", "y2")
_DECISIONS = ("picture", "target", "outcome", "probability", "x", "y", *_BOX, "passes", "seconds", "error")

_EXPECTED = ("expected", "expected_error")
_OBJECTS = ("picture", "width", "height", *COLUMNS, *_EXPECTED, "error")


def kind_of(path: Path) -> str | None:
    """The kind of a file of results by its name; None for a folder."""
    if path == STDOUT:
        return ".jsonl"
    name = path.name.lower()
    kind = next((kind for kind in _RESULT_KINDS if name.endswith(kind)), None)
    fits = kind is not None or not path.suffix or path.is_dir()
    check(fits, "out", f"a folder, or a file that ends in {', '.join(_RESULT_KINDS)}", path)
    return kind


class ResultsFile:
    """A file of results that is complete for the pictures so far, whenever the command ends."""

    def __init__(self, path: Path, kind: str, *, searched: bool, stream: TextIO, truth: Truth | None = None) -> None:
        self.path, self.kind, self.searched, self.truth = path, kind, searched, truth
        self._rows: dict[int, dict[str, Any]] = {}
        self._due = 0.0
        self._stream = stream if path == STDOUT else None
        if kind == ".jsonl" and self._stream is None:
            write_text(path, "")

    def add(self, number: int, row: dict[str, Any]) -> None:
        """Add a picture, or one that could not be read, with its `error`."""
        self._rows[number] = row
        if self.kind != ".jsonl":
            if time.monotonic() >= self._due:
                self.write()
            return
        line = json.dumps(row["picture"], ensure_ascii=self._stream is not None) + "\n"
        if self._stream is not None:  # which may have another encoding
            self._stream.write(line)
            self._stream.flush()
            return
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line)
        except OSError as error:
            raise DataError(f"cannot write {self.path}: {error.strerror or error}") from error

    def write(self) -> None:
        """Write the file, atomically."""
        if self.kind == ".jsonl":
            return
        began = time.monotonic()
        write_text(self.path, self._text())
        took = time.monotonic() - began
        self._due = began + took / _SHARE

    def precision(self) -> str:
        """AP and AP50 of the objects against the annotations, in words."""
        assert self.truth is not None
        rows = [row for row in self._rows.values() if "error" not in row["picture"]]
        classes = {name for row in rows for name in row["classes"]}
        results = [part for row in rows for part in row["parts"]]
        return self.truth.judge(results, [row["image_id"] for row in rows], classes)

    def _text(self) -> str:
        every = [self._rows[number] for number in sorted(self._rows)]
        rows = [row for row in every if "error" not in row["picture"]]
        pictures = [row["picture"] for row in rows]
        skipped = [row["picture"] for row in every if "error" in row["picture"]]
        whole: dict[str, Any] = {"pictures": pictures, "skipped": skipped}
        if self.kind == ".csv":
            listed = [row["picture"] for row in every]
            table = listed if self.searched else [row for each in listed for row in _object_rows(each)]
            turned = ("pan", "tilt") if any("pan" in row for row in table) else ()
            columns = _DECISIONS if self.searched else (*_OBJECTS, *turned)
            return csv_text([columns, *([row.get(name) for name in columns] for row in table)])
        if self.kind == ".geojson":
            unit = rows[0]["coordinates"] if rows else ""
            features = [each for row in rows for each in row["parts"]]
            whole = {"type": "FeatureCollection", "coordinates": unit, "features": features, "skipped": skipped}
        elif self.truth is not None:
            return json.dumps([each for row in rows for each in row["parts"]], indent=1) + "\n"
        elif self.kind == ".coco.json":
            images = [
                {"id": number, "file_name": each["picture"], "width": each["width"], "height": each["height"]}
                for number, each in enumerate(pictures, 1)
            ]
            objects = [{**each, "image_id": number} for number, row in enumerate(rows, 1) for each in row["parts"]]
            annotations = [{"id": number, **each} for number, each in enumerate(objects, 1)]
            categories = rows[0]["categories"] if rows else []
            whole = {"images": images, "annotations": annotations, "categories": categories, "skipped": skipped}
        return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def _object_rows(picture: dict[str, Any]) -> list[dict[str, Any]]:
    """A row for each object, and one without an object for each class that has none, or for a picture without any."""
    if "error" in picture:
        return [picture]
    rows = picture["objects"]
    seen = {row["class"] for row in rows}
    missing = [name for name in picture["targets"] if name not in seen] or ([] if rows else [None])
    whole = {name: picture[name] for name in ("picture", "width", "height")}
    numbers = picture["expected"], picture["expected_error"]
    return [
        {**whole, **row, **{name: of.get(row["class"]) for name, of in zip(_EXPECTED, numbers, strict=True)}}
        for row in [*rows, *({"class": name} for name in missing)]
    ]


def held_outputs(options: Any) -> AbstractContextManager[None]:
    """Hold all that the options name to write, in a block that is refused while another command writes any of it."""
    named = [getattr(options, name, None) for name in ("out", "report", "crops", "labels")]
    outputs = [path for path in named if path is not None and path != STDOUT]
    folders = [path for path in outputs if path.is_dir() or not path.suffix]
    return written_alone([path for path in outputs if path not in folders], folders)


def unfinished(file: Path, depends_on: Mapping[str, Any], sources: Sequence[PictureSource]) -> SceneResults:
    """What a command has finished, beside its file: of pictures that are the same, with all that it depends on."""
    key = digest_of([depends_on, package_digest()])[:32]
    versions = [json.dumps(source.version()) for source in sources]
    return SceneResults(file.with_name(f"{file.name}.unfinished"), key, versions.__getitem__)


def tell_written(files: Sequence[object], finished: SceneResults | None, part: str | None) -> None:
    """List the files of a command; what it has finished is kept until it is done, else it says which part that is."""
    if files:
        print("written:", *(f"  {path}" for path in files), sep="\n")
    if finished is None:
        return
    finished.flush()
    if part is None:
        shutil.rmtree(finished.path.parent, ignore_errors=True)
    else:
        print(f"{part} pictures were looked at; the same command continues", file=sys.stderr)

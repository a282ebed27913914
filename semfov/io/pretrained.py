"""Fitted modules that are saved to files; those that are shipped with the package, and the command that fits others."""

from abc import abstractmethod
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from shlex import quote
from typing import Any, ClassVar, Self

from torch import Tensor

from semfov.attribute_words import MODEL, missing
from semfov.errors import DataError, InputError, check, lookup, reason_of
from semfov.io.compatibility import Settings, check_grid, check_same_detector, check_sensor
from semfov.io.files import JsonObject
from semfov.io.schema import Json, Object, Schema, Text
from semfov.io.state import StatedModule, without_settings
from semfov.io.storage import checksum, read, write_file
from semfov.threads import one_thread
from semfov.version import __version__

_COMMON = ("kind", "version", "metadata")  # values of every record
_PICKLED = (".pt", ".pth", ".bin", ".ckpt")  # suffixes of what torch saves, which may run code when it is read
_STATED = ("classes", "edges", "epsilon", "layers")  # values that are compared where a state is loaded
_METADATA = Object({"detector": Object(others=Json()), "sensor": Object(others=Json())}, Json())
"""Metadata of a model, which people and `semfov.io.compatibility` read."""

_ENVELOPE = Schema({}, {"version": Text(), "metadata": _METADATA})


class Pretrained(StatedModule):
    """Base of modules that are saved to a file: tensors, and JSON values that describe them.

    Attributes:
        kind: name of the kind of file.
        title: what the module is, in words.
        shipped: folder of the models that are shipped with the package.
        schema: requirements of a file.
        data: options of `semfov fit` that name what the module is fitted to.
        other_words: words of other libraries, with ours.
        metadata: JSON values kept with the model.
    """

    kind: ClassVar[str]
    title: ClassVar[str]
    shipped: ClassVar[Path]
    schema: ClassVar[Schema]
    data: ClassVar[str] = "--data.root PHOTOS --data.annotations instances.json"
    other_words: ClassVar[Mapping[str, str]] = MODEL
    metadata: JsonObject

    @abstractmethod
    def _record(self) -> dict[str, object]:
        """List the JSON values that `_restore` needs in addition to tensors and metadata."""

    def _tensors(self) -> dict[str, Tensor]:
        """List the tensors that are saved."""
        return without_settings(self.state_dict())

    def _stated(self) -> dict[str, object]:
        """Select the values of the record that tell what the numbers are of."""
        return {name: value for name, value in self._record().items() if name in _STATED}

    @classmethod
    @abstractmethod
    def _restore(cls, record: JsonObject, tensors: dict[str, Tensor]) -> Self:
        """Make the module from a record and tensors; raise any error where something is missing or does not fit."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write the model atomically to a safetensors file, with its metadata as JSON in the header."""
        record = {"kind": self.kind, "version": __version__, **self._record(), "metadata": self.metadata}
        write_file(path, self._tensors(), record)

    def __getattr__(self, name: str) -> Any:
        """Find a part of the module; words of other libraries are refused with ours."""
        if name in self.other_words:
            raise missing(f"this {self.title}", name, self.other_words)
        return super().__getattr__(name)

    def digest(self) -> str:
        """sha256 of everything that results depend on: tensors, and the values that are needed to make the model."""
        return checksum(self._tensors(), {"kind": self.kind, **self._record()})

    @classmethod
    def from_pretrained(cls, name_or_path: str | PathLike[str]) -> Self:
        """Load a model that is shipped with the package or one that `save` wrote.

        Args:
            name_or_path: name of a shipped model, or path of a file.

        Returns:
            The model, in `eval` mode.

        Raises:
            InputError: no model of that name is shipped.
            DataError: the file is missing, damaged or of another kind.
        """
        path = Path(name_or_path)
        if path.suffix in _PICKLED:
            expected = f"a shipped {cls.title} by name, or a .safetensors file that save() wrote"
            remedy = "load_state_dict(torch.load(FILE, weights_only=True)) reads states of torch"
            raise InputError(f"name_or_path: expected {expected}, got {path}; {remedy}")
        is_name = path.suffix != ".safetensors" and len(path.parts) < 2
        if is_name:
            names = sorted(file.stem for file in cls.shipped.glob("*.safetensors"))
            name = lookup(str(name_or_path), names, cls.title)
            path = cls.shipped / f"{name}.safetensors"
        tensors, record = read(path, cls.kind)
        try:
            with one_thread():  # the first picture waits for dozens of small checks
                cls._check_content(tensors, record)
                model = cls._restore(record, tensors)
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError, InputError) as error:
            # Its checksum is right, so that the file is as it was written.
            command = fit_again_command(record.get("metadata"), cls.data)
            again = f"if another version of semfov wrote it, fit it again: {command}"
            raise DataError(f"{path}: not a complete {cls.title} ({reason_of(error)}); {again}") from None
        return model.eval()

    @classmethod
    def _check_content(cls, tensors: Mapping[str, Tensor], record: Mapping[str, object]) -> None:
        """Raise `InputError` unless tensors and record meet the requirements of this kind of file."""
        values = {name: value for name, value in record.items() if name not in _COMMON}
        _ENVELOPE.check({}, record)
        cls.schema.check(tensors, values)
        unknown = values.keys() - cls.schema.record.keys()
        check(not unknown, "record", f"no other values than {', '.join(cls.schema.record)}", sorted(unknown))

    @classmethod
    def if_shipped(cls, name: str) -> Self | None:
        """Load a model that is shipped with the package; None if none of this name is."""
        return cls.from_pretrained(name) if (cls.shipped / f"{name}.safetensors").is_file() else None


class PretrainedForEye(Pretrained):
    """Base of models that were fitted for one eye; `metadata` holds the settings of its `detector` and `sensor`."""

    def check_compatible(self, settings: Settings, grid: tuple[int, int] | None = None) -> None:
        """Raise `InputError` for another detector or a very different grid; warn where other settings differ."""
        if grid is not None:
            check_grid(self.metadata.get("training", {}), grid, self.title)
        check_same_detector(self.metadata.get("detector", {}), settings["detector"], self.title)
        check_sensor(self.metadata.get("sensor", {}), settings["sensor"], self.title)


def fit_command(model: str = "MODEL", data: str = Pretrained.data, out: str = "mymodels") -> str:
    """Write the command that fits all models to a detector.

    Args:
        model: the detector.
        data: options that name what they are fitted to.
        out: folder of the models.

    Returns:
        The command, for a shell.
    """
    return f"semfov fit {quote(model)} {data} --out {quote(out)}"


def fit_again_command(metadata: object, data: str = Pretrained.data) -> str:
    """Write the command that fits all models again to the detector of a fitted model.

    Args:
        metadata: metadata of the model, which a stranger may have written.
        data: options that name what they are fitted to.

    Returns:
        The command. It names a published detector; of any other one the metadata have the name, and not the file.
    """
    from semfov.detection.weights import WEIGHTS

    detector = metadata.get("detector") if isinstance(metadata, dict) else None
    name = detector.get("name") if isinstance(detector, dict) else None
    model = name if isinstance(name, str) and name in WEIGHTS else "MODEL.onnx"
    return fit_command(model, data)


def shipped_model(kind: type[Pretrained], name: str, detector: str, model: str) -> str:
    """Find the name under which a kind of model is shipped.

    Args:
        kind: the kind.
        name: name of the model: that of the detector, with an ending for models of one purpose.
        detector: name of the detector.
        model: the detector as the command of a fit names it.

    Returns:
        The name.

    Raises:
        InputError: none is shipped; the message has the command that fits one.
    """
    if (kind.shipped / f"{name}.safetensors").is_file():
        return name
    ending = name.removeprefix(detector)
    stems = sorted(path.stem.removesuffix(ending) for path in kind.shipped.glob(f"*{ending}.safetensors"))
    # Without an ending there are those of other purposes among them.
    beginnings = tuple(f"{stem}-" for stem in stems)
    names = [stem for stem in stems if not stem.startswith(beginnings)]
    raise InputError(
        f"detector: no {kind.title} is shipped for {detector!r}, only for {', '.join(names)}; without a fit use "
        f"ActivePerception.raw, or fit all models to it with `{fit_command(model)}` or semfov.fit_detector, and load "
        "them with ActivePerception.from_pretrained('mymodels')"
    )

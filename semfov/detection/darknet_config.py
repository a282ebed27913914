"""Darknet cfgs, the sections that describe a network layer by layer: read from a file, or of a published YOLOv3."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from os import PathLike
from typing import NamedTuple, TypeVar

from semfov.errors import DataError, check_data
from semfov.io.files import read_text
from semfov.io.schema import excerpt

_MOST_BYTES = 2**20
_T = TypeVar("_T", int, float)


class Section(NamedTuple):
    """One `[kind]` section of a cfg: a layer, or `[net]`, which comes first.

    Attributes:
        kind: what stands in the brackets.
        options: values by key, as text.
        where: file and line, for messages.
    """

    kind: str
    options: Mapping[str, str]
    where: str = "cfg"

    def check(self, condition: bool, expected: str, got: object, key: str = "") -> None:
        """Raise `DataError` with the place of the section, and of a key in it, unless a condition holds."""
        check_data(condition, f"{self.where}: [{self.kind}] {key}".rstrip(), expected, got)

    def text(self, key: str, default: str | None = None) -> str:
        """Read the value of `key` as text; a key without a default is required."""
        value = self.options.get(key, default)
        self.check(value is not None, f"the key {key!r}", "none")
        return str(value)

    def integers(self, key: str, default: str | None = None) -> tuple[int, ...]:
        """Read the value of `key` as a list of whole numbers."""
        return self._values(int, key, default, "whole numbers")

    def numbers(self, key: str, default: str | None = None) -> tuple[float, ...]:
        """Read the value of `key` as a list of finite numbers."""
        return self._values(float, key, default, "finite numbers")

    def integer(self, key: str, default: int | None = None, *, minimum: int = 1) -> int:
        """Read the value of `key` as one whole number, at least `minimum`."""
        expected = f"one whole number of at least {minimum}"
        text = None if default is None else str(default)
        values = self._values(int, key, text, expected)
        is_valid = len(values) == 1 and values[0] >= minimum
        self.check(is_valid, expected, excerpt(self.options.get(key)), key)
        return values[0]

    def _values(self, kind: Callable[[str], _T], key: str, default: str | None, expected: str) -> tuple[_T, ...]:
        text = self.text(key, default)
        values: tuple[_T, ...] = ()
        finite = False
        with suppress(ValueError):
            values = tuple(kind(part) for part in text.split(",") if part.strip())
            finite = all(0 * value == 0 for value in values)  # also of whole numbers that no float can hold
        self.check(finite, expected, excerpt(text), key)
        return values


def _parse_cfg(text: str, source: str = "cfg") -> list[Section]:
    """Parse the text of a cfg.

    Where a key is repeated in a section, the first value counts, as in Darknet.
    """
    sections: list[Section] = []
    options: dict[str, str] = {}
    for number, raw in enumerate(text.splitlines(), start=1):
        # Darknet, too, ignores all white space, also within a line.
        line = "".join(raw.split())
        where = f"{source}:{number}"
        if not line or line.startswith(("#", ";")):
            continue
        if line.startswith("[") and line.endswith("]"):
            options = {}
            sections.append(Section(line[1:-1], options, where))
            continue
        key, is_option, value = line.partition("=")
        if not is_option or not sections:
            raise DataError(f"{where}: expected [section] or key=value, got {raw.strip()[:60]!r}")
        options.setdefault(key, value)
    return sections


def read_cfg(path: str | PathLike[str]) -> list[Section]:
    """Read a cfg.

    Args:
        path: the file.

    Returns:
        Its sections, `[net]` first.

    Raises:
        DataError: the file cannot be read, or a line is neither a section nor a key with its value.
    """
    return _parse_cfg(read_text(path, most=_MOST_BYTES), str(path))


_ANCHORS = "10,13, 16,30, 33,23, 30,61, 62,45, 59,119, 116,90, 156,198, 373,326"
_TINY_ANCHORS = "10,14, 23,27, 37,58, 81,82, 135,169, 344,319"


def _yolov3(classes: int = 80, size: int = 416, pyramid: Sequence[Section] = ()) -> list[Section]:
    """Describe YOLOv3: Darknet-53 and heads at strides 32, 16 and 8 on a square input; 75 convolutions."""
    sections = [_section("net", width=size, height=size, channels=3), _convolution(32, 3)]
    stage_ends = []
    for filters, blocks in ((64, 1), (128, 2), (256, 8), (512, 8), (1024, 4)):
        sections.append(_convolution(filters, 3, stride=2))
        sections += [
            _convolution(filters // 2, 1),
            _convolution(filters, 3),
            _section("shortcut", **{"from": -3}, activation="linear"),
        ] * blocks
        stage_ends.append(len(sections) - 2)  # minus 2, because [net] is not a layer
    lateral = {256: stage_ends[3], 128: stage_ends[2]}  # stages that the finer heads read as well
    for width, mask in ((512, "6,7,8"), (256, "3,4,5"), (128, "0,1,2")):
        coarsest = width not in lateral
        if not coarsest:
            sections += [
                _section("route", layers="-4"),
                _convolution(width, 1),
                _section("upsample", stride=2),
                _section("route", layers=f"-1,{lateral[width]}"),
            ]
        sections += [_convolution(width, 1), _convolution(2 * width, 3), _convolution(width, 1)]
        if coarsest:
            sections += pyramid
        sections += [_convolution(2 * width, 3), _convolution(width, 1), _convolution(2 * width, 3)]
        sections += _head(mask, _ANCHORS, classes)
    return sections


def _yolov3_spp(classes: int = 80) -> list[Section]:
    """Describe YOLOv3-spp: YOLOv3 with parallel max pools of sizes 5, 9 and 13 before the first head, at 608 x 608."""
    pyramid = [
        _section("maxpool", size=5, stride=1),
        _section("route", layers="-2"),
        _section("maxpool", size=9, stride=1),
        _section("route", layers="-4"),
        _section("maxpool", size=13, stride=1),
        _section("route", layers="-1,-3,-5,-6"),
        _convolution(512, 1),
    ]
    return _yolov3(classes, 608, pyramid)


def _yolov3_tiny(classes: int = 80) -> list[Section]:
    """Describe YOLOv3-tiny: seven convolutions with max pools, and heads at strides 32 and 16."""
    backbone = []
    for filters in (16, 32, 64, 128, 256):
        backbone += [_convolution(filters, 3), _section("maxpool", size=2, stride=2)]
    coarse = [
        _convolution(512, 3),
        _section("maxpool", size=2, stride=1),
        _convolution(1024, 3),
        _convolution(256, 1),
        _convolution(512, 3),
        *_head("3,4,5", _TINY_ANCHORS, classes),
    ]
    fine = [
        _section("route", layers="-4"),
        _convolution(128, 1),
        _section("upsample", stride=2),
        _section("route", layers="-1,8"),
        _convolution(256, 3),
    ]
    return [
        _section("net", width=416, height=416, channels=3),
        *backbone,
        *coarse,
        *fine,
        *_head("1,2,3", _TINY_ANCHORS, classes),  # others have 0,1,2, which the published weights do not fit
    ]


ARCHITECTURES: dict[str, Callable[..., list[Section]]] = {
    "yolov3": _yolov3,
    "yolov3-tiny": _yolov3_tiny,
    "yolov3-spp": _yolov3_spp,
}
"""Sections of the published networks, by name."""


def _section(kind: str, **options: int | str) -> Section:
    """Make a section of a built-in cfg."""
    return Section(kind, {key: str(value) for key, value in options.items()}, "built-in cfg")


def _convolution(filters: int, size: int, stride: int = 1) -> Section:
    """Make the section of a convolution with batch norm."""
    return _section(
        "convolutional", batch_normalize=1, filters=filters, size=size, stride=stride, pad=1, activation="leaky"
    )


def _head(mask: str, anchors: str, classes: int) -> list[Section]:
    """Make the sections of a head: the convolution of its map, and the decoding of the anchors in `mask`."""
    filters = len(mask.split(",")) * (5 + classes)
    maps = _section("convolutional", filters=filters, size=1, stride=1, pad=1, activation="linear")
    return [maps, _section("yolo", mask=mask, anchors=anchors, classes=classes)]

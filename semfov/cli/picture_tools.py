"""What `semfov mcp` offers a language model: searches, crops and gaze in the pictures below one folder."""

import math
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Concatenate, NamedTuple, ParamSpec, TypeVar

import torch
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.cli.options import CheckOptions
from semfov.data.large import open_large
from semfov.data.picture_files import picture_files
from semfov.data.windowed import resized
from semfov.errors import DataError, check, printable
from semfov.paths import Record
from semfov.report.episode import jpeg

MOST_PASSES = 64
"""Largest number of passes of the detector in one answer."""

_SECONDS = 60.0  # longest time of one answer
_MOST_PICTURES = 1000  # names in one answer
_WIDEST = 4096  # longest side in pixels of the picture of which a crop is shown: a wider one is seen by `find`
_SIDE = 1024  # longest side in pixels of a crop that is shown
_SMALLEST = 8  # shortest side in pixels of the picture of which a crop is shown
_MAGNIFIED = 4.0  # largest magnification of a crop
_QUALITY = 90  # of its JPEG

_Arguments = ParamSpec("_Arguments")
_Answer = TypeVar("_Answer")


@dataclass(frozen=True)
class Found:
    """An object: its class, its box in pixels of the picture, and how sure it is.

    `probability` is that it is there. Where none was learned it is None, and `score` has what the detector gave.
    """

    name: str
    probability: float | None
    score: float | None
    box: list[float]


@dataclass(frozen=True)
class Answer:
    """The answer of a search or a find.

    `result` says it in words, and `ended` why no further look was taken. `probability` is that the picture holds the
    target of a search; where none was learned it is None, and `score` has the number of its belief, or the detector's.
    `expected` has the number of objects of each class that is expected in all, also where nobody looked, and `further`
    that of those which are not listed yet: what further looks can bring. Both are None for a class whose number is not
    known, and empty for a search, whose looks count nothing.
    """

    result: str
    ended: str
    probability: float | None
    score: float | None
    objects: list[Found]
    expected: dict[str, float | None]
    further: dict[str, float | None]
    passes: int
    size: list[int]


@dataclass(frozen=True)
class Peak:
    """A place that people look at: its pixel, and the share of fixations near it."""

    x: float
    y: float
    share: float


@dataclass(frozen=True)
class Gaze:
    """Where people look: the places in the order of their shares, and what speaks against the prediction."""

    result: str
    places: list[Peak]
    caution: str | None
    size: list[int]


class View(NamedTuple):
    """A crop: its JPEG, its box in the picture, and what the detector shows in it."""

    jpeg: bytes
    box: tuple[int, int, int, int]
    objects: list[Found]


def _one_at_a_time(
    method: Callable[Concatenate["PictureTools", _Arguments], _Answer],
) -> Callable[Concatenate["PictureTools", _Arguments], _Answer]:
    """Let calls wait for each other: the agent looks at one picture at a time."""

    @wraps(method)
    def call(self: "PictureTools", /, *arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Answer:
        with self._lock:
            return method(self, *arguments, **options)

    return call


class PictureTools:
    """Tools that look at the pictures below a folder, and at nothing else.

    Args:
        folder: the folder.
        agent: the agent that looks.

    Raises:
        DataError: there is no such folder.
    """

    def __init__(self, folder: Path, agent: ActivePerception) -> None:
        if not folder.is_dir():
            raise DataError(f"folder: expected a folder with pictures, got {printable(str(folder))}")
        self.folder = folder.resolve()
        self.agent = agent
        self._lock = threading.Lock()

    @_one_at_a_time
    def pictures(self) -> list[str]:
        """List the pictures by their names, which are paths from the folder; at most a thousand."""
        with _other_files_ignored():
            files = picture_files(self.folder, recursive=True)
        inside = (file for file in files if self._is_inside(file))
        names = (file.relative_to(self.folder).as_posix() for file in inside)
        # The protocol speaks UTF-8, which has not every name that a file can have.
        said = [name for name in names if name.isprintable()]
        return said[:_MOST_PICTURES]

    @_one_at_a_time
    def search(self, picture: str, target: str, passes: int = 16, prior: float | None = None) -> Answer:
        """Search a picture for one object of a class.

        Args:
            picture: its name.
            target: the class.
            passes: most passes of the detector.
            prior: how likely the class is in the picture before anybody looks; None for as likely as not.

        Returns:
            The answer.
        """
        path = self._path(picture)
        _check_passes(passes)
        record = self.agent.search(path, target, prior=prior, passes=passes, seconds=_SECONDS)
        return _answer(record)

    @_one_at_a_time
    def find(self, picture: str, classes: list[str], passes: int = 24) -> Answer:
        """Find all objects of some classes in a picture.

        Args:
            picture: its name.
            classes: the classes; none for all that the detector knows.
            passes: most passes of the detector.

        Returns:
            The answer.
        """
        path = self._path(picture)
        _check_passes(passes)
        record = self.agent.find_all(path, classes or None, passes=passes, seconds=_SECONDS)
        return _answer(record)

    @_one_at_a_time
    def look(self, picture: str, x: float, y: float, width: float) -> View:
        """Look closely at one place: a crop as wide as it is high, and what the detector shows in it.

        Args:
            picture: its name.
            x: centre in pixels of the picture, from its left side.
            y: centre likewise, from above.
            width: width of the crop in pixels of the picture. A narrow crop is magnified, at most four times.

        Returns:
            The crop, which is moved into the picture where it would reach beyond it.
        """
        source = open_large(self._path(picture))
        box = _crop_box(source.size, x, y, width)
        pixels = source.read(box)
        crop = _shown(pixels)
        record = self.agent.find_all(pixels, passes=1, how="windows")
        left, top, _, _ = box
        return View(crop, box, _rows(record, (left, top)))

    @_one_at_a_time
    def where_people_look(self, picture: str) -> Gaze:
        """Predict where people look in a picture that they view freely for some seconds.

        Args:
            picture: its name.

        Returns:
            The places, in the order of their shares.
        """
        prediction = self.agent.gaze(self._path(picture))
        places = [Peak(x=peak["x"], y=peak["y"], share=peak["share"]) for peak in prediction.peaks()]
        return Gaze(
            result=prediction.describe(),
            places=places,
            caution=prediction.caution,
            size=list(prediction.size),
        )

    @_one_at_a_time
    def check(self, fixations: str) -> list[str]:
        """Say what is suspicious in a file of fixations, compared with the pictures of the folder.

        Args:
            fixations: the file's path from the folder.

        Returns:
            What is in the file, and what is suspicious.
        """
        from semfov.human.check import fixation_report

        path = self._path(fixations)
        options = CheckOptions(files=(str(path),), picture=str(self.folder), quiet=True)
        with _other_files_ignored():
            report = fixation_report(path, options, self._is_inside)
        return [report.content, *report.lines]

    def _path(self, name: str) -> Path:
        """Find a file by its path from the folder; raises `InputError` for any other."""
        expected = "the path of a file below the folder, as `pictures` lists them"
        check("\0" not in name, "picture", expected, printable(name))
        path = self.folder / name
        check(self._is_inside(path), "picture", expected, printable(name))
        try:
            is_there = path.is_file()
        except OSError:  # the name is too long
            is_there = False
        check(is_there, "picture", expected, f"{printable(name)}, which is none")
        return path

    def _is_inside(self, path: Path) -> bool:
        """Tell whether a path, with all links followed, leads to a place below the folder."""
        try:
            return path.resolve().is_relative_to(self.folder)
        except (OSError, RuntimeError):  # a name that is too long, or links in a ring
            return False


@contextmanager
def _other_files_ignored() -> Iterator[None]:
    """Silence the warning of files that are no pictures: in this folder they are expected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def _check_passes(passes: int) -> None:
    check(1 <= passes <= MOST_PASSES, "passes", f"1 to {MOST_PASSES}", passes)


def _answer(record: Record) -> Answer:
    """Make the answer from a record."""
    listed = Counter(record.classes[label] for label in record.objects.labels.tolist())
    # A search ends as soon as it is decided, so its looks say little of how many there are.
    expected = record.expected if record.decision is None else {}
    further = {name: max(number - listed[name], 0.0) for name, number in expected.items()}
    values = record.to_dict()
    return Answer(
        result=record.describe(),
        ended=record.words.ended,
        probability=values.get("probability"),
        score=values.get("score"),
        objects=_rows(record),
        expected=_known_numbers(expected),
        further=_known_numbers(further),
        passes=record.passes,
        size=list(record.size),
    )


def _known_numbers(numbers: Mapping[str, float]) -> dict[str, float | None]:
    """Round numbers by class; None for NaN, which JSON does not have."""
    return {name: None if math.isnan(number) else round(number, 2) for name, number in numbers.items()}


def _rows(record: Record, corner: tuple[int, int] = (0, 0)) -> list[Found]:
    """Make a row for each object; boxes of a crop are moved by its corner in the picture."""
    measure = record.words.measure if record.decision is None else record.words.decided_by
    offset = torch.tensor([*corner, *corner])
    objects = record.objects
    boxes = (objects.boxes + offset).tolist()
    rows = []
    for box, score, label in zip(boxes, objects.scores.tolist(), objects.labels.tolist(), strict=True):
        number = round(score, 4)
        row = Found(
            name=record.classes[label],
            probability=number if measure == "probability" else None,
            score=None if measure == "probability" else number,
            box=[round(edge, 1) for edge in box],
        )
        rows.append(row)
    return rows


def _crop_box(size: tuple[int, int], x: float, y: float, width: float) -> tuple[int, int, int, int]:
    """Place a square crop in a picture; it is moved, and at most cut to the picture, where it would reach beyond it."""
    longest = min(max(size), _WIDEST)
    check(_SMALLEST <= width <= longest, "width", f"{_SMALLEST} to {longest} pixels", width)
    left, right = _span("x", x, size[0], width)
    top, bottom = _span("y", y, size[1], width)
    return left, top, right, bottom


def _span(name: str, middle: float, side: int, width: float) -> tuple[int, int]:
    """Place a crop along one axis of a picture, whose side is `side` pixels."""
    check(0 <= middle <= side, name, f"0 to {side}, a pixel of the picture", middle)
    length = min(round(width), side)
    start = min(max(round(middle - length / 2), 0), side - length)
    return start, start + length


def _shown(pixels: Tensor) -> bytes:
    """Make a JPEG of a crop of bytes `(3, h, w)`, whose longer side has at most `_SIDE` pixels."""
    height, width = pixels.shape[1:]
    scale = min(_SIDE / max(height, width), _MAGNIFIED)
    size = max(round(height * scale), 1), max(round(width * scale), 1)
    return jpeg(resized(pixels, size)[0], _QUALITY)

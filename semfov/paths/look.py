"""One look of a record: where it was, what it detected, and what it showed."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.attribute_words import LOOK, OtherWords
from semfov.belief.grid import Grid
from semfov.data.classes import amount
from semfov.data.windowed import LargePicture, reduction_for
from semfov.detection.detections import Detections
from semfov.detection.objects import box_text

Box = tuple[float, float, float, float]  # `(x1, y1, x2, y2)`
_Steps = TypeVar("_Steps", Tensor, NDArray[np.float64])
CONFIDENT = 0.1  # score from which on the detections of a look are counted, named and drawn


@dataclass(frozen=True, repr=False, eq=False)
class RecordedLook(OtherWords):
    """One look of a record, in pixels of the picture.

    Attributes:
        index: place of the look in its record, `record[index]`, from 0.
        fixation: `(x, y)`, the fixated point.
        region: `(x1, y1, x2, y2)`, the part of the picture that the look shows.
        detections: its detections, a batch of one.
        seconds: time at its end, on the clock of the episode; None if it is not known.
        value: value for which it was chosen; None if it was not chosen by a value.
        more: further columns of `Record.rows`, which looks of this kind have, as plain values.

    Example::

        for look in agent.search("kitchen.jpg", "cup"):
            print(look.number, look.fixation, look.seconds)
    """

    index: int
    fixation: tuple[float, float]
    region: Box
    detections: Detections
    seconds: float | None = None
    value: float | None = None
    more: Mapping[str, Any] = field(default_factory=dict)

    _other_words = LOOK

    @property
    def number(self) -> int:
        """Number of the look in pages, figures, tables and files, from 1."""
        return self.index + 1

    def __repr__(self) -> str:
        """Tell number, point, region and number of detections from score 0.1 on in one line."""
        x, y = self.fixation
        count = int(confident_detections(self.detections).count)
        detections = f"{amount(count, 'detection')} from score {CONFIDENT:g} on"
        return f"{type(self).__name__} {self.number} at ({x:z.0f}, {y:z.0f}), box {box_text(self.region)}: {detections}"


def finite_or_none(value: float | None) -> float | None:
    """Return the value of a look for its record: None if it is infinite, as no value led to the look."""
    return value if value is not None and math.isfinite(value) else None


class LookView(NamedTuple):
    """The view of a look: pixels `(3, h, w)`, and boxes `(L, 4)` and gaze in these pixels."""

    pixels: Tensor
    size: tuple[int, int]
    boxes: Tensor
    gaze: tuple[float, float]


def whole_pixels(box: Sequence[float], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Round a region to whole pixels, at least one, inside a picture of `(width, height)`."""
    x1, y1, x2, y2 = box
    width, height = size
    left, right = _whole_side(x1, x2, width)
    top, bottom = _whole_side(y1, y2, height)
    return left, top, right, bottom


def _whole_side(start: float, end: float, length: int) -> tuple[int, int]:
    """Round a side of a region to whole pixels, at least one, from 0 to a length."""
    first = min(max(round(start), 0), length - 1)
    return first, min(max(round(end), first + 1), length)


def read_region(source: LargePicture, region: Sequence[float], size: tuple[int, int], across: int) -> Tensor:
    """Read a region of a picture, coarsely if it is wider than needed.

    Args:
        source: the opened picture, which may have another size than the record's.
        region: `(x1, y1, x2, y2)`, in pixels of a picture of `size`.
        size: `(width, height)` of the picture of the record.
        across: number of columns that are needed.

    Returns:
        `(3, h, w)` in [0, 1].
    """
    frame = pixels_in(source.size, region, size)
    left, _, right, _ = frame
    return source.read(frame, reduction_for((right - left) // across)).float() / 255


def pixels_in(
    size: tuple[int, int], region: Sequence[float], size_of_record: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Find the whole pixels of a picture that a region covers, which is in pixels of the same picture in another size.

    Args:
        size: `(width, height)` of the picture.
        region: `(x1, y1, x2, y2)`.
        size_of_record: `(width, height)` of the picture that the region is in.

    Returns:
        Left, top, right and bottom edge.
    """
    x1, y1, x2, y2 = region
    scale_x = size[0] / size_of_record[0]
    scale_y = size[1] / size_of_record[1]
    return whole_pixels((x1 * scale_x, y1 * scale_y, x2 * scale_x, y2 * scale_y), size)


def shorter_way(steps: _Steps, around: float) -> _Steps:
    """Compute the shorter way round a closed line of length `around`, from -around / 2 to around / 2.

    >>> shorter_way(np.array([350.0, -10.0]), 360).tolist()
    [-10.0, -10.0]
    """
    return (steps + around / 2) % around - around / 2


def cell_columns(grid: Grid, cell: int, belief: Tensor | None) -> dict[str, float | None]:
    """Columns of a table on a look at a cell: its place, its probability, and the most probable cell.

    Args:
        grid: the cells.
        cell: number of the cell.
        belief: `(cells,)`, the probability of each cell after the look; None if there is none.
    """
    row, column = divmod(cell, grid.columns)
    columns: dict[str, float | None] = {"cell": cell, "column": column, "row": row}
    if belief is None:
        return {**columns, "probability": None, "highest": None, "highest_cell": None}
    return {
        **columns,
        "probability": float(belief[cell]),
        "highest": float(belief.max()),
        "highest_cell": int(belief.argmax()),
    }


def confident_detections(detections: Detections, most: int | None = None) -> Detections:
    """Take the most confident detections of a look, a batch of one without padding, the most confident first."""
    order = detections.confidence[0].argsort(descending=True, stable=True)
    count = int((detections.confidence[0] >= CONFIDENT).sum())
    return detections.take(order[:count][:most]).to("cpu")


def detections_in_words(
    detections: Detections, classes: Sequence[str], most: int = 3, target: int | None = None
) -> str:
    """Name the most confident detections of a look, before them the best one of the target with its box.

    Args:
        detections: of the look, a batch of one.
        classes: names of the classes, background first.
        most: largest number that is named.
        target: class 1..K; None for none.

    Returns:
        Classes and scores, such as `cup 0.80 in (10, 20, 30, 40), person 0.60 and 2 more`.
    """
    confident = confident_detections(detections)
    labels = confident.labels[0].tolist()
    scores = confident.confidence[0].tolist()
    names = [f"{classes[label]} {score:.2f}" for label, score in zip(labels, scores, strict=True)]
    if target is not None and bool(detections.mask.any()):
        target_scores = detections.class_scores[0, :, target - 1]  # (L,)
        best = int(target_scores.argmax())
        name = f"{classes[target]} {target_scores[best]:.2f}"
        # It is named with its box, and not again among the others.
        if name in names:
            names.remove(name)
        names = [f"{name} in {box_text(detections.boxes[0, best].tolist())}", *names]
    if not names:
        return "nothing"
    named = ", ".join(names[:most])
    return f"{named} and {len(names) - most} more" if len(names) > most else named

"""Objects of a picture, merged from the boxes of many looks at it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from semfov.attribute_words import OBJECTS, OtherWords
from semfov.data.classes import amount, class_index
from semfov.data.inputs import as_positions
from semfov.errors import InputError, check, check_number, check_shape

NO_TRACK = -1
"""Number of an object of a stream that no track follows."""

_Column = NDArray[np.float32]
_Index = NDArray[np.intp]

SCORE_THRESHOLD = 0.3
"""Score from which on objects are shown, printed, drawn and counted, unless the detector or the user gives another."""

FAINTEST = 0.05  # score from which on boxes are merged into candidates
_FAR = 1e9  # pixels of an edge, beyond which areas of single precision overflow
_PRINTED = 20  # largest number of objects in the text form
_BORDER = 2 / 416  # boxes that come this near to a border of their window, in longer sides of the window, are cut by it


@dataclass(frozen=True, repr=False, eq=False)
class Objects(OtherWords):
    """Objects of a picture, most confident first.

    Attributes:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)` in picture pixels.
        scores: `(M,)`, score of the class.
        labels: `(M,)`, classes 1..K.
        passes: `(M,)`, place in the record, from 0, of the look that each box comes from.
        track_ids: `(M,)`, numbers that stay with the objects of a stream; None in a picture.
        classes: names of the classes, background first, for the text form; none where only numbers are known.

    >>> objects = Objects(torch.zeros(2, 4), torch.tensor([0.9, 0.2]), torch.tensor([1, 3]), torch.tensor([0, 4]))
    >>> len(objects), len(objects.above(0.5)), len(objects.of([3]))
    (2, 1, 1)
    """

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    passes: Tensor
    classes: tuple[str, ...] = field(default=(), compare=False)
    track_ids: Tensor | None = None

    _other_words = OBJECTS
    _objects = "objects"

    def __len__(self) -> int:
        return len(self.boxes)

    def __repr__(self) -> str:
        """Write the number of objects, and a line for each of the most confident ones."""
        lines = [amount(len(self), "object")]
        shown = self[:_PRINTED]
        labels = shown.labels.tolist()
        scores = shown.scores.tolist()
        boxes = shown.boxes.tolist()
        looks = shown.passes.tolist()
        for label, score, box, look in zip(labels, scores, boxes, looks, strict=True):
            name = self.classes[label] if self.classes else f"class {label}"
            lines.append(f"{name} {score:.2f}, box {box_text(box)}, look {look + 1}")
        if len(self) > _PRINTED:
            lines.append(f"and {len(self) - _PRINTED} more")
        return "\n  ".join(lines)

    @classmethod
    def none(cls) -> "Objects":
        """Make a set of no objects.

        Returns:
            The objects of a picture in which nothing was found.
        """
        nothing = torch.zeros(0)
        return cls(nothing.view(0, 4), nothing, nothing.long(), nothing.long())

    def above(self, score: float) -> "Objects":
        """Select objects with at least a given score.

        Args:
            score: the lowest score.

        Returns:
            The objects.
        """
        return self[self.scores >= score]

    def of(self, labels: Sequence[int] | str) -> "Objects":
        """Select objects of some classes.

        Args:
            labels: the classes, 1..K, or the name of one; none stands for all classes.

        Returns:
            The objects.

        Raises:
            InputError: no class has this name.
        """
        if isinstance(labels, str):
            labels = [class_index(labels, self.classes[1:])]
        if len(labels) == 0:
            return self
        return self[torch.isin(self.labels, torch.tensor(labels))]

    def __getitem__(self, index: Tensor | slice | int) -> "Objects":
        """Select some of the objects, or one of them by its number."""
        check(not isinstance(index, str), "index", f"a number; objects.of({index!r}) are those of a class", repr(index))
        if isinstance(index, int):
            index = torch.tensor([index])
        numbers = None if self.track_ids is None else self.track_ids[index]
        columns = (self.boxes[index], self.scores[index], self.labels[index], self.passes[index])
        return Objects(*columns, self.classes, numbers)


def box_text(box: Sequence[float]) -> str:
    """Write the corners of a box in whole pixels.

    Args:
        box: `(x1, y1, x2, y2)`.

    Returns:
        The text.
    """
    x1, y1, x2, y2 = (f"{edge:.0f}" for edge in box)
    return f"{x1},{y1}–{x2},{y2}"


def merge_boxes(
    boxes: ArrayLike | Tensor,
    scores: ArrayLike | Tensor,
    labels: ArrayLike | Tensor,
    windows: ArrayLike | Tensor | None = None,
    *,
    size: tuple[float, float] | None = None,
    score: float = FAINTEST,
    iou: float = 0.5,
    inside: float = 0.8,
) -> "Objects":
    """Merge boxes from several windows of a picture into one box for each object.

    The boxes may come from any detector, for instance from one that was applied to slices of the picture. They are
    merged by the rule of `merge_looks`: of two boxes of the same object, a whole box is kept rather than one that the
    border of its window cuts. If both or neither are cut, the box of the smaller window is kept, and within a window
    the box with the higher score.

    Args:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)` in picture pixels.
        scores: `(M,)`, scores from 0 to 1.
        labels: `(M,)`, classes. Boxes of different classes are different objects.
        windows: `(M, 4)`, the window that each box was seen in, in picture pixels; None for one look at the whole
            picture.
        size: `(width, height)` of the picture, whose border cuts no object; None takes the border of all windows.
        score: boxes with a lower score are left out.
        iou: intersection over union from which on two boxes are the same object.
        inside: share of the area of a cut box from which on it is the same object.

    Returns:
        Objects, most confident first. Their `passes` number the windows in the order in which they first appear.

    Raises:
        InputError: a shape is wrong, or a number is out of range.

    >>> slices = [[0, 0, 640, 640], [400, 0, 1040, 640]]
    >>> merged = merge_boxes([[500, 90, 639, 200], [502, 91, 700, 202]], [0.9, 0.8], [3, 3], slices, size=(1040, 640))
    >>> merged.boxes.tolist(), merged.passes.tolist()
    ([[502.0, 91.0, 700.0, 202.0]], [1])
    """
    corners, confidence, classes = _checked_boxes(boxes, scores, labels)
    for name, number in (("score", score), ("iou", iou), ("inside", inside)):
        check_number(number, name, 0, 1)
    count = len(corners)
    if windows is None or not count:  # one look shows all boxes, and cuts none
        looks = torch.zeros(count).long()
        cut = torch.zeros(count).bool()
        sharpness = torch.zeros(count)
    else:
        frames = _numbers(windows, "windows")
        check_shape(frames, "windows", count, 4)
        side = (frames[:, 2:] - frames[:, :2]).amax(-1)
        check(bool((side > 0).all()), "windows", "boxes (x1, y1, x2, y2) of some size", frames.tolist()[:3])
        looks = _numbers_of_windows(frames)
        cut = _cut_by_windows(corners, frames, side, size)
        sharpness = -side
    return merge_looks(corners, confidence, classes, looks, cut, sharpness, score=score, iou=iou, inside=inside)


def _checked_boxes(
    boxes: ArrayLike | Tensor, scores: ArrayLike | Tensor, labels: ArrayLike | Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Convert boxes `(M, 4)`, scores `(M,)` and labels `(M,)` to tensors; raises `InputError` for any that are none."""
    corners = _numbers(boxes, "boxes")
    confidence = _numbers(scores, "scores")
    numbers = _numbers(labels, "labels")
    classes = numbers.long()
    check(torch.equal(classes.to(numbers), numbers), "labels", "whole numbers of classes", numbers.tolist()[:3])
    if not corners.numel():
        corners = corners.view(0, 4)  # an empty list has one dimension
    check_shape(corners, "boxes", None, 4)
    check_shape(confidence, "scores", len(corners))
    check_shape(classes, "labels", len(corners))
    _check_edges(corners)
    in_range = bool(((confidence >= 0) & (confidence <= 1)).all())
    check(in_range, "scores", "numbers from 0 to 1", confidence.tolist()[:3])
    return corners, confidence, classes


def _check_edges(boxes: Tensor) -> None:
    """Raise `InputError` unless the edges of boxes `(M, 4)` are in order, and so near that areas do not overflow."""
    if not boxes.numel():
        return
    farthest = float(boxes.abs().max())
    check(farthest <= _FAR, "boxes", f"edges up to {_FAR:g} pixels", f"{farthest:g}")
    are_ordered = bool((boxes[:, :2] <= boxes[:, 2:]).all())
    check(are_ordered, "boxes", "(x1, y1, x2, y2) with x1 <= x2 and y1 <= y2", "others")


def _numbers_of_windows(windows: Tensor) -> Tensor:
    """Give numbers to windows `(M, 4)` in the order in which they first appear, `(M,)`."""
    numbers: dict[tuple[float, ...], int] = {}
    return torch.tensor([numbers.setdefault(tuple(window), len(numbers)) for window in windows.tolist()])


def _cut_by_windows(boxes: Tensor, windows: Tensor, side: Tensor, size: tuple[float, float] | None) -> Tensor:
    """Tell which boxes `(M, 4)` the borders of their windows `(M, 4)` cut, `(M,)`.

    Args:
        boxes: boxes in picture pixels.
        windows: the window of each box.
        side: longer side of each window, `(M,)`.
        size: `(width, height)` of the picture, whose border cuts no box; None takes the border of all windows.
    """
    lower: Tensor | float = 0.0
    if size is None:
        lower = windows[:, :2].amin(0)
        upper = windows[:, 2:].amax(0)
    else:
        upper = torch.tensor(size)
    border = _BORDER * side[:, None]
    distance = boxes - windows  # (M, 4), from the left, upper, right and lower border
    at_low_border = distance[:, :2] <= border
    at_high_border = distance[:, 2:] >= -border
    # A border of the picture is no cut.
    cut_low = at_low_border & (windows[:, :2] > lower)
    cut_high = at_high_border & (windows[:, 2:] < upper)
    return cut_low.any(-1) | cut_high.any(-1)


def merge_looks(
    boxes: Tensor,
    scores: Tensor,
    labels: Tensor,
    looks: Tensor,
    cut: Tensor,
    sharpness: Tensor,
    *,
    score: float = FAINTEST,
    iou: float = 0.5,
    inside: float = 0.8,
    around: float | None = None,
) -> "Objects":
    """Merge the boxes of several looks into one box for each object.

    Two boxes of one class are the same object when their intersection over union is at least `iou`. Boxes of two looks
    are also the same object when one of them is cut, and at least `inside` of its area lies in the other. Of two boxes
    of the same object a whole box is kept rather than a cut one. If both or neither are cut, the one that was seen more
    sharply is kept, and of those the one with the higher score.

    Args:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)` in picture pixels.
        scores: `(M,)`, scores of the classes.
        labels: `(M,)`, classes 1..K.
        looks: `(M,)`, number of the look that shows each box.
        cut: `(M,)`, whether the border of its window cuts a box.
        sharpness: `(M,)`, of the look; only its order counts.
        score: boxes with a lower score are left out.
        iou: intersection over union from which on two boxes are the same object.
        inside: share of the area of a cut box from which on it is the same object.
        around: width of a panorama in pixels, whose left and right edge are one; None for a flat picture.

    Returns:
        Objects, most confident first.
    """
    index = (scores >= score).nonzero()[:, 0]
    columns = (column[index] for column in (boxes, scores, labels, looks, cut, sharpness))
    index = index[unlike(*columns, iou=iou, inside=inside, around=around)]
    return Objects(boxes[index], scores[index], labels[index], looks[index])


def unlike(
    boxes: Tensor,
    scores: Tensor,
    labels: Tensor,
    looks: Tensor,
    cut: Tensor,
    sharpness: Tensor,
    *,
    iou: float = 0.5,
    inside: float = 0.8,
    around: float | None = None,
) -> Tensor:
    """Find one box of each object, by the rule of `merge_looks`.

    Args:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)` in picture pixels.
        scores: `(M,)`, scores of the classes.
        labels: `(M,)`, classes.
        looks: `(M,)`, number of the look that shows each box.
        cut: `(M,)`, whether the border of its window cuts a box.
        sharpness: `(M,)`, of the look; only its order counts.
        iou: intersection over union from which on two boxes are the same object.
        inside: share of the area of a cut box from which on it is the same object.
        around: width of a panorama in pixels, whose left and right edge are one; None for a flat picture.

    Returns:
        Indices of the boxes, most confident first.
    """
    order = _best_first(scores, cut, sharpness)
    corners = boxes[order].numpy()
    # In float64: beside the shifts of the classes, float32 would round the edges of the boxes away.
    classes = labels.double()[order].numpy()
    look = looks[order].numpy()
    is_cut = cut[order].numpy()

    better, worse, shared = _overlapping_pairs(corners, classes, around)
    x1, y1, x2, y2 = corners.T
    area = (x2 - x1) * (y2 - y1)
    union = area[better] + area[worse] - shared
    overlap = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)
    is_same = overlap >= np.float32(iou)
    # Boxes without area share none; equal ones are one object all the same.
    empty = np.flatnonzero(union <= 0)
    is_same[empty] = (corners[better[empty]] == corners[worse[empty]]).all(-1)
    # The part of an object at the border of a window lies inside the box of the whole object, which another look shows.
    share_of_worse = shared / np.maximum(area, 1e-6)[worse]  # a box may have no area to divide by
    is_part = (share_of_worse >= np.float32(inside)) & is_cut[worse]
    is_same |= is_part & (look[better] != look[worse])

    index = order[torch.from_numpy(survivors(len(corners), better[is_same], worse[is_same]))]
    return index[scores[index].argsort(descending=True, stable=True)]


def _best_first(scores: Tensor, cut: Tensor, sharpness: Tensor) -> Tensor:
    """Order boxes: whole before cut, of these sharper before blurred, and of these the more confident first."""
    # Sorts are stable, so the last one leads.
    order = scores.argsort(descending=True, stable=True)
    order = order[sharpness[order].argsort(descending=True, stable=True)]
    return order[cut[order].int().argsort(stable=True)]


def _overlapping_pairs(
    corners: NDArray[np.floating], classes: NDArray[np.floating], around: float | None
) -> tuple[_Index, _Index, _Column]:
    """Find pairs of boxes of one class that overlap along x, and the areas that they share.

    Args:
        corners: `(M, 4)`, the best box first.
        classes: `(M,)`.
        around: width of a panorama in pixels; None for a flat picture.

    Returns:
        Indices `(P,)` of the better and of the worse box of each pair, and the shared areas `(P,)`.
    """
    count = len(corners)
    if around is not None:
        # Every box is there a second time, one turn further, so that boxes meet across the seam.
        next_turn = corners + np.array([around, 0, around, 0], corners.dtype)
        corners = np.concatenate([corners, next_turn])
        classes = np.tile(classes, 2)
    # Classes are moved apart, so that neighbours along x are of one class.
    farthest = np.abs(corners).max(initial=0)
    shift = classes * (2 * farthest + 1)
    start = corners[:, 0] + shift
    end = corners[:, 2] + shift
    rank = start.argsort(kind="stable")
    first, second = neighbours(start[rank], end[rank])
    first = rank[first]
    second = rank[second]
    x1, y1, x2, y2 = np.ascontiguousarray(corners.T)  # columns are read faster where each is contiguous
    shared = intersection(x1, y1, x2, y2, first, second)
    if around is not None:
        first = first % count
        second = second % count
        # A box as wide as the panorama meets its own copy, and the two are no pair.
        distinct = first != second
        first = first[distinct]
        second = second[distinct]
        shared = shared[distinct]
    return np.minimum(first, second), np.maximum(first, second), shared


def _numbers(values: ArrayLike | Tensor, name: str) -> Tensor:
    """Convert numbers to a tensor of floats on the CPU."""
    try:
        tensor = torch.as_tensor(values, device="cpu").detach()
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{name}: expected numbers, got {values!r:.80}") from None
    tensor = as_positions(tensor)
    check(bool(tensor.isfinite().all()), name, "finite numbers", "infinite ones or NaN")
    return tensor


def neighbours(start: NDArray[np.floating], end: NDArray[np.floating]) -> tuple[_Index, _Index]:
    """Pair intervals of which the second starts within the first.

    Args:
        start: `(N,)`, ascending.
        end: `(N,)`.

    Returns:
        Indices `(P,)` of the first and of the second interval of each pair.
    """
    stop = start.searchsorted(end, side="right")
    count = np.maximum(stop - np.arange(1, len(start) + 1), 0)
    first = np.arange(len(start)).repeat(count)
    # The pairs of an interval stand together, and the last of them is with interval `stop - 1`.
    to_second = stop - count.cumsum()
    second = np.arange(len(first)) + to_second.repeat(count)
    return first, second


def intersection(x1: _Column, y1: _Column, x2: _Column, y2: _Column, first: _Index, second: _Index) -> _Column:
    """Compute the area that the boxes of each pair share.

    Args:
        x1: left edges of the boxes, `(N,)`.
        y1: upper edges.
        x2: right edges.
        y2: lower edges.
        first: indices of the first box of each pair, `(P,)`.
        second: indices of the second box.

    Returns:
        `(P,)`, 0 where they share none.
    """
    width = np.minimum(x2[first], x2[second]) - np.maximum(x1[first], x1[second])
    height = np.minimum(y2[first], y2[second]) - np.maximum(y1[first], y1[second])
    return np.maximum(width, 0) * np.maximum(height, 0)


def survivors(count: int, better: _Index, worse: _Index) -> _Index:
    """Find the boxes that stay when each, best first, removes the worse boxes that it is paired with.

    Args:
        count: number of boxes.
        better: indices `(P,)` of the better box of each pair.
        worse: indices `(P,)` of the other one.

    Returns:
        Indices of the boxes that stay, ascending.
    """
    # A box that is never the worse one stays. Only the pairs that this leaves open depend on each other.
    doubtful = np.zeros(count, np.bool_)
    doubtful[worse] = True
    removed = np.zeros(count, np.bool_)
    removed[worse[~doubtful[better]]] = True
    undecided = ~(removed[better] | removed[worse])
    # Sorted by the better box, so that it is settled whether that one stays before it removes others.
    pairs = np.sort(better[undecided] * count + worse[undecided])
    # Entries of a bytearray are read faster than those of an array.
    flags = bytearray(removed)
    for first, second in zip((pairs // count).tolist(), (pairs % count).tolist(), strict=True):
        if not flags[first]:
            flags[second] = True
    return np.flatnonzero(np.frombuffer(flags, np.bool_) == 0)

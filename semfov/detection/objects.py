"""Objects of a picture, merged from the boxes of many looks at it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from semfov.data.classes import class_index
from semfov.data.inputs import as_positions
from semfov.errors import InputError, check, check_number, check_shape
from semfov.words import not_there

_Column = NDArray[np.float32]
_Index = NDArray[np.intp]

LEAST = 0.3
"""Score from which on objects are shown, printed, drawn and counted, unless the detector or the user gives another."""

FAINTEST = 0.05  # score from which on boxes are merged into candidates
_FAR = 1e9  # pixels of an edge, beyond which areas of single precision overflow
_PRINTED = 20  # largest number of objects in the text form
_BORDER = 2 / 416  # boxes that come this near to a border of their window, in longer sides of the window, are cut by it

_WORDS = {
    **dict.fromkeys(("save", "to_csv", "write"), "record.to_csv(path, 'objects')"),
    **dict.fromkeys(
        ("dataframe", "df", "to_dataframe", "to_df", "to_frame", "to_pandas"), "record.to_frame('objects')"
    ),
    **dict.fromkeys(("to_dict", "to_json", "tolist"), "record.object_rows()"),
    **dict.fromkeys(("to_coco", "to_geojson", "to_supervision", "to_yolo"), "the method of the record"),
    **dict.fromkeys(("draw", "plot", "show"), "record.plot()"),
    **dict.fromkeys(("bbox", "box", "xyxy"), "objects.boxes"),
    **dict.fromkeys(("conf", "confidence", "probability", "score"), "objects.scores"),
    **dict.fromkeys(("class_id", "cls", "label"), "objects.labels"),
    "names": "objects.classes",
}
"""What others call the attributes of objects, and ours."""


@dataclass(frozen=True, repr=False)
class Objects:
    """Objects of a picture, most confident first.

    Attributes:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)` in picture pixels.
        scores: `(M,)`, score of the class.
        labels: `(M,)`, classes 1..K.
        passes: `(M,)`, number of the look that each box comes from; the first one is 0.
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

    if not TYPE_CHECKING:  # to which any name would be one of objects

        def __getattr__(self, name: str) -> Any:
            return not_there(self, name, _WORDS)

    def __len__(self) -> int:
        return len(self.boxes)

    def __repr__(self) -> str:
        """The number of objects, and a line for each of the most confident ones."""
        rows = zip(
            *(each[:_PRINTED].tolist() for each in (self.labels, self.scores, self.boxes, self.passes)), strict=True
        )
        lines = [
            f"{self.classes[label] if self.classes else f'class {label}'} {score:.2f}, box {box_text(box)}, look {look}"
            for label, score, box, look in rows
        ]
        more = [f"and {len(self) - _PRINTED} more"] if len(self) > _PRINTED else []
        return "\n  ".join([f"{len(self)} object{'s' if len(self) != 1 else ''}", *lines, *more])

    @classmethod
    def none(cls) -> "Objects":
        """No objects.

        Returns:
            The objects of a picture in which nothing was found.
        """
        nothing = torch.zeros(0)
        return cls(nothing.view(0, 4), nothing, nothing.long(), nothing.long())

    def above(self, score: float) -> "Objects":
        """Objects with at least a given score.

        Args:
            score: the lowest score.

        Returns:
            The objects.
        """
        return self[self.scores >= score]

    def of(self, labels: Sequence[int] | str) -> "Objects":
        """Objects of some classes.

        Args:
            labels: the classes, 1..K, or the name of one; none stands for all classes.

        Returns:
            The objects.

        Raises:
            InputError: no class has this name.
        """
        labels = [class_index(labels, self.classes[1:])] if isinstance(labels, str) else labels
        return self[torch.isin(self.labels, torch.tensor(labels))] if len(labels) else self

    def __getitem__(self, index: Tensor | slice | int) -> "Objects":
        """Some of the objects, or by a number one of them."""
        check(not isinstance(index, str), "index", f"a number; objects.of({index!r}) are those of a class", repr(index))
        index = torch.tensor([index]) if isinstance(index, int) else index
        return Objects(self.boxes[index], self.scores[index], self.labels[index], self.passes[index], self.classes)


def box_text(box: Sequence[float]) -> str:
    """Corners of a box in whole pixels."""
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
    box, value = _numbers(boxes, "boxes"), _numbers(scores, "scores")
    given = _numbers(labels, "labels")
    label = given.long()
    check(torch.equal(label.to(given), given), "labels", "whole numbers of classes", given.tolist()[:3])
    box = box.view(0, 4) if not box.numel() else box
    check_shape(box, "boxes", None, 4)
    most = float(box.abs().max()) if box.numel() else 0.0
    check(most <= _FAR, "boxes", f"edges up to {_FAR:g} pixels", f"{most:g}")
    check_shape(value, "scores", len(box))
    check_shape(label, "labels", len(box))
    check(bool((box[:, :2] <= box[:, 2:]).all()), "boxes", "(x1, y1, x2, y2) with x1 <= x2 and y1 <= y2", "others")
    check(bool(((value >= 0) & (value <= 1)).all()), "scores", "numbers from 0 to 1", value.tolist()[:3])
    for name, number in (("score", score), ("iou", iou), ("inside", inside)):
        check_number(number, name, 0, 1)
    looks, cut, sharpness = torch.zeros(len(box)).long(), torch.zeros(len(box)).bool(), torch.zeros(len(box))
    if windows is not None and len(box):
        window = _numbers(windows, "windows")
        check_shape(window, "windows", len(box), 4)
        side = (window[:, 2:] - window[:, :2]).amax(-1)
        check(bool((side > 0).all()), "windows", "boxes (x1, y1, x2, y2) of some size", window.tolist()[:3])
        low, high = (window[:, :2].amin(0), window[:, 2:].amax(0)) if size is None else (0.0, torch.tensor(size))
        near, far = box - window <= _BORDER * side[:, None], box - window >= -_BORDER * side[:, None]
        cut = (near[:, :2] & (window[:, :2] > low)).any(-1) | (far[:, 2:] & (window[:, 2:] < high)).any(-1)
        numbers: dict[tuple[float, ...], int] = {}
        looks = torch.tensor([numbers.setdefault(tuple(each), len(numbers)) for each in window.tolist()])
        sharpness = -side
    return merge_looks(box, value, label, looks, cut, sharpness, score=score, iou=iou, inside=inside)


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

    Shapes: boxes `(M, 4)`, scores `(M,)`, labels `(M,)`, looks `(M,)`, cut `(M,)`, sharpness `(M,)`.
    """
    enough = (scores >= score).nonzero()[:, 0]
    columns = (each[enough] for each in (boxes, scores, labels, looks, cut, sharpness))
    index = enough[unlike(*columns, iou=iou, inside=inside, around=around)]
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
    """Indices of one box of each object, by the rule of `merge_looks` and with its arguments, most confident first."""
    # Stable sorts, the last key first.
    order = scores.argsort(descending=True, stable=True)
    order = order[sharpness[order].argsort(descending=True, stable=True)]
    order = order[cut[order].int().argsort(stable=True)]
    # Each box, in this order, removes later ones that are the same object.
    corners, kinds, seen, broken = (each[order].numpy() for each in (boxes, labels.double(), looks, cut))
    count = len(corners)
    if around is not None:
        # Every box is there a second time, one turn further, so that boxes meet across the seam.
        turned = corners + np.array([around, 0, around, 0], corners.dtype)
        corners, kinds = np.concatenate([corners, turned]), np.tile(kinds, 2)
    # Classes are moved apart, so that neighbours along x are of one class.
    shift = kinds * (2 * np.abs(corners).max(initial=0) + 1)
    start, end = corners[:, 0] + shift, corners[:, 2] + shift
    across = start.argsort(kind="stable")
    one, other = neighbours(start[across], end[across])
    one, other = across[one], across[other]
    x1, y1, x2, y2 = np.ascontiguousarray(corners.T)
    shared = intersection(x1, y1, x2, y2, one, other)
    if around is not None:
        one, other = one % count, other % count
        apart = one != other
        one, other, shared = one[apart], other[apart], shared[apart]
    first, second = np.minimum(one, other), np.maximum(one, other)
    area = ((x2 - x1) * (y2 - y1))[:count]
    union = area[first] + area[second] - shared
    same = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0) >= np.float32(iou)
    # Boxes without area share none; equal ones are one object all the same.
    empty = np.flatnonzero(union <= 0)
    same[empty] = (corners[first[empty]] == corners[second[empty]]).all(-1)
    part = shared / np.maximum(area, 1e-6)[second]
    same |= (part >= np.float32(inside)) & broken[second] & (seen[first] != seen[second])
    index = order[torch.from_numpy(_survivors(count, first[same], second[same]))]
    return index[scores[index].argsort(descending=True, stable=True)]


def _numbers(values: ArrayLike | Tensor, name: str) -> Tensor:
    """Numbers as a tensor of floats on the CPU."""
    try:
        tensor = torch.as_tensor(values, device="cpu").detach()
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{name}: expected numbers, got {values!r:.80}") from None
    tensor = as_positions(tensor)
    check(bool(tensor.isfinite().all()), name, "finite numbers", "infinite ones or NaN")
    return tensor


def neighbours(start: NDArray[np.floating], end: NDArray[np.floating]) -> tuple[_Index, _Index]:
    """Pairs of intervals of which the second starts within the first; start `(N,)`, end `(N,)` → `(P,)`."""
    stop = start.searchsorted(end, side="right")
    count = np.maximum(stop - np.arange(1, len(start) + 1), 0)
    first = np.arange(len(start)).repeat(count)
    # The pairs of an interval stand together, and the last of them is with interval `stop - 1`.
    second = np.arange(len(first)) + (stop - count.cumsum()).repeat(count)
    return first, second


def intersection(x1: _Column, y1: _Column, x2: _Column, y2: _Column, first: _Index, second: _Index) -> _Column:
    """Area `(P,)` that the boxes of each pair share, given edges `(N,)` of the boxes and indices `(P,)` of both."""
    wide = np.minimum(x2[first], x2[second]) - np.maximum(x1[first], x1[second])
    high = np.minimum(y2[first], y2[second]) - np.maximum(y1[first], y1[second])
    return np.maximum(wide, 0) * np.maximum(high, 0)


def _survivors(count: int, better: _Index, worse: _Index) -> _Index:
    """Greedy suppression: the boxes that stay when each removes the worse boxes that it is paired with; both `(P,)`."""
    doubtful, gone = np.zeros((2, count), np.bool_)
    doubtful[worse] = True
    # A box that is never the worse one stays. Only the pairs that this leaves open depend on each other.
    gone[worse[~doubtful[better]]] = True
    left = np.flatnonzero(~(gone[better] | gone[worse]))
    pairs = np.sort(better[left] * count + worse[left])
    removed = bytearray(gone)
    for one, other in zip((pairs // count).tolist(), (pairs % count).tolist(), strict=True):
        if not removed[one]:
            removed[other] = True
    return np.flatnonzero(np.frombuffer(removed, np.bool_) == 0)

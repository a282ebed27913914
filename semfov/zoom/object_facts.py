"""Features of objects in a large picture (`FACTS`), from which `Certainty` predicts their probability.

    boxes of all looks ──► one box for each object (`index`) ──► what looks show of it, and better objects around it

An object is shown by a look if a box of its class overlaps it enough there, or if a cut box lies mostly inside it.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.detection.objects import intersection, neighbours
from semfov.observation.matching import SAME_OBJECT_IOU
from semfov.zoom.certainty import FACTS

_PART = 0.8  # share of the area of a cut box from which on it shows the object that it lies in
_LEAST = 0.01  # scores below, and above the next one, count as these
_MOST = 0.999
_SMALLEST = 6.0  # side in canvas pixels from which on a look should show an object
_EDGE = 2.0  # canvas pixels from the border of a window within which it may cut an object
_USUAL_AGREEMENT = 0.6  # about the mean overlap of other boxes with that of an object, where there are any

_Floats = NDArray[np.float32]
_Indices = NDArray[np.intp]
_Flags = NDArray[np.bool_]


class DetectedBoxes(NamedTuple):
    """The boxes of all detections of several looks.

    Attributes:
        boxes: `(L, 4)`.
        scores: `(L,)`.
        labels: `(L,)`, classes from 1.
        looks: `(L,)`, numbers of their looks.
        cut: `(L,)`, whether the border of their window cuts them.
        magnifications: `(L,)`, of their looks.
    """

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    looks: Tensor
    cut: Tensor
    magnifications: Tensor

    def of(self, rows: Tensor) -> "DetectedBoxes":
        """Select boxes by index.

        Args:
            rows: `(L,)` boolean, or their indices.

        Returns:
            The selected ones.
        """
        return DetectedBoxes(*(column[rows] for column in self))


class Overlaps(NamedTuple):
    """The pairs of boxes that overlap, in both orders.

    Attributes:
        first: `(P,)`, index of one box.
        second: `(P,)`, index of the other.
        shared: `(P,)`, area that they share.
        area: `(L,)`, areas of all boxes.
    """

    first: _Indices
    second: _Indices
    shared: _Floats
    area: _Floats

    @classmethod
    def among(cls, boxes: _Floats) -> "Overlaps":
        """Find the pairs of boxes that overlap.

        Args:
            boxes: `(L, 4)`.

        Returns:
            The pairs.
        """
        x1, y1, x2, y2 = np.ascontiguousarray(boxes.T)
        order = x1.argsort(kind="stable")
        ranks = neighbours(x1[order], x2[order])  # pairs that overlap from left to right
        first = order[ranks[0]]
        second = order[ranks[1]]
        shared = intersection(x1, y1, x2, y2, first, second)
        meets = shared > 0
        first = first[meets]
        second = second[meets]
        shared = shared[meets]
        return cls(
            first=np.concatenate([first, second]),
            second=np.concatenate([second, first]),
            shared=np.concatenate([shared, shared]),
            area=np.maximum(x2 - x1, 0) * np.maximum(y2 - y1, 0),
        )

    @property
    def union(self) -> _Floats:
        """Area that one of the two boxes covers, `(P,)`."""
        return self.area[self.first] + self.area[self.second] - self.shared

    def iou(self) -> _Floats:
        """Compute the intersection over union, `(P,)`; 0 where both boxes have no area."""
        union = self.union
        return np.divide(self.shared, union, out=np.zeros_like(self.shared), where=union > 0)

    def share_of(self, box: _Indices) -> NDArray[np.floating]:
        """Compute the share of one of the two boxes that lies in the other; box and result `(P,)`."""
        return self.shared / np.maximum(self.area[box], 1e-6)


def object_facts(
    index: Tensor,
    detected: DetectedBoxes,
    windows: Tensor,
    scales: Tensor,
    size: tuple[int, int],
    finest: float,
    *,
    latest: bool = False,
) -> Tensor:
    """Compute the features (`FACTS`) of objects.

    Args:
        index: `(M,)`, the box of each object among those that were detected.
        detected: the boxes.
        windows: `(N, 4)`, what each look shows of the picture.
        scales: `(N,)`, magnifications of the looks.
        size: `(width, height)` of the picture.
        finest: largest magnification of the picture.
        latest: whether a later look replaces what earlier ones of the same place show, as in a stream.

    Returns:
        `(M, 14)`, the `FACTS`.
    """
    count = len(index)
    if count == 0:
        return detected.scores.new_zeros(0, len(FACTS))
    boxes = detected.boxes.float().numpy()
    scores = detected.scores.float().numpy()
    labels = detected.labels.numpy()
    looks = detected.looks.numpy()
    cut = detected.cut.numpy()
    scale = scales.float().numpy()
    chosen = index.numpy()

    overlaps = Overlaps.among(boxes)
    first = overlaps.first
    second = overlaps.second
    iou = overlaps.iou()
    object_of = object_of_box(chosen, len(boxes))
    of_object = object_of[first]  # the object of the first box of each pair, or -1
    same_class = labels[first] == labels[second]
    alike = (of_object >= 0) & same_class
    same = alike & (iou >= SAME_OBJECT_IOU)
    part = alike & cut[second] & (overlaps.share_of(second) >= _PART) & (looks[first] != looks[second])
    shows = same | part

    best_by_look = np.zeros((count, len(scale)), np.float32)
    best_by_look[np.arange(count), looks[chosen]] = scores[chosen]
    np.maximum.at(best_by_look, (of_object[shows], looks[second[shows]]), scores[second[shows]])
    odds_by_look = _logit(best_by_look)
    best = odds_by_look.max(1)
    should_show, side = _should_show(boxes[chosen], windows.float().numpy(), scale, size, latest=latest)
    detects = best_by_look > 0
    scale_by_look = np.where(should_show | detects, scale, 0)
    sharpest = scale_by_look.max(1)
    by_sharpest = scale_by_look >= sharpest[:, None] * (1 - 1e-6)
    extent = (side + np.log2(sharpest) - 5) / 2
    agrees = same & ~cut[second]
    double, inside, around, rival = _better_neighbours(overlaps, iou, object_of, same_class, best)
    facts = [
        _logit(scores[chosen]),
        best,
        np.where(by_sharpest, odds_by_look, -np.inf).max(1),
        np.log1p(detects.sum(1)),
        np.log1p((should_show & ~detects).sum(1)),
        cut[chosen],
        extent,
        extent**2,
        _agreement(of_object[agrees], iou[agrees], count),
        double,
        inside,
        around,
        np.maximum(math.log2(finest) - np.log2(sharpest), 0),
        rival,
    ]
    return torch.from_numpy(np.stack(facts, -1).astype(np.float32))


def object_of_box(chosen: _Indices, boxes: int) -> _Indices:
    """Find the object that each box was chosen for.

    Args:
        chosen: `(M,)`, the box of each object.
        boxes: number of all boxes.

    Returns:
        `(boxes,)`, the object that each box was chosen for; -1 for none.
    """
    numbers = np.full(boxes, -1)
    numbers[chosen] = np.arange(len(chosen))
    return numbers


def _agreement(objects: _Indices, iou: _Floats, count: int) -> NDArray[np.float64]:
    """Average the overlaps of other boxes with each of `count` objects, above the usual; 0 without any."""
    number = np.bincount(objects, minlength=count)
    mean = np.bincount(objects, iou, minlength=count) / np.maximum(number, 1)
    return np.where(number > 0, mean - _USUAL_AGREEMENT, 0)


def _better_neighbours(
    overlaps: Overlaps, iou: _Floats, object_of: _Indices, same_class: _Flags, best: _Floats
) -> tuple[_Floats, _Floats, _Floats, _Floats]:
    """Measure how much better objects overlap each object, weighted by their probability.

    The better one of a pair is the one with the higher best score, `best` `(M,)` as log odds, of equals the first.

    Args:
        overlaps: pairs of boxes.
        iou: `(P,)`, their intersection over union.
        object_of: `(L,)`, object of each box, or -1.
        same_class: `(P,)`, whether the two boxes of a pair are of one class.
        best: `(M,)`.

    Returns:
        Four measures `(M,)`: of objects of the same class the overlap, the share of this object inside the other, and
        the share of the other inside this one; and the overlap with objects of other classes.
    """
    object_of_first = object_of[overlaps.first]
    object_of_second = object_of[overlaps.second]
    are_objects = (object_of_first >= 0) & (object_of_second >= 0)
    # Of each pair of objects, which stands in both orders, the one in which the first is the worse.
    pair = np.flatnonzero(are_objects)
    worse = object_of_first[pair]
    better = object_of_second[pair]
    is_tie = best[better] == best[worse]
    is_in_order = (best[better] > best[worse]) | (is_tie & (better < worse))
    pair = pair[is_in_order]
    worse = worse[is_in_order]
    better = better[is_in_order]
    weight = 1 / (1 + np.exp(-best[better]))
    alike = same_class[pair]
    overlap = iou[pair] * weight
    inside = overlaps.share_of(overlaps.first)[pair] * weight
    around = overlaps.share_of(overlaps.second)[pair] * weight

    def largest(values: NDArray[np.floating], among: _Flags) -> _Floats:
        measure = np.zeros(len(best), np.float32)
        np.maximum.at(measure, worse[among], values[among])
        return measure

    return largest(overlap, alike), largest(inside, alike), largest(around, alike), largest(overlap, ~alike)


def _logit(scores: _Floats) -> _Floats:
    """Compute the log odds of scores."""
    inside = np.clip(scores, _LEAST, _MOST)
    return np.log(inside / (1 - inside))


def _should_show(
    boxes: _Floats, windows: _Floats, scale: _Floats, size: tuple[int, int], *, latest: bool
) -> tuple[_Flags, _Floats]:
    """Find the looks that should show each box: it lies inside their window, and is large enough.

    Args:
        boxes: `(M, 4)`.
        windows: `(N, 4)`.
        scale: `(N,)`, magnifications.
        size: `(width, height)` of the picture.
        latest: whether only the last of several looks counts that should show a box as closely.

    Returns:
        `(M, N)`, and the logarithms (base 2) of the sides of the boxes, `(M,)`.
    """
    # A box may have no area, and the logarithm of 0 is not finite.
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1e-3)
    log_side = np.log2(sides).mean(1)
    log_side_on_canvas = log_side[:, None] + np.log2(scale)
    is_large_enough = log_side_on_canvas >= math.log2(_SMALLEST)
    should_show = _are_inside(boxes, windows, scale, size) & is_large_enough
    if latest:
        # From the first look on: what later ones should show is read before it is replaced.
        for number in range(len(scale) - 1):
            later = slice(number + 1, None)
            is_as_close = scale[later] >= scale[number]
            is_replaced = (should_show[:, later] & is_as_close).any(1)
            should_show[:, number] &= ~is_replaced
    return should_show, log_side


def _are_inside(boxes: _Floats, windows: _Floats, scale: _Floats, size: tuple[int, int]) -> _Flags:
    """Tell which windows show boxes whole, `(M, N)`: no border cuts them but that of the picture, which cuts none."""
    first_edges = windows[:, :2]
    last_edges = windows[:, 2:]
    margin = _EDGE / scale[:, None]
    low = np.where(first_edges > 0, first_edges + margin, -np.inf)
    high = np.where(last_edges < np.array(size) - 0.5, last_edges - margin, np.inf)
    begins_inside = (boxes[:, None, :2] >= low).all(-1)
    ends_inside = (boxes[:, None, 2:] <= high).all(-1)
    return np.logical_and(begins_inside, ends_inside)

"""Objects of a large picture, merged from the detections of several windows."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.objects import FAINTEST, Objects, intersection, merge_looks, neighbours, unlike
from semfov.zoom.certainty import FACTS, Certainty
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import WindowLook

_INSIDE = 0.5
"""Share of the area of a cut box from which on it is the same object as a box of another look that it lies in."""

_SAME = 0.5

_LEAST, _MOST = 0.01, 0.999
_SMALLEST = 6.0  # side in canvas pixels from which on a look should show an object
_EDGE = 2.0  # canvas pixels from the border of a window within which it may cut an object


def merge(
    looks: Sequence[WindowLook],
    target: int | Sequence[int] | None = None,
    *,
    score: float = FAINTEST,
    iou: float = 0.5,
    inside: float = 0.8,
) -> Objects:
    """Merge the detections of several looks at windows into one box for each object.

    The boxes are those of `semfov.detection.objects.merge_looks`; the look with the higher magnification is the sharper
    one. The score of an object is the highest that any look shows it with, as where slices are merged by suppression.

    Args:
        looks: looks at one picture.
        target: class 1..K, whose score counts for every box; of several classes, the best one for each box. None, or
            no class, takes the best class of each box. Scores are the detector's own (`Detections.class_scores`).
        score: boxes with a lower score are left out.
        iou: intersection over union from which on two boxes are the same object.
        inside: share of the area of a cut box from which on it is the same object.

    Returns:
        Objects, most confident first.

    >>> from semfov.zoom.looks import Window, WindowLook
    >>> def look(magnification, box):
    ...     found = Detections(torch.tensor([[box]]), torch.tensor([[[0.3, 0.7]]]), torch.tensor([[True]]))
    ...     window = Window((100.0, 100.0, magnification), 0, (0, 0, 8, 8))
    ...     return WindowLook(window, found, torch.tensor([False]), torch.zeros(1), None)
    >>> merge([look(0.2, [10.0, 10, 50, 50]), look(0.8, [11.0, 12, 51, 50])]).boxes
    tensor([[11., 12., 51., 50.]])
    """
    if not looks:
        return Objects.none()
    every = _detected(looks, target, shares=False)
    objects = merge_looks(*every, score=score, iou=iou, inside=inside)
    boxes, scores, labels, *_ = every
    highest = _highest_scores(objects, boxes, scores, labels, iou)
    return replace(objects, scores=highest)[highest.argsort(descending=True, stable=True)]


def _highest_scores(objects: Objects, boxes: Tensor, scores: Tensor, labels: Tensor, iou: float) -> Tensor:
    """The highest score of a box of the same class that overlaps each object enough; boxes `(L, 4)` → `(M,)`."""
    count = len(objects)
    corners = torch.cat([objects.boxes, boxes.to(objects.boxes)]).float().numpy()
    object_, box, shared, area = _overlapping(corners)
    pairs = (object_ < count) & (box >= count)
    object_, box, shared = object_[pairs], box[pairs], shared[pairs]
    union = area[object_] + area[box] - shared
    same = (shared >= iou * union) & (objects.labels.numpy()[object_] == labels.numpy()[box - count])
    highest = objects.scores.numpy().copy()
    np.maximum.at(highest, object_[same], scores.numpy()[box[same] - count])
    return torch.from_numpy(highest)


def merge_with_facts(
    window_looks: Sequence[WindowLook],
    lattice: Lattice,
    target: int | Sequence[int] | None = None,
    *,
    latest: bool = False,
) -> tuple[Objects, Tensor]:
    """Merge detections as `merge` does, with mean boxes (`_fused`) in still pictures, and list facts of the objects."""
    if not window_looks:
        return Objects.none(), torch.zeros(0, len(FACTS))
    every = _detected(window_looks, target, shares=True)
    # Fainter boxes say nothing that the absence of a box does not.
    enough = every[1] >= FAINTEST
    boxes, scores, labels, looks, cut, sharpness = every = tuple(each[enough] for each in every)
    index = unlike(*every, inside=_INSIDE)
    windows = torch.tensor([look.window.region(lattice) for look in window_looks])
    scale = torch.tensor([look.window.fixation[2] for look in window_looks])
    facts = _object_facts(index, every, windows, scale, lattice.size, lattice.magnifications[-1], latest=latest)
    own = boxes[index] if latest else _fused(index, boxes, scores, labels, cut, sharpness)
    return Objects(own, scores[index], labels[index], looks[index]), facts


def _fused(index: Tensor, boxes: Tensor, scores: Tensor, labels: Tensor, cut: Tensor, magnifications: Tensor) -> Tensor:
    r"""Mean box of each object over the looks that show it whole, :math:`b = \sum_j s_j m_j^2 b_j / \sum_j s_j m_j^2`.

    Weighted boxes fusion (Solovyev, Wang and Gabruseva, 2021, Image and Vision Computing 107:104117), with the scores s
    and the magnifications m; index `(M,)`, boxes `(L, 4)`, others `(L,)` → `(M, 4)`.
    """
    first, second, shared, area = _overlapping(boxes.float().numpy())
    chosen, kinds, whole = index.numpy(), labels.numpy(), ~cut.numpy()
    weight = (scores * magnifications.square()).double().numpy()
    place = np.full(len(boxes), -1)
    place[chosen] = np.arange(len(chosen))
    union = area[first] + area[second] - shared
    counts = (place[first] >= 0) & whole[first] & whole[second] & (kinds[first] == kinds[second])
    counts &= shared >= _SAME * union
    objects, others = place[first[counts]], second[counts]
    corners = boxes.double().numpy()
    total, sums = weight[chosen], corners[chosen] * weight[chosen, None]
    np.add.at(total, objects, weight[others])
    np.add.at(sums, objects, corners[others] * weight[others, None])
    return torch.from_numpy(sums / total[:, None]).to(boxes)


def probable_objects(
    looks: Sequence[WindowLook],
    lattice: Lattice,
    target: int | Sequence[int] | None,
    certainty: Certainty,
    *,
    remaining: tuple[float, float] = (0.0, 0.0),
    promised: float = 0.0,
    latest: bool = False,
) -> tuple[Objects, tuple[float, float]]:
    """Merge the detections of several looks, with probabilities as scores, and estimate what no look has shown."""
    objects = _probable(*merge_with_facts(looks, lattice, target, latest=latest), certainty)
    if not any(remaining):
        return objects, (0.0, 0.0)
    before = _probable(*merge_with_facts(looks[:1], lattice, target), certainty)
    discoveries = max(float(objects.scores.sum() - before.scores.sum()), 0.0)
    return objects, certainty.unseen(remaining, promised=promised, discoveries=discoveries)


def _probable(objects: Objects, facts: Tensor, certainty: Certainty) -> Objects:
    """Objects with their probabilities in place of their scores, the most probable first."""
    chances = certainty.probability(facts).to(objects.scores)
    return replace(objects, scores=chances)[chances.argsort(descending=True, stable=True)]


def _detected(
    window_looks: Sequence[WindowLook], target: int | Sequence[int] | None, *, shares: bool
) -> tuple[Tensor, ...]:
    """Boxes, scores and classes of all detections, the numbers of their looks, which are cut, and magnifications.

    Scores are those of the vectors, on which a certainty is fitted (`shares`), or the detector's own.
    """
    looks = [window_look.detections for window_look in window_looks]
    columns = zip(*((look.boxes, look.scores, look.mask, look.confidence) for look in looks), strict=True)
    detections = Detections(*(torch.cat(column, 1) for column in columns))
    scores = detections.scores[0, :, 1:] if shares else detections.class_scores[0]
    classes = [target] if isinstance(target, int) else list(target or range(1, scores.shape[-1] + 1))
    value, best = (scores * detections.mask[0, :, None])[:, [label - 1 for label in classes]].max(-1)
    label = torch.tensor(classes)[best]
    counts = torch.tensor([look.mask.shape[1] for look in looks])
    number = torch.arange(len(looks)).repeat_interleave(counts)
    closer = torch.tensor([window_look.window.fixation[2] for window_look in window_looks]).to(value)[number]
    return (
        detections.boxes[0],
        value,
        label,
        number,
        torch.cat([window_look.cut for window_look in window_looks]),
        closer,
    )


def _object_facts(
    index: Tensor,
    every: Sequence[Tensor],
    windows: Tensor,
    scales: Tensor,
    size: tuple[int, int],
    finest: float,
    *,
    latest: bool = False,
) -> Tensor:
    """Facts `(M, 14)` about the objects `index` `(M,)` (`FACTS`), from boxes `(L, 4)` of looks at windows `(N, 4)`."""
    (boxes, scores, labels, looks, cut, *_), count = every, len(index)
    if not count:
        return scores.new_zeros(0, len(FACTS))
    corners, value, label, look, broken, view, scale, chosen = (
        each.numpy()
        for each in (boxes.float(), scores.float(), labels, looks, cut, windows.float(), scales.float(), index)
    )
    first, second, shared, area = _overlapping(corners)
    union = area[first] + area[second] - shared
    overlap = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)
    part = shared / np.maximum(area[second], 1e-6)
    place = np.full(len(corners), -1)
    place[chosen] = np.arange(count)
    object_, same = place[first] >= 0, label[first] == label[second]
    whole = object_ & same & (overlap >= 0.5)
    shows = whole | (object_ & same & broken[second] & (part >= 0.8) & (look[first] != look[second]))

    # The highest score of each object in each look.
    best_of = np.zeros((count, len(view)), np.float32)
    best_of[np.arange(count), look[chosen]] = value[chosen]
    np.maximum.at(best_of, (place[first[shows]], look[second[shows]]), value[second[shows]])
    visible, side = _visible(corners[chosen], view, scale, size, latest=latest)
    detected = best_of > 0
    usable = visible | detected
    sharpness = np.where(usable, scale, 0)
    sharpest = sharpness.max(1)
    odds = _logit(best_of)
    agree = whole & ~broken[second]
    number = np.bincount(place[first[agree]], minlength=count)
    agreement = np.bincount(place[first[agree]], overlap[agree], minlength=count) / np.maximum(number, 1)
    best = odds.max(1)

    # Among objects: the better one of a pair is the one with the higher best score.
    pair = np.flatnonzero(object_ & (place[second] >= 0))
    one, other = place[first[pair]], place[second[pair]]
    worse = (best[other] > best[one]) | ((best[other] == best[one]) & (other < one))
    pair, one, other = pair[worse], one[worse], other[worse]
    weight, alike = 1 / (1 + np.exp(-best[other])), same[pair]
    near = [each[pair] * weight for each in (overlap, shared / np.maximum(area[first], 1e-6), part)]
    double, inside, around, rival = np.zeros((4, count), np.float32)
    measures = (double, near[0], alike), (inside, near[1], alike), (around, near[2], alike), (rival, near[0], ~alike)
    for into, values, which in measures:
        np.maximum.at(into, one[which], values[which])

    extent = (side + np.log2(sharpest) - 5) / 2
    facts = [
        _logit(value[chosen]),
        best,
        np.where(sharpness >= sharpest[:, None] * (1 - 1e-6), odds, -np.inf).max(1),
        np.log1p(detected.sum(1)),
        np.log1p((visible & ~detected).sum(1)),
        broken[chosen],
        extent,
        extent**2,
        np.where(number > 0, agreement - 0.6, 0),
        double,
        inside,
        around,
        np.maximum(math.log2(finest) - np.log2(sharpest), 0),
        rival,
    ]
    return torch.from_numpy(np.stack(facts, -1).astype(np.float32))


def _logit(scores: NDArray[np.float32]) -> NDArray[np.float32]:
    inside = np.clip(scores, _LEAST, _MOST)
    return np.log(inside / (1 - inside))


def _overlapping(
    boxes: NDArray[np.float32],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """Pairs of boxes that overlap, in both orders, the areas that they share `(P,)`, and the areas of all `(L,)`."""
    x1, y1, x2, y2 = np.ascontiguousarray(boxes.T)
    order = x1.argsort(kind="stable")
    one, other = neighbours(x1[order], x2[order])
    one, other = order[one], order[other]
    shared = intersection(x1, y1, x2, y2, one, other)
    meets = shared > 0
    one, other, shared = one[meets], other[meets], shared[meets]
    area = np.maximum(x2 - x1, 0) * np.maximum(y2 - y1, 0)
    return np.concatenate([one, other]), np.concatenate([other, one]), np.concatenate([shared, shared]), area


def _visible(
    boxes: NDArray[np.float32],
    windows: NDArray[np.float32],
    scale: NDArray[np.float32],
    size: tuple[int, int],
    *,
    latest: bool,
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which looks should show each box, `(M, N)`, and the logarithms (base 2) of the sides of the boxes, `(M,)`."""
    side = np.log2(np.maximum(boxes[:, 2:] - boxes[:, :2], 1e-3)).mean(1)
    # The border of the picture cuts no object.
    low = np.where(windows[:, :2] > 0, windows[:, :2] + _EDGE / scale[:, None], -np.inf)
    high = np.where(windows[:, 2:] < np.array(size) - 0.5, windows[:, 2:] - _EDGE / scale[:, None], np.inf)
    inside = (boxes[:, None, :2] >= low).all(-1) & (boxes[:, None, 2:] <= high).all(-1)
    visible = inside & (side[:, None] + np.log2(scale) >= math.log2(_SMALLEST))
    if latest:
        for number in range(len(scale) - 1):
            later = visible[:, number + 1 :] & (scale[number + 1 :] >= scale[number])
            visible[:, number] &= ~later.any(1)
    return visible, side

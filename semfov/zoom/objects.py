"""Objects of a large picture, merged from the detections of several windows."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.objects import FAINTEST, Objects, merge_looks, unlike
from semfov.observation.matching import box_iou
from semfov.zoom.certainty import FACTS, Certainty, object_facts, overlapping
from semfov.zoom.glances import Glance
from semfov.zoom.lattice import Lattice

_INSIDE = 0.5
"""Share of the area of a cut box from which on it is the same object as a box of another look that it lies in."""

_SAME = 0.5


def without_replaced(glances: Sequence[Glance], lattice: Lattice) -> list[Glance]:
    """The looks at a stream, without the detections whose place a later look has shown as closely.

    What moves would otherwise be shown at every place where a look saw it. A box counts as shown if it lies in the
    window with half its size around it, as far as the picture reaches.
    """
    current = []
    for number, glance in enumerate(glances):
        detections, left = glance.detections, glance.detections.mask[0]
        low, high = detections.boxes[0].split(2, -1)
        around = (high - low) / 2
        low, high = (low - around).clamp(min=0), (high + around).minimum(low.new_tensor(lattice.size))
        for later in (each.window for each in glances[number + 1 :]):
            if later.fixation[2] >= glance.window.fixation[2]:
                first, last = low.new_tensor(later.region(lattice)).split(2)
                left = left & ~((low >= first) & (high <= last)).all(-1)
        remaining = Detections(detections.boxes[:, left], detections.scores[:, left], detections.mask[:, left])
        current.append(replace(glance, detections=remaining, cut=glance.cut[left]))
    return current


def merge(
    glances: Sequence[Glance],
    target: int | Sequence[int] | None = None,
    *,
    score: float = FAINTEST,
    iou: float = 0.5,
    inside: float = 0.8,
) -> Objects:
    """Merge the detections of several looks at windows into one box for each object.

    The rule is that of `semfov.detection.objects.merge_looks`; the look with the higher magnification is the sharper
    one.

    Args:
        glances: looks at one picture.
        target: class 1..K, whose score counts for every box; of several classes, the best one for each box. None, or
            no class, takes the best class of each box.
        score: boxes with a lower score are left out.
        iou: intersection over union from which on two boxes are the same object.
        inside: share of the area of a cut box from which on it is the same object.

    Returns:
        Objects, most confident first.

    >>> from semfov.zoom.glances import Glance, Window
    >>> def look(magnification, box):
    ...     found = Detections(torch.tensor([[box]]), torch.tensor([[[0.3, 0.7]]]), torch.tensor([[True]]))
    ...     window = Window((100.0, 100.0, magnification), 0, (0, 0, 8, 8))
    ...     return Glance(window, found, torch.tensor([False]), torch.zeros(1), None)
    >>> merge([look(0.2, [10.0, 10, 50, 50]), look(0.8, [11.0, 12, 51, 50])]).boxes
    tensor([[11., 12., 51., 50.]])
    """
    if not glances:
        return Objects.none()
    return merge_looks(*_detected(glances, target), score=score, iou=iou, inside=inside)


def merge_with_facts(
    glances: Sequence[Glance],
    lattice: Lattice,
    target: int | Sequence[int] | None = None,
    *,
    latest: bool = False,
) -> tuple[Objects, Tensor]:
    """Merge the detections of several looks as `merge` does, and list the facts about each object.

    A cut box is the same object as one of another look from half of its area on, and the box of an object is the mean
    over the looks that show it (`fused`), except in a stream.
    """
    if not glances:
        return Objects.none(), torch.zeros(0, len(FACTS))
    every = _detected(glances, target)
    # Fainter boxes say nothing that the absence of a box does not.
    enough = every[1] >= FAINTEST
    boxes, scores, labels, looks, cut, sharpness = (each[enough] for each in every)
    index = unlike(boxes, scores, labels, looks, cut, sharpness, inside=_INSIDE)
    windows = torch.tensor([glance.window.region(lattice) for glance in glances])
    scale = torch.tensor([glance.window.fixation[2] for glance in glances])
    finest = lattice.magnifications[-1]
    facts = object_facts(index, boxes, scores, labels, looks, cut, windows, scale, lattice.size, finest, latest=latest)
    own = boxes[index] if latest else fused(index, boxes, scores, labels, cut, sharpness)
    return Objects(own, scores[index], labels[index], looks[index]), facts


def fused(index: Tensor, boxes: Tensor, scores: Tensor, labels: Tensor, cut: Tensor, magnifications: Tensor) -> Tensor:
    r"""Mean box of each object over the looks that show it whole, as in weighted boxes fusion.

    The box j of its class counts if it overlaps that of the object by half, with its score s and the number of canvas
    pixels that show a pixel of the picture, the square of the magnification m:

    .. math:: b = \frac{\sum_j s_j m_j^2 b_j}{\sum_j s_j m_j^2}

    Solovyev, R., Wang, W. and Gabruseva, T. (2021), Weighted boxes fusion: ensembling boxes from different object
    detection models, Image and Vision Computing 107:104117.

    Shapes: index `(M,)`, boxes `(L, 4)`, scores `(L,)`, labels `(L,)`, cut `(L,)`, magnifications `(L,)` → `(M, 4)`.
    """
    first, second, shared, area = overlapping(boxes.float().numpy())
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
    glances: Sequence[Glance],
    lattice: Lattice,
    target: int | Sequence[int] | None,
    certainty: Certainty,
    *,
    remaining: tuple[float, float] = (0.0, 0.0),
    promised: float = 0.0,
    latest: bool = False,
) -> tuple[Objects, tuple[float, float]]:
    """Merge the detections of several looks, with probabilities as scores, and estimate what no look has shown."""
    objects = _probable(*merge_with_facts(glances, lattice, target, latest=latest), certainty)
    if not any(remaining):
        return objects, (0.0, 0.0)
    before = _probable(*merge_with_facts(glances[:1], lattice, target), certainty)
    discoveries = max(float(objects.scores.sum() - before.scores.sum()), 0.0)
    return objects, certainty.unseen(remaining, promised=promised, discoveries=discoveries)


def shown(objects: Objects, glances: Sequence[Glance], target: int | Sequence[int] | None, score: float) -> Tensor:
    """Which objects some looks show with a score: the one that a box of its class overlaps most, by half; → `(M,)`."""
    counts = torch.zeros(len(objects), dtype=torch.bool)
    if len(objects) and glances:
        boxes, scores, labels, *_ = _detected(glances, target)
        sure = scores >= score
        overlap = box_iou(objects.boxes, boxes[sure].to(objects.boxes)) * (objects.labels[:, None] == labels[sure])
        best, place = overlap.max(0)
        counts[place[best >= _SAME]] = True
    return counts


def _probable(objects: Objects, facts: Tensor, certainty: Certainty) -> Objects:
    """Objects with their probabilities in place of their scores, the most probable first."""
    chances = certainty.probability(facts).to(objects.scores)
    return replace(objects, scores=chances)[chances.argsort(descending=True, stable=True)]


def _detected(glances: Sequence[Glance], target: int | Sequence[int] | None) -> tuple[Tensor, ...]:
    """Boxes, scores and classes of all detections, the numbers of their looks, which are cut, and magnifications."""
    looks = [glance.detections for glance in glances]
    detections = Detections(
        torch.cat([look.boxes for look in looks], 1),
        torch.cat([look.scores for look in looks], 1),
        torch.cat([look.mask for look in looks], 1),
    )
    value, label = detections.confidence[0], detections.labels[0]
    classes = [target] if isinstance(target, int) else list(target or ())
    if classes:
        value, best = detections.scores[0][:, classes].max(-1)
        label = torch.tensor(classes)[best]
    counts = torch.tensor([look.mask.shape[1] for look in looks])
    number = torch.arange(len(looks)).repeat_interleave(counts)
    closer = torch.tensor([glance.window.fixation[2] for glance in glances]).to(value)[number]
    return detections.boxes[0], value, label, number, torch.cat([glance.cut for glance in glances]), closer

"""Objects of a large picture, merged from the detections of several windows.

    looks                      box of an object                        its score
    -------------------------  --------------------------------------  ---------------------------------------------
    with evidence              mean of the looks that show it whole    probability that it is there, by its facts
    (`merge_with_facts`)                                               (`semfov.zoom.certainty`)
    without (`merge`)          that of the sharpest look               the highest of all looks
    at a stream that forgets,  where the tracker has it                probability that it is there, times that its
    with evidence              (`semfov.tracking`)                     box fits (`Tracks.probability`)
    without                    that of the sharpest recent look        the highest of recent looks

Boxes of one class that overlap, or of which one is cut and lies in the other, are of one object.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.objects import FAINTEST, SCORE_THRESHOLD, Objects, merge_looks, survivors, unlike
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou
from semfov.zoom.certainty import FACTS, Certainty
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import WindowLook
from semfov.zoom.object_facts import DetectedBoxes, Overlaps, object_facts, object_of_box

_INSIDE = 0.5
"""Share of the area of a cut box from which on it is the same object as a box of another look that it lies in."""


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
    detected = detected_boxes(looks, target, shares=False)
    objects = merge_looks(*detected, score=score, iou=iou, inside=inside)
    highest = _highest_scores(objects, detected, iou)
    return replace(objects, scores=highest)[highest.argsort(descending=True, stable=True)]


def without_parts(
    objects: Objects,
    looks: Sequence[WindowLook],
    target: int | Sequence[int] | None = None,
    *,
    iou: float = 0.5,
    inside: float = 0.8,
) -> Objects:
    """Drop objects of enlarged looks that lie inside or around a more confident object of their class.

    In an enlarged window a detector takes parts of an object, and several objects together, for one of its class. A
    certainty that was fitted knows that; scores do not. What a look at the whole picture shows with `SCORE_THRESHOLD`
    or more, or as surely as others, stays, so that all objects are listed that the bare detector shows.

    Args:
        objects: the objects, most confident first (`merge`).
        looks: the looks that show them.
        target: class 1..K, or several, as for `merge`.
        iou: intersection over union from which on a look at the whole picture shows an object.
        inside: share of the smaller of two boxes from which on it lies in the other.

    Returns:
        The objects that are left.
    """
    labels = objects.labels
    at_whole = merge([look for look in looks if look.window.is_overview], target)
    is_same = (box_iou(objects.boxes, at_whole.boxes) >= iou) & (labels[:, None] == at_whole.labels)
    # A part that an enlarged look is sure of is often there faintly in the whole picture, too.
    is_sure = at_whole.scores >= objects.scores[:, None].clamp(max=SCORE_THRESHOLD)
    stays = (is_same & is_sure).any(-1).numpy()
    overlaps = Overlaps.among(objects.boxes.float().numpy())
    better = overlaps.first
    worse = overlaps.second
    smaller = np.minimum(overlaps.area[better], overlaps.area[worse])
    # Pairs stand in both orders, and the more confident object has the lower index.
    is_part = (overlaps.shared >= inside * smaller) & (better < worse) & ~stays[worse]
    is_part &= labels.numpy()[better] == labels.numpy()[worse]
    return objects[torch.from_numpy(survivors(len(objects), better[is_part], worse[is_part]))]


def _highest_scores(objects: Objects, detected: DetectedBoxes, iou: float) -> Tensor:
    """Find the highest score of a box of the same class that overlaps each object enough; → `(M,)`."""
    count = len(objects)
    corners = torch.cat([objects.boxes, detected.boxes.to(objects.boxes)]).float().numpy()
    overlaps = Overlaps.among(corners)
    pairs = (overlaps.first < count) & (overlaps.second >= count)
    object_ = overlaps.first[pairs]
    box = overlaps.second[pairs] - count
    overlaps_enough = overlaps.shared[pairs] >= iou * overlaps.union[pairs]
    same = overlaps_enough & (objects.labels.numpy()[object_] == detected.labels.numpy()[box])
    # A copy, as the array shares the memory of the scores.
    highest = objects.scores.numpy().copy()
    np.maximum.at(highest, object_[same], detected.scores.numpy()[box[same]])
    return torch.from_numpy(highest)


def merge_with_facts(
    looks: Sequence[WindowLook],
    lattice: Lattice,
    target: int | Sequence[int] | None = None,
    *,
    latest: bool = False,
) -> tuple[Objects, Tensor]:
    """Merge detections as `merge` does, and compute features of the objects for `Certainty`.

    Args:
        looks: looks at one picture.
        lattice: windows of the picture.
        target: class 1..K, or several, as for `merge`.
        latest: whether boxes are those of the latest looks, as in a stream; else each is the mean over the looks that
            show the object whole (`_fused`).

    Returns:
        Objects and their facts `(M, 14)` (`semfov.zoom.certainty.FACTS`).
    """
    if not looks:
        return Objects.none(), torch.zeros(0, len(FACTS))
    detected = detected_boxes(looks, target, shares=True)
    # Fainter boxes say nothing that the absence of a box does not.
    detected = detected.of(detected.scores >= FAINTEST)
    index = unlike(*detected, inside=_INSIDE)
    windows = torch.tensor([look.window.region(lattice) for look in looks])
    scales = torch.tensor([look.window.fixation[2] for look in looks])
    facts = object_facts(index, detected, windows, scales, lattice.size, lattice.magnifications[-1], latest=latest)
    chosen = detected.of(index)
    boxes = chosen.boxes if latest else _fused(index, detected)
    return Objects(boxes, chosen.scores, chosen.labels, chosen.looks), facts


def _fused(index: Tensor, detected: DetectedBoxes) -> Tensor:
    r"""Average the box of each object over the looks that show it whole.

    .. math:: b = \sum_j s_j m_j^2 b_j \Big/ \sum_j s_j m_j^2

    Weighted boxes fusion (Solovyev, Wang and Gabruseva, 2021, Image and Vision Computing 107:104117), with the scores s
    and the magnifications m; index `(M,)` → `(M, 4)`.
    """
    overlaps = Overlaps.among(detected.boxes.float().numpy())
    first = overlaps.first
    second = overlaps.second
    chosen = index.numpy()
    labels = detected.labels.numpy()
    is_whole = ~detected.cut.numpy()
    object_of = object_of_box(chosen, len(detected.boxes))
    is_of_object = object_of[first] >= 0
    are_whole = is_whole[first] & is_whole[second]
    are_alike = (labels[first] == labels[second]) & (overlaps.shared >= SAME_OBJECT_IOU * overlaps.union)
    counts = is_of_object & are_whole & are_alike
    objects = object_of[first[counts]]
    others = second[counts]
    weight = (detected.scores * detected.magnifications.square()).double().numpy()
    corners = detected.boxes.double().numpy()
    # Indexing copies, so that what is added here leaves the weights of the boxes as they are.
    weights = weight[chosen]
    sums = corners[chosen] * weight[chosen, None]
    np.add.at(weights, objects, weight[others])
    np.add.at(sums, objects, corners[others] * weight[others, None])
    return torch.from_numpy(sums / weights[:, None]).to(detected.boxes)


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
    """Merge detections to objects with probabilities, and estimate the number of objects not yet seen.

    Args:
        looks: looks at one picture, the overview first.
        lattice: windows of the picture.
        target: class 1..K, or several, as for `merge`.
        certainty: probability that an object is there.
        remaining: objects that further looks are expected to find (`ZoomBelief.remaining`).
        promised: objects that the looks so far promised.
        latest: as for `merge_with_facts`.

    Returns:
        Objects, the most probable first; mean and variance of the number of those that no look has shown.
    """
    objects = _probable(*merge_with_facts(looks, lattice, target, latest=latest), certainty)
    if not any(remaining):
        return objects, (0.0, 0.0)
    before = _probable(*merge_with_facts(looks[:1], lattice, target), certainty)
    # Further looks may lower the sum, and the number of discoveries cannot be negative.
    discoveries = max(float(objects.scores.sum() - before.scores.sum()), 0.0)
    mean, variance = certainty.unseen(remaining, promised=promised, discoveries=discoveries)
    return objects, (mean.item(), variance.item())


def _probable(objects: Objects, facts: Tensor, certainty: Certainty) -> Objects:
    """Put probabilities in place of the scores of objects, the most probable first."""
    chances = certainty.probability(facts).to(objects.scores).detach()
    return replace(objects, scores=chances)[chances.argsort(descending=True, stable=True)]


def _joined(batches: Sequence[Detections]) -> Detections:
    """Put detections of single looks one after another, as those of one picture."""
    return Detections(
        boxes=torch.cat([batch.boxes for batch in batches], 1),
        scores=torch.cat([batch.scores for batch in batches], 1),
        mask=torch.cat([batch.mask for batch in batches], 1),
        confidence=torch.cat([batch.confidence for batch in batches], 1),
    )


def detected_boxes(looks: Sequence[WindowLook], target: int | Sequence[int] | None, *, shares: bool) -> DetectedBoxes:
    """Collect the boxes of all detections, each with its best class of the targets.

    Args:
        looks: looks at one picture.
        target: class 1..K, or several, as for `merge`.
        shares: whether scores are those of the vectors, on which a certainty is fitted, or the detector's own.
    """
    batches = [look.detections for look in looks]
    detections = _joined(batches)
    class_scores = detections.scores[0, :, 1:] if shares else detections.class_scores[0]
    class_scores = class_scores * detections.mask[0, :, None]  # 0 for padding
    labels = _labels_of(target, class_scores.shape[-1])
    scores, best = class_scores[:, labels - 1].max(-1)
    counts = torch.tensor([batch.mask.shape[1] for batch in batches])
    look_of_box = torch.arange(len(looks)).repeat_interleave(counts)
    magnifications = torch.tensor([look.window.fixation[2] for look in looks]).to(scores)
    return DetectedBoxes(
        boxes=detections.boxes[0],
        scores=scores,
        labels=labels[best],
        looks=look_of_box,
        cut=torch.cat([look.cut for look in looks]),
        magnifications=magnifications[look_of_box],
    )


def _labels_of(target: int | Sequence[int] | None, classes: int) -> Tensor:
    """List the classes from 1 that a target names, `(T,)`; all of them for none."""
    if isinstance(target, int):
        return torch.tensor([target])
    return torch.tensor([*target]) if target else torch.arange(1, classes + 1)

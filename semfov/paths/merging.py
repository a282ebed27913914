"""Objects of a record: merged from the detections of its looks, and confirmed by closer looks and the decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from semfov.decision import SAME, CloseUp
from semfov.detection.detections import Detections
from semfov.detection.objects import FAINTEST, Objects, merge_looks
from semfov.observation.matching import box_iou

CONFIRMED = 0.5
"""Probability from which on a closer look confirms that the target is there."""


def merge_fixations(
    looks: Sequence[Detections],
    distances: Sequence[Tensor],
    closer: Sequence[CloseUp] = (),
    *,
    cut: Sequence[Tensor] | None = None,
    around: float | None = None,
) -> Objects:
    """Merge the detections of several fixations into one box for each object (`merge_looks`).

    The nearest fixation sees a box most sharply, and a closer look more sharply still. The score of the box of a closer
    look is the probability that the target is there, so a place that a closer look has refuted is no candidate.

    >>> far, near = torch.tensor([[[0.0, 0, 10, 10]]]), torch.tensor([[[0.0, 1, 11, 10]]])
    >>> scores, one = torch.tensor([[[0.2, 0.8]]]), torch.ones(1, 1, dtype=torch.bool)
    >>> looks = Detections(far, scores, one), Detections(near, scores, one)
    >>> merge_fixations(looks, [torch.tensor([90.0]), torch.tensor([5.0])]).boxes
    tensor([[ 0.,  1., 11., 10.]])

    Shapes: distances `(L,)`, cut `(L,)`.
    """
    boxes, scores, labels, numbers, sharpness, broken = [], [], [], [], [], []
    for number, (detections, distance) in enumerate(zip(looks, distances, strict=True)):
        chosen = detections.mask[0] & (detections.confidence[0] >= FAINTEST)
        boxes.append(detections.boxes[0, chosen].detach().float().cpu())
        scores.append(detections.confidence[0, chosen].detach().float().cpu())
        labels.append(detections.labels[0, chosen].cpu())
        numbers.append(torch.full((len(boxes[-1]),), number))
        sharpness.append(-distance[chosen].detach().float().cpu())
        broken.append(torch.zeros(len(boxes[-1])).bool() if cut is None else cut[number][chosen].cpu())
    for look in closer:
        boxes.append(look.box[None].detach().float().cpu())
        scores.append(torch.tensor([look.place]))
        labels.append(torch.tensor([look.target]))
        numbers.append(torch.tensor([number_of(look)]))
        sharpness.append(torch.tensor([1.0]))
        broken.append(torch.tensor([False]))
    if not boxes:
        return Objects.none()
    columns = (torch.cat(column) for column in (boxes, scores, labels, numbers, broken, sharpness))
    return merge_looks(*columns, score=0.0, around=around).above(FAINTEST)


def distances_to(boxes: Tensor, point: Tensor) -> Tensor:
    """Distance of a point to boxes; 0 inside a box; boxes `(L, 4)`, point `(2,)` → `(L,)`.

    >>> distances_to(torch.tensor([[10.0, 10, 20, 20], [0, 0, 4, 5]]), torch.tensor([6.5, 8.5])).tolist()
    [3.1622776985168457, 5.0]
    """
    at = (point + 0.5).to(boxes)
    beside = torch.maximum(boxes[:, :2] - at, at - boxes[:, 2:]).clamp(min=0)
    return torch.linalg.vector_norm(beside, dim=-1)


def number_of(look: CloseUp) -> int:
    """Number of the look that a closer look is, or after which it was made."""
    return (look.fixation if look.number is None else look.number) or 0


def confirm(
    candidates: Objects,
    places: Sequence[tuple[Tensor, int, float, int]],
    counting: Callable[[Objects], Tensor],
) -> tuple[Objects, Tensor]:
    """The candidates that count, and those that were confirmed; and which of all these were, `(M,)`."""
    boxes, scores, labels, looks = candidates.boxes, candidates.scores, candidates.labels, candidates.passes
    sure, counts = torch.zeros(len(candidates), dtype=torch.bool), counting(candidates)
    for place, label, chance, look in places:
        box, probability = place[None].to(boxes), scores.new_tensor([chance])
        overlap = box_iou(boxes, box)[:, 0].masked_fill(labels != label, 0)
        same = overlap.argmax()[None] if len(overlap) else overlap.long()
        if not bool((overlap[same] >= SAME).any()):
            same = torch.tensor([len(boxes)])
            boxes, scores = torch.cat([boxes, box]), torch.cat([scores, probability])
            labels = torch.cat([labels, labels.new_tensor([label])])
            looks = torch.cat([looks, looks.new_tensor([look])])
            sure, counts = (torch.cat([each, torch.tensor([False])]) for each in (sure, counts))
        scores = scores.index_copy(0, same, torch.maximum(scores[same], probability))
        sure[same] = True
    order = scores.argsort(descending=True, stable=True)
    order = order[(counts | sure)[order]]
    return Objects(boxes, scores, labels, looks)[order], sure[order]

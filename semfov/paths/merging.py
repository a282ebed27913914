"""Objects of a record, merged from the detections of its looks."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.decision import CloseUp
from semfov.detection.detections import Detections
from semfov.detection.objects import FAINTEST, Objects, merge_looks


def merge_fixations(
    looks: Sequence[Detections],
    distances: Sequence[Tensor],
    closer: Sequence[CloseUp] = (),
    *,
    cut: Sequence[Tensor] | None = None,
    around: float | None = None,
) -> Objects:
    """Merge the detections of fixations and closer looks into one box for each object; distances and cut `(L,)`.

    The nearest fixation sees a box most sharply, and a closer look more sharply still.
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
        numbers.append(torch.tensor([look.of_look]))
        sharpness.append(torch.tensor([1.0]))
        broken.append(torch.tensor([False]))
    if not boxes:
        return Objects.none()
    columns = (torch.cat(column) for column in (boxes, scores, labels, numbers, broken, sharpness))
    return merge_looks(*columns, score=0.0, around=around).above(FAINTEST)


def distances_to(boxes: Tensor, point: Tensor) -> Tensor:
    """Distance of a point `(2,)` to boxes `(L, 4)`, `(L,)`; 0 inside a box."""
    at = (point + 0.5).to(boxes)
    beside = torch.maximum(boxes[:, :2] - at, at - boxes[:, 2:]).clamp(min=0)
    return torch.linalg.vector_norm(beside, dim=-1)

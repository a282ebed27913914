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
    """Merge detections `(L,)` of fixations, the nearest the sharpest, and closer looks, sharper still, into objects."""
    rows = []
    for number, (seen, distance) in enumerate(zip(looks, distances, strict=True)):
        chosen = seen.mask[0] & (seen.confidence[0] >= FAINTEST)
        broken = torch.zeros_like(chosen) if cut is None else cut[number]
        every = seen.boxes[0], seen.confidence[0], seen.labels[0], torch.full_like(chosen, number, dtype=torch.int64)
        rows.append([each[chosen].detach().cpu() for each in (*every, broken, -distance)])
    for look in closer:
        place = [torch.tensor([each]) for each in (look.place, look.target, look.of_look, False, 1.0)]
        rows.append([look.box[None].detach().cpu(), *place])
    if not rows:
        return Objects.none()
    columns = (torch.cat(each) for each in zip(*rows, strict=True))
    columns = (each.float() if each.is_floating_point() else each for each in columns)
    return merge_looks(*columns, score=0.0, around=around).above(FAINTEST)


def distances_to(boxes: Tensor, point: Tensor) -> Tensor:
    """Distance of a point `(2,)` to boxes `(L, 4)`, `(L,)`; 0 inside a box."""
    at = (point + 0.5).to(boxes)
    beside = torch.maximum(boxes[:, :2] - at, at - boxes[:, 2:]).clamp(min=0)
    return torch.linalg.vector_norm(beside, dim=-1)

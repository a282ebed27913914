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
    numbers: Sequence[int] | None = None,
) -> Objects:
    """Merge the detections of fixations and of closer looks into objects.

    Of several boxes of one object the one of the nearest fixation is kept, as it was seen the most sharply. Closer
    looks are sharper still.

    Args:
        looks: detections of each look, batches of one.
        distances: `(L,)` for each look, distances of the fixation to the boxes.
        closer: closer looks.
        cut: `(L,)` boolean for each look, boxes that the border of the view cuts; None for none.
        around: width in pixels after which the picture repeats; None for other pictures.
        numbers: number of each of the looks; None for 0 to n - 1.

    Returns:
        The objects from score 0.05 on, most confident first.
    """
    rows = []
    for place, (detections, distance) in enumerate(zip(looks, distances, strict=True)):
        number = place if numbers is None else numbers[place]
        chosen = detections.mask[0] & (detections.confidence[0] >= FAINTEST)
        columns = (
            detections.boxes[0],
            detections.confidence[0],
            detections.labels[0],
            torch.full_like(chosen, number, dtype=torch.int64),
            torch.zeros_like(chosen) if cut is None else cut[place],
            -distance,
        )
        rows.append([column[chosen].detach().cpu() for column in columns])
    for look in closer:
        # No distance is above 0, so that a closer look is nearer than all fixations.
        values = (look.place, look.target, look.of_look, False, 1.0)
        rows.append([look.box[None].detach().cpu(), *(torch.tensor([value]) for value in values)])
    if not rows:
        return Objects.none()
    merged = [_single(torch.cat(column)) for column in zip(*rows, strict=True)]
    return merge_looks(*merged, score=0.0, around=around).above(FAINTEST)


def _single(column: Tensor) -> Tensor:
    """Convert numbers of any precision to single precision; others stay."""
    return column.float() if column.is_floating_point() else column


def distances_to(boxes: Tensor, point: Tensor) -> Tensor:
    """Compute the distance of a point to boxes.

    Args:
        boxes: `(L, 4)`.
        point: `(2,)`, with pixel centres at integers.

    Returns:
        `(L,)`, 0 inside a box.
    """
    point = (point + 0.5).to(boxes)
    outside = torch.maximum(boxes[:, :2] - point, point - boxes[:, 2:]).clamp(min=0)
    return torch.linalg.vector_norm(outside, dim=-1)

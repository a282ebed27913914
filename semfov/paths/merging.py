"""Objects of a record, merged from the detections of its looks."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.decision import CloseUp
from semfov.detection.detections import Detections
from semfov.detection.objects import FAINTEST, Objects, merge_looks


class FixationBoxes(NamedTuple):
    """The detections of a fixation, as they are merged.

    Attributes:
        detections: a batch of one, of L boxes.
        distances: `(L,)`, distances of the fixation to the boxes.
        look: index of the look.
        cut: `(L,)` boolean, boxes that the border of the view cuts; None for none.
    """

    detections: Detections
    distances: Tensor
    look: int
    cut: Tensor | None = None


def merge_fixations(
    fixations: Iterable[FixationBoxes], closer: Sequence[CloseUp], *, around: float | None = None
) -> Objects:
    """Merge the detections of fixations and of closer looks into objects.

    Of several boxes of one object the one of the nearest fixation is kept, as it was seen the most sharply. Closer
    looks are sharper still.

    Args:
        fixations: the detections of each.
        closer: closer looks.
        around: width in pixels after which the picture repeats; None for other pictures.

    Returns:
        The objects from score 0.05 on, most confident first.
    """
    rows = [_columns_of_fixation(fixation) for fixation in fixations]
    rows += [_columns_of_closer_look(look) for look in closer]
    if not rows:
        return Objects.none()
    merged = [_single(torch.cat(column)) for column in zip(*rows, strict=True)]
    # Closer looks of any probability take part: one that refutes an object removes the boxes of fixations there.
    return merge_looks(*merged, score=0.0, around=around).above(FAINTEST)


def _columns_of_fixation(fixation: FixationBoxes) -> list[Tensor]:
    """Make the columns that `merge_looks` takes of the detections of a fixation, the nearer the sharper."""
    detections = fixation.detections
    confidence = detections.confidence[0]  # (L,), as all columns but the boxes
    chosen = detections.mask[0] & (confidence >= FAINTEST)
    looks = torch.full_like(chosen, fixation.look, dtype=torch.int64)
    cut = torch.zeros_like(chosen) if fixation.cut is None else fixation.cut
    # The last one is the sharpness: a fovea shows most where it looks.
    columns = (detections.boxes[0], confidence, detections.labels[0], looks, cut, -fixation.distances)
    return [column[chosen].detach().cpu() for column in columns]


def _columns_of_closer_look(look: CloseUp) -> list[Tensor]:
    """Make the columns of the box of a closer look, which is sharper than all fixations."""
    # The sharpness of a fixation is a distance with a minus, at most 0.
    values = (look.place, look.target, look.index_of_look, False, 1.0)
    return [look.box[None].detach().cpu(), *(torch.tensor([value]) for value in values)]


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
    point = (point + 0.5).to(boxes)  # from the border of a pixel, as the edges of boxes
    outside = torch.maximum(boxes[:, :2] - point, point - boxes[:, 2:]).clamp(min=0)  # (L, 2), along x and y
    return torch.linalg.vector_norm(outside, dim=-1)

"""What detections show of a target in the cells of a grid."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.errors import check, check_finite, check_shape


def strength(detections: Detections, grid: Grid, target: int) -> Tensor:
    """Evidence of the detections of one look for the target in each cell, `(X·Y,)`: score times `soft` footprint."""
    scores = detections.mask[0] * detections.scores[0, :, target]
    by_detection = grid.footprint(detections.boxes, "soft")[0] * scores[:, None]
    return by_detection.amax(0) if len(by_detection) else by_detection.sum(0)


def strongest(looks: Sequence[Detections], grid: Grid, cell: int, target: int) -> tuple[float, Tensor | None]:
    """Detection with the strongest evidence for the target in a cell: score times `soft` footprint; → `(4,)`."""
    evidence, box = 0.0, None
    for look in looks:
        weight = grid.footprint(look.boxes, "soft")[0, :, cell] * look.mask[0]
        scores = weight * look.scores[0, :, target]
        if scores.numel() and float(scores.max()) > evidence:
            evidence, box = float(scores.max()), look.boxes[0, int(scores.argmax())]
    return evidence, box


def confirms(detections: Detections, grid: Grid, cell: Tensor, target: int, score: float) -> Tensor:
    """Whether a detection over each cell `(B,)` has `target` as its best class with at least this score, `(B,)`."""
    sure = (detections.scores.argmax(-1) == target) & (detections.scores[..., target] >= score) & detections.mask
    there = grid.footprint(detections.boxes).take_along_dim(cell[:, None, None], -1)[..., 0]
    return (there & sure).any(-1)


def goal_cells(boxes: Tensor | Sequence[Sequence[float]], grid: Grid, like: Tensor) -> Tensor:
    """Cells that boxes overlap; by the protocol of the paper a search ends when it fixates one of them.

    Shapes: boxes `(M, 4)` → `(X·Y,)`.
    """
    tensor = torch.as_tensor(boxes).to(like)
    check_shape(tensor, "boxes", None, 4)
    check(tensor.ndim == 2, "boxes", "shape (M, 4)", tuple(tensor.shape))
    check_finite(tensor, "boxes")
    full = bool((tensor[:, 2:] > tensor[:, :2]).all())
    check(
        full,
        "boxes",
        "(x1, y1, x2, y2) with x1 < x2 and y1 < y2",
        "others; convert (x, y, width, height) to (x, y, x + width, y + height)",
    )
    return grid.footprint(tensor).any(-2)


def cell_of(box: Tensor, grid: Grid) -> int:
    """The cell that a box `(4,)` covers most (its `soft` footprint)."""
    return int(grid.footprint(box[None], "soft")[0].argmax())

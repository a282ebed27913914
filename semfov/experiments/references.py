"""What a map is held against: one sharp look at the whole picture by the same detector."""

from collections.abc import Mapping

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic
from semfov.detection.detections import Detections

FUSED, PAINTED = "one sharp look, fused", "one sharp look, boxes"

# Of 0.2, 0.3 and 0.4 the score that named most cells right, background an answer, on photographs to learn from.
_SURE = 0.2


def sharp_maps(sharp: Detections, grid: Grid) -> Mapping[str, Tensor]:
    """Maps that one look at the whole picture gives, `(1, X·Y, K+1)`, by the name that tables have for them.

    - fused: scores are likelihoods, fused by Kaplan's rule from a uniform prior, as published.
    - boxes: every cell that a box overlaps gets its scores, the highest ones where boxes share it; background where
      none is higher than 0.2.

    Args:
        sharp: what the detector sees, a batch of one.
        grid: the cells.
    """
    observer = Semantic(sharp.scores.shape[-1])
    middle = grid.centres.to(sharp.scores).mean(0, keepdim=True)
    fused = observer(observer.start(1, grid, sharp.scores), sharp, middle, grid)
    cells = grid.footprint(sharp.boxes) & sharp.mask[..., None]
    scores = sharp.scores[..., 1:] * sharp.mask[..., None]
    each = cells[..., None] * scores[:, :, None]
    highest = each.amax(1) if each.shape[1] else each.sum(1)
    background = torch.full_like(highest[..., :1], _SURE)
    return {FUSED: fused.class_probabilities(), PAINTED: torch.cat([background, highest], -1)}

"""Reference maps for explorations: one sharp look at the whole picture with the same detector."""

from collections.abc import Mapping

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic
from semfov.detection.detections import Detections

FUSED, PAINTED = "one sharp look, fused", "one sharp look, boxes"

# Among 0.2, 0.3 and 0.4, the score that named most cells right on the fit set, with background as an answer.
_SURE = 0.2


def sharp_maps(sharp: Detections, grid: Grid) -> Mapping[str, Tensor]:
    """Maps of what is where from one sharp look at the whole picture.

    - fused: scores are used as likelihoods and fused by Kaplan's rule from a uniform prior, as published.
    - boxes: every cell gets the scores of the boxes that overlap it, class by class the highest; its answer is
      background where no score is higher than 0.2.

    Args:
        sharp: detections in the sharp picture, a batch of one.
        grid: the grid over the picture.

    Returns:
        Maps `(1, X·Y, K+1)` by their names in tables.
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

"""Features of looks for a target in each cell: the inputs of learned evidence, with the same meaning for any class."""

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.errors import check, check_shape
from semfov.threads import one_thread_if_small

LOOK_FEATURES = 10
_FLOOR = 1e-6


def highest_score(detections: Detections, target: int | Tensor) -> Tensor:
    """Find the highest score of classes among the detections of each look.

    Args:
        detections: a batch of B looks.
        target: a class, or classes `(T,)`.

    Returns:
        `(B,)`, or `(B, T)`; 0 without detections.
    """
    scores = detections.scores * detections.mask[..., None]
    highest = scores.amax(1) if scores.shape[1] else scores.new_zeros(len(scores), scores.shape[-1])
    return highest[..., target]


def look_features(detections: Detections, fixation: Tensor, grid: Grid, target: int) -> Tensor:
    r"""Describe the evidence of looks for a target in every cell by ten features of about unit size, `(B, X·Y, 10)`.

    With the scores :math:`s_l` of detection l, its weight :math:`w_l` in the cell (the `soft` footprint of `Grid`), and
    the detection b of the largest :math:`s_{lt} w_l`, they are: the distance of the fixation; :math:`\ln s_{bt} w_b`;
    :math:`\ln \max_l s_{lt}` of those that overlap the cell; of b the objectness :math:`1 - s_{b0}`, the weight, the
    size, and the share of the target; :math:`\max_l (1 - s_{l0}) w_l`; :math:`\max_l (1 - s_{l0} - s_{lt}) w_l`; and
    whether nothing overlaps the cell.
    """
    components = detections.scores.shape[-1]
    check(1 <= target < components, "target", f"a class from 1 to {components - 1}", target)
    targets = torch.tensor([target], device=fixation.device)
    return class_features(detections, fixation, grid, targets)[:, 0]


@one_thread_if_small
def class_features(detections: Detections, fixation: Tensor, grid: Grid, targets: Tensor) -> Tensor:
    """Compute `look_features` for several classes.

    Args:
        detections: a batch `(B, L)` of looks, boxes in pixels of the grid's image.
        fixation: `(B, 2)`, as `(x, y)` in pixels.
        grid: the cells of one image.
        targets: `(T,)`, classes 1..K.

    Returns:
        `(B, T, X·Y, 10)`.
    """
    batch = detections.mask.shape[0]
    check_shape(fixation, "fixation", batch, 2)
    components = detections.scores.shape[-1]
    distance = grid.distance(fixation)[:, None]
    if detections.mask.shape[1] == 0:
        nothing = fixation.new_zeros(batch, 1, components)
        detections = Detections(fixation.new_zeros(batch, 1, 4), nothing, nothing[..., 0].bool())
    # Dimensions: looks, classes, detections, cells.
    weight = (grid.footprint(detections.boxes, "soft") * detections.mask[..., None])[:, None]
    touches = weight > 0
    score = detections.scores[..., targets].transpose(1, 2)[..., None]
    objectness = (1 - detections.scores[..., 0]).clamp(min=_FLOOR)[:, None, :, None]
    strongest, best = (score * weight).max(2)

    def of_best(values: Tensor) -> Tensor:
        """Select the value of the best detection of each class in each cell, from `(B, 1 or T, L, 1 or X·Y)`."""
        by_detection = values.expand(batch, len(targets), *weight.shape[2:])
        return by_detection.gather(2, best[:, :, None])[:, :, 0] * covered

    covered = touches.any(2)
    edges = detections.boxes[..., 2:] - detections.boxes[..., :2]
    size = (edges.clamp(min=0).prod(-1) / grid.extent.prod().to(edges)).sqrt()[:, None, :, None]
    features = [
        4 * distance,
        _log(strongest),
        _log((score * touches).amax(2)),
        2 * of_best(objectness),
        2 * of_best(weight),
        3 * of_best(size),
        2 * of_best(score / objectness),
        2 * (objectness * weight).amax(2),
        2 * ((objectness - score).clamp(min=0) * weight).amax(2),
        (~covered).to(weight.dtype),
    ]
    return torch.stack([feature.expand(batch, len(targets), len(grid)) for feature in features], -1)


def nothing_seen(distance: Tensor) -> Tensor:
    """Compute `look_features` `(..., 10)` of a look without detections from distances `(...)`."""
    none = torch.zeros_like(distance)
    least = _log(none)
    return torch.stack([4 * distance, least, least, none, none, none, none, none, none, none + 1], -1)


def _log(score: Tensor) -> Tensor:
    """Take the logarithm of scores, kept finite and scaled to about unit size."""
    return score.clamp(min=_FLOOR).log() / 4 + 1

"""What a look says about the classes of the cells: likelihoods, and which cells they concern."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.grid import Footprint, Grid
from semfov.detection.detections import Detections
from semfov.errors import check_shape


class Observation(Protocol):
    """A model that turns scores seen at a distance into likelihoods (`semfov.FovealObservationModel`)."""

    def calibrate(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Likelihoods `(..., K+1)` up to a common factor, for scores `(..., K+1)` at distances `(...)`."""
        ...


@dataclass(frozen=True)
class Evidence:
    """Likelihoods of a batch of looks, ready to be fused.

    Attributes:
        likelihood: `(B, L, K+1)`, likelihood of each class for each detection, up to a factor.
        footprint: `(B, L, X·Y)` boolean, the cells that each detection concerns; false for padding.
    """

    likelihood: Tensor
    footprint: Tensor

    def __getitem__(self, index: Tensor | slice | tuple[Tensor, ...]) -> "Evidence":
        """Evidence of some of the looks."""
        return Evidence(self.likelihood[index], self.footprint[index])


def weigh(
    detections: Detections,
    fixation: Tensor,
    grid: Grid,
    observation: Observation | None = None,
    footprint: Footprint = "overlap",
) -> Evidence:
    """Evidence of the detections seen from `fixation`.

    Args:
        detections: boxes in pixels of the grid's image, batch `(B, L)`.
        fixation: `(B, 2)`, where each image of the batch was fixated.
        grid: the cells.
        observation: calibrates the scores by class and distance; None takes the raw scores as likelihoods.
        footprint: which cells a box concerns (`Grid.footprint`).
    """
    check_shape(fixation, "fixation", detections.mask.shape[0], 2)
    if observation is None:
        likelihood = detections.scores
    else:
        distance = grid.box_distance(detections.boxes, fixation)
        # Padding has no scores that a model could read: it gets a uniform vector, and covers no cell.
        uniform = torch.full_like(detections.scores, 1 / detections.scores.shape[-1])
        scores = torch.where(detections.mask[..., None], detections.scores, uniform)
        likelihood = observation.calibrate(scores, distance)
    cells = grid.footprint(detections.boxes, footprint) & detections.mask[..., None]
    return Evidence(likelihood, cells)

"""What a look says about the classes of the cells: likelihoods, and which cells they concern."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.grid import Footprint, Grid
from semfov.detection.detections import Detections
from semfov.errors import check, check_shape


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
        footprint: `(B, L, X·Y)`, the cells that each detection concerns: boolean, or weights in [0, 1] that are the
            exponents of the likelihood; false or 0 for padding.
        distance: `(B, X·Y)`, from the fixation to every cell, in longer sides of the image.
    """

    likelihood: Tensor
    footprint: Tensor
    distance: Tensor

    def __getitem__(self, index: Tensor | slice) -> "Evidence":
        """Evidence of some of the looks."""
        return Evidence(self.likelihood[index], self.footprint[index], self.distance[index])

    @classmethod
    def join(cls, looks: list["Evidence"]) -> "Evidence":
        """All looks of several batches with equally many detections."""
        return cls(
            torch.cat([look.likelihood for look in looks]),
            torch.cat([look.footprint for look in looks]),
            torch.cat([look.distance for look in looks]),
        )


def weigh(
    detections: Detections,
    fixation: Tensor,
    grid: Grid,
    observation: Observation | None = None,
    footprint: Footprint = "overlap",
    *,
    tempering: float = 1.0,
) -> Evidence:
    r"""Evidence of the detections seen from `fixation`.

    The likelihoods are the scores as they are, or what the observation model calibrates them to
    (Luzio, Bernardino and Moreno, 2024, section III-B and equation 11):

    .. math:: \lambda_k = s_k \quad \text{or} \quad \lambda_k \propto p(S \mid C = k, d)

    With a class prior in the model λ is the posterior, and the prior counts anew with every detection.

    Successive looks at a static scene are not independent. With `tempering` τ < 1 a likelihood counts as
    :math:`\lambda_k^\tau`, which is not in the paper.

    Args:
        detections: boxes in pixels of the grid's image, batch `(B, L)`.
        fixation: `(B, 2)`, where each image of the batch was fixated.
        grid: the cells.
        observation: calibrates the scores by class and distance; None takes the raw scores as likelihoods.
        footprint: which cells a box concerns (`Grid.footprint`).
        tempering: exponent τ of the likelihoods.
    """
    check_shape(fixation, "fixation", detections.mask.shape[0], 2)
    check(tempering > 0, "tempering", "a positive number", tempering)
    # Padding has no scores that a model could read: it gets a uniform vector, and covers no cell.
    uniform = torch.full_like(detections.scores, 1 / detections.scores.shape[-1])
    likelihood = torch.where(detections.mask[..., None], detections.scores, uniform)
    if observation is not None:
        distance = grid.box_distance(detections.boxes, fixation)
        likelihood = observation.calibrate(likelihood, distance)
    if tempering != 1:
        likelihood = likelihood.pow(tempering)
    cells = grid.footprint(detections.boxes, footprint)
    cells = cells * detections.mask[..., None]
    offset = grid.centres.to(fixation) - fixation[:, None]
    distance = torch.linalg.vector_norm(offset, dim=-1) / grid.extent.amax(-1).to(fixation)[..., None]
    return Evidence(likelihood, cells, distance.to(likelihood))

"""What a detection says about the class of a cell: the likelihood of its scores."""

from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.errors import check, check_shape


class Observation(Protocol):
    """A model that turns scores seen at a distance into likelihoods (`semfov.FovealObservationModel`)."""

    def calibrate(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Likelihoods `(..., K+1)` up to a common factor, for scores `(..., K+1)` at distances `(...)`."""
        ...


def likelihoods(
    detections: Detections,
    fixation: Tensor,
    grid: Grid,
    observation: Observation | None = None,
    *,
    tempering: float = 1.0,
) -> Tensor:
    r"""Likelihood of every class given each detection, up to a factor, `(B, L, K+1)`; uniform for padding.

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
        tempering: exponent τ of the likelihoods.

    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.36, 0.64]]]), torch.ones(1, 1).bool())
    >>> likelihoods(seen, torch.zeros(1, 2), Grid(2, 1, (10, 10)), tempering=0.5)
    tensor([[[0.6000, 0.8000]]])
    """
    check_shape(fixation, "fixation", detections.mask.shape[0], 2)
    check(tempering > 0, "tempering", "a positive number", tempering)
    # Padding has no scores that a model could read.
    uniform = torch.full_like(detections.scores, 1 / detections.scores.shape[-1])
    likelihood = torch.where(detections.mask[..., None], detections.scores, uniform)
    if observation is not None:
        likelihood = observation.calibrate(likelihood, grid.box_distance(detections.boxes, fixation))
    return likelihood if tempering == 1 else likelihood.pow(tempering)

"""Likelihoods of the classes, given the scores of a detection."""

from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.grid import Footprint, Grid
from semfov.detection.detections import Detections
from semfov.errors import check, check_shape

_LEAST = 1e-6  # of the likelihood of background, by which the others are divided


class Observation(Protocol):
    """Protocol of a model that turns scores at a distance into likelihoods, as `semfov.FovealObservationModel` does.

    >>> class Sharpened:
    ...     def calibrate(self, scores, distance):
    ...         return scores.square()
    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.4, 0.6]]]), torch.ones(1, 1).bool())
    >>> likelihoods(seen, torch.zeros(1, 2), Grid(2, 1, (10, 10)), Sharpened())
    tensor([[[0.1600, 0.3600]]])
    """

    def calibrate(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Compute likelihoods of the classes, up to a common factor.

        Args:
            scores: `(..., K+1)`, score vectors, background first.
            distance: `(...)`, from the fixation to the centre of the box, in units of the image's longer side.

        Returns:
            `(..., K+1)`.
        """
        ...


def likelihoods(
    detections: Detections,
    fixation: Tensor,
    grid: Grid,
    observation: Observation | None = None,
    *,
    tempering: float = 1.0,
) -> Tensor:
    r"""Compute the likelihood of every class given each detection, up to a common factor.

    The likelihoods are the raw scores, or the scores calibrated by an observation model (Luzio, Bernardino and Moreno,
    2024, section III-B and equation 11):

    .. math:: \lambda_k = s_k \quad \text{or} \quad \lambda_k \propto p(S \mid C = k, d)

    If the model has a class prior, λ is the posterior, and the prior counts again with every detection.

    Successive looks at a static scene are not independent. A `tempering` τ < 1 replaces the likelihood by
    :math:`\lambda_k^\tau`; this is not in the paper.

    Args:
        detections: a batch `(B, L)`, boxes in pixels of the grid's image.
        fixation: `(B, 2)`, fixation in each image of the batch, in pixels.
        grid: the cells.
        observation: model that calibrates the scores by distance; None uses the raw scores.
        tempering: exponent τ of the likelihoods, positive.

    Returns:
        `(B, L, K+1)`, λ; padding counts as uniform scores.

    Raises:
        InputError: the shape of `fixation` does not fit, or `tempering` is not positive.

    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.36, 0.64]]]), torch.ones(1, 1).bool())
    >>> likelihoods(seen, torch.zeros(1, 2), Grid(2, 1, (10, 10)), tempering=0.5)
    tensor([[[0.6000, 0.8000]]])
    """
    check_shape(fixation, "fixation", detections.mask.shape[0], 2)
    check(tempering > 0, "tempering", "a positive number", tempering)
    # Padding may have scores that a model refuses.
    uniform = torch.full_like(detections.scores, 1 / detections.scores.shape[-1])
    likelihood = torch.where(detections.mask[..., None], detections.scores, uniform)
    if observation is not None:
        likelihood = observation.calibrate(likelihood, grid.box_distance(detections.boxes, fixation))
    return likelihood.pow(tempering)


def likelihood_ratios(detections: Detections, fixation: Tensor, grid: Grid, observation: Observation) -> Tensor:
    r"""Compute the calibrated likelihoods relative to background, :math:`p(S \mid k, d) / p(S \mid 0, d)`.

    Args:
        detections: a batch `(B, L)`, boxes in pixels of the grid's image.
        fixation: `(B, 2)`, in pixels.
        grid: the cells.
        observation: model that calibrates the scores by distance.

    Returns:
        `(B, L, K+1)`, 1 for background unless its likelihood is below 1e-6.
    """
    likelihood = likelihoods(detections, fixation, grid, observation)
    return likelihood / likelihood[..., :1].clamp(min=_LEAST)


def cells_of_detections(detections: Detections, grid: Grid, rule: Footprint = "overlap") -> Tensor:
    """Find the cells that detections cover, `(B, L, X·Y)` (`Grid.footprint`); padding covers none."""
    return grid.footprint(detections.boxes, rule) * detections.mask[..., None]

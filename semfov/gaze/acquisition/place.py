"""Acquisition functions of visual search that look beyond the fixated cell: what a fovea takes in."""

from abc import abstractmethod
from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import InputError
from semfov.gaze.acquisition.base import AcquisitionFunction


class MissModel(Protocol):
    """What these functions need of an observation model (`semfov.FovealObservationModel`)."""

    miss_rate: Tensor | None

    def level(self, distance: Tensor) -> Tensor:
        """Level of each distance, `(...)` from 0 to N - 1."""
        ...


class TargetVisibility(AcquisitionFunction):
    """Base of the acquisition functions that know from where the target can be seen.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.

    Attributes:
        visibility: `(..., f, x)`, probability that a target in cell x is detected from f, for each target.
    """

    target: Tensor
    visibility: Tensor

    def __init__(self, target: int | Tensor, model: MissModel, grid: Grid) -> None:
        super().__init__()
        if model.miss_rate is None:
            raise InputError("model: expected an observation model with miss rates, got one without")
        self.register_buffer("target", torch.as_tensor(target))
        level = model.level(grid.cell_distance)
        self.register_buffer("visibility", 1 - model.miss_rate[self.target][..., level])

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)`."""
        present = belief.probability(self.target)
        visibility = self.visibility.to(present).expand(len(present), -1, -1)
        return one_by_one(self.values, present, visibility)

    @abstractmethod
    def values(self, present: Tensor, visibility: Tensor) -> Tensor:
        """Values `(B, X·Y)` for the target's probability `(B, X·Y)` and its visibility `(B, f, x)`."""


class FovealHit(TargetVisibility):
    r"""Probability that the target is detected anywhere from the next fixation, if cells are independent.

    .. math:: a(f) = 1 - \prod_x \bigl(1 - p_t(x) \, v_t(d(x, f))\bigr), \qquad v_t = 1 - m_t

    with m the miss rates of the observation model: the probability of finding the target within the fovea.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.
    """

    def values(self, present: Tensor, visibility: Tensor) -> Tensor:
        """Probability of a hit."""
        return -torch.expm1(torch.log1p(-present[..., None, :] * visibility).sum(-1))


class PlaceInformation(TargetVisibility):
    r"""How much the next look is expected to tell of the target's place.

    With the place distributed as :math:`q(x) \propto p_t(x)`, a look from f detects the target with probability
    :math:`v_t(d(x, f))` if it is at x, and its place is then known; if it does not, q becomes
    :math:`q'(x) \propto q(x) (1 - v_t)`:

    .. math:: a(f) = H(q) - \Bigl(\sum_x q(x) (1 - v_t(d(x, f)))\Bigr) H(q')

    (The expected information gain of a searcher, as in Butko and Movellan, 2010, with a detector that either sees or
    misses.)

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.
    """

    def values(self, present: Tensor, visibility: Tensor) -> Tensor:
        """Entropy of the place that is expected to be lost, in nats."""
        place = present / present.sum(-1, keepdim=True)
        missed = place[..., None, :] * (1 - visibility)
        nothing = missed.sum(-1)
        # P(nothing) H(q') = -Σ m ln m + P ln P with m = q (1 - v)
        left = torch.xlogy(nothing, nothing) - torch.xlogy(missed, missed).sum(-1)
        return -torch.xlogy(place, place).sum(-1, keepdim=True) - left

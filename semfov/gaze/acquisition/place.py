"""Acquisition functions of visual search that count all cells near the fixation, not just the fixated one."""

from abc import abstractmethod

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import InputError
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.observation.foveal import FovealObservationModel


class _TargetVisibility(AcquisitionFunction):
    """Base of the functions that use the probability of detecting the target from each fixation."""

    target: Tensor
    visibility: Tensor

    def __init__(self, target: int | Tensor, model: FovealObservationModel, grid: Grid) -> None:
        super().__init__()
        if model.miss_rate is None:
            raise InputError("model: expected an observation model with miss rates, got one without them")
        self.register_buffer("target", torch.as_tensor(target))
        level = model.level(grid.cell_distance)
        self.register_buffer("visibility", 1 - model.miss_rate[self.target][..., level])

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(B, X·Y)`."""
        present = belief.probability(self.target)
        visibility = self.visibility.to(present).expand(len(present), -1, -1)
        return one_by_one(self.values, present, visibility)

    @abstractmethod
    def values(self, present: Tensor, visibility: Tensor) -> Tensor:
        """Compute values `(B, X·Y)` from the target's probability `(B, X·Y)` and its visibility `(B, f, x)`."""


class FovealHit(_TargetVisibility):
    r"""Probability that a look detects the target in any cell, if cells are independent.

    .. math:: a(f) = 1 - \prod_x \bigl(1 - p_t(x) \, v_t(d(x, f))\bigr), \qquad v_t = 1 - m_t

    m are the miss rates of the observation model.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> missed = torch.tensor([[0.5, 0.9], [0.1, 0.8]])
    >>> model = FovealObservationModel(torch.ones(2, 2, 2), [0.4], ["cup"], miss_rate=missed)
    >>> belief = DirichletBelief(torch.ones(1, 3, 2))
    >>> FovealHit(1, model, Grid(3, 1, (30, 10)))(belief, torch.zeros(1, 3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "foveal-hit"
    tasks = ("search",)
    by_place = True

    def values(self, present: Tensor, visibility: Tensor) -> Tensor:
        """Compute the probability that a look detects the target in any cell."""
        # The product of the misses as a sum of logarithms, which is exact also where it is nearly 1.
        log_of_misses = torch.log1p(-present[..., None, :] * visibility).sum(-1)
        return -torch.expm1(log_of_misses)


class PlaceInformation(_TargetVisibility):
    r"""Expected information that the next look gives about the target's place, in nats.

    The place is distributed as :math:`q(x) \propto p_t(x)`. If the target is at x, a look from f detects it with
    probability :math:`v_t(d(x, f))`, and its place is then known. If nothing is detected, q becomes
    :math:`q'(x) \propto q(x) (1 - v_t)`:

    .. math:: a(f) = H(q) - \Bigl(\sum_x q(x) (1 - v_t(d(x, f)))\Bigr) H(q')

    This is the expected information gain of a searcher as in Butko and Movellan (2010), with a detector that either
    detects the target or misses it.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> missed = torch.tensor([[0.5, 0.9], [0.1, 0.8]])
    >>> model = FovealObservationModel(torch.ones(2, 2, 2), [0.4], ["cup"], miss_rate=missed)
    >>> belief = DirichletBelief(torch.ones(1, 3, 2))
    >>> PlaceInformation(1, model, Grid(3, 1, (30, 10)))(belief, torch.zeros(1, 3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "place-information"
    tasks = ("search",)
    by_place = True

    def values(self, present: Tensor, visibility: Tensor) -> Tensor:
        """Compute the expected decrease of the entropy of the place, in nats."""
        place = present / present.sum(-1, keepdim=True)
        missed = place[..., None, :] * (1 - visibility)
        nothing = missed.sum(-1)
        # P(no detection) H(q') = -Σ m ln m + P ln P with m = q (1 - v)
        remaining = torch.xlogy(nothing, nothing) - torch.xlogy(missed, missed).sum(-1)
        return -torch.xlogy(place, place).sum(-1, keepdim=True) - remaining

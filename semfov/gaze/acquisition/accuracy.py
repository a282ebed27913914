"""Exploration that looks where objects would have been missed and can now be seen."""

from typing import Protocol

from torch import Tensor

from semfov.belief.belief import Belief, dirichlet_belief
from semfov.belief.grid import Grid
from semfov.errors import InputError, check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.lookahead import seen_from


class SightedModel(Protocol):
    """What this function needs of an observation model (`semfov.FovealObservationModel`)."""

    miss_rate: Tensor | None

    def level(self, distance: Tensor) -> Tensor:
        """Level of each distance, `(...)` from 0 to N - 1."""
        ...

    def expected_scores(self) -> Tensor:
        """Expected scores `E[S | class k, level n]`, `(K+1, N, K+1)`."""
        ...


class ExpectedAccuracy(AcquisitionFunction):
    r"""How many cells with objects one more look is expected to name right that are not yet.

    A cell is right with probability :math:`\max_{k \ge 1} p_k`. From level n an object of class k is detected with
    probability :math:`v_{kn} = 1 - m_{kn}` and then named right with :math:`c_{kn}`; if it is missed, its probability
    shrinks by the miss rate. So

    .. math:: a(f) = \sum_x \Bigl[\sum_{k \ge 1} p_k v_{kn} c_{kn} + \max_{k \ge 1} p_k m_{kn} -
              \max_{k \ge 1} p_k\Bigr]_+, \qquad n = n(d(x, f))

    Cells in which an object is already known gain nothing, and clear background gains nothing: what draws the gaze is
    where something may have been missed. Use it with an observer that takes account of misses
    (`semfov.observers.Semantic(misses=...)`).

    Args:
        model: the observation model, with miss rates; c is its expected score of the true class.
        grid: the cells of one image.
    """

    levels: Tensor
    miss: Tensor
    named: Tensor

    def __init__(self, model: SightedModel, grid: Grid) -> None:
        super().__init__()
        if model.miss_rate is None:
            raise InputError("model: expected an observation model with miss rates, got one without")
        right = model.expected_scores().detach().diagonal(dim1=0, dim2=2).t()
        self.register_buffer("levels", model.level(grid.cell_distance))
        self.register_buffer("miss", model.miss_rate[1:])
        self.register_buffer("named", (1 - model.miss_rate[1:]) * right[1:])

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(..., X·Y)` for a belief `(..., X·Y, K+1)`."""
        known = dirichlet_belief(belief)
        check_shape(known.beta, "beta", self.levels.shape[-1], None)
        objects = known.probabilities[..., 1:]
        seen = objects @ self.named.to(objects)
        missed = (objects[..., None] * self.miss.to(objects)).amax(-2)
        gain = (seen + missed - objects.amax(-1, keepdim=True)).clamp(min=0)
        return seen_from(gain, self.levels).sum(-2)

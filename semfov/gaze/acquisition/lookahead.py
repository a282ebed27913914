"""One-step lookahead: the belief about the whole map that a fixation is expected to lead to."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.belief import Belief, dirichlet_belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import check, check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction


class LevelledModel(Protocol):
    """The part of an observation model that the lookahead needs (`semfov.FovealObservationModel`)."""

    def level(self, distance: Tensor) -> Tensor:
        """Level of each distance, `(...)` from 0 to N - 1."""
        ...

    def expected_scores(self) -> Tensor:
        """Expected scores `E[S | class k, level n]`, `(K+1, N, K+1)`."""
        ...


@dataclass(frozen=True)
class Outlook:
    """The present belief, and the belief expected after one more look from each level of distance.

    Attributes:
        beta: β, `(..., X·Y, K+1)`, Dirichlet parameters.
        total: T = Σ β, `(..., X·Y)`.
        mean: p = β / T, `(..., X·Y, K+1)`.
        evidence: r = λ / Σ p λ, `(..., X·Y, N, K+1)`, the likelihoods λ of the expected look, as factors on the mean.
    """

    beta: Tensor
    total: Tensor
    mean: Tensor
    evidence: Tensor

    @property
    def growth(self) -> Tensor:
        """Relative change of the mean, `p' / p - 1 = (r - 1) / (T + 1)`, `(..., X·Y, N, K+1)`."""
        return (self.evidence - 1) / (self.total[..., None, None] + 1)

    @property
    def next_mean(self) -> Tensor:
        """Mean after the look, `p' = p (T + r) / (T + 1)`, `(..., X·Y, N, K+1)`."""
        return torch.addcmul(self.mean[..., None, :], self.mean[..., None, :], self.growth)

    @property
    def next_total(self) -> Tensor:
        """Sum of the parameters after Kaplan's update, `T' = (T + 1) / (1 + min r / T)`, `(..., X·Y, N)`."""
        total = self.total[..., None]
        return (total + 1) / (1 + self.evidence.amin(-1) / total)

    @property
    def next_beta(self) -> Tensor:
        """Parameters after Kaplan's update, `β' = β + β (r - min r) / (T + min r)`, `(..., X·Y, N, K+1)`."""
        beta, least = self.beta[..., None, :], self.evidence.amin(-1, keepdim=True)
        return torch.addcdiv(beta, beta * (self.evidence - least), self.total[..., None, None] + least)


def look_ahead(beta: Tensor, expected: Tensor) -> Outlook:
    r"""Simulate Kaplan's update of every cell with the scores expected at every level of distance.

    .. math:: \bar S_n = \sum_k p_k \, E[S \mid k, n], \qquad p'_k = \frac{T p_k + p_k r_k}{T + 1}, \quad
              r_k = \frac{\bar S_{n,k}}{\sum_j p_j \bar S_{n,j}}

    The expected scores enter Kaplan's rule without calibration (Luzio, Bernardino and Moreno, 2024, the equation of
    :math:`\bar S^x`, "which can then be applied with Kaplan's rule").

    Args:
        beta: `(..., X·Y, K+1)`, Dirichlet parameters.
        expected: `(K+1, N, K+1)`, expected scores of each class at each level
            (`FovealObservationModel.expected_scores`).

    Returns:
        The present and the expected belief.

    Raises:
        InputError: belief and expected scores have different numbers of classes.
    """
    components = beta.shape[-1]
    check(expected.shape[0] == components, "model", f"{components} classes, as the belief has", expected.shape[0])
    total = beta.sum(-1)
    mean = beta / total[..., None]
    table = expected.to(beta).flatten(1)
    scores = mean @ table if mean.ndim == 2 else one_by_one(lambda maps: maps @ table, mean.flatten(0, -3))
    scores = scores.view(*mean.shape[:-1], *expected.shape[1:])
    return Outlook(beta, total, mean, scores / (scores * mean[..., None, :]).sum(-1, keepdim=True))


class Lookahead(AcquisitionFunction):
    """Base of the acquisition functions of exploration that look one step ahead.

    The update of a cell depends on the fixation only through the level of the distance between them. Every cell is
    therefore updated N times instead of X·Y times, and `forward` looks up the level that applies to each fixation.

    Args:
        model: the observation model (`semfov.FovealObservationModel`).
        grid: the cells, of one image or of a batch.
    """

    levels: Tensor

    def __init__(self, model: LevelledModel, grid: Grid) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("levels", model.level(grid.cell_distance))

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Value of fixating each cell, `(..., X·Y)`, for a belief `(..., X·Y, K+1)`."""
        beta = dirichlet_belief(belief).beta
        check_shape(beta, "beta", self.levels.shape[-1], None)
        expected = self.model.expected_scores()

        def values(maps: Tensor) -> Tensor:
            return self.pool(seen_from(self.cell_values(look_ahead(maps, expected)), self.levels))

        if beta.ndim == 2 or self.levels.ndim > 2:
            return values(beta)
        # One map at a time stays in the processor's cache; a batch at once takes four times as long.
        return one_by_one(values, beta.flatten(0, -3)).view(beta.shape[:-1])

    @abstractmethod
    def cell_values(self, outlook: Outlook) -> Tensor:
        """Value of seeing each cell from each level, `(..., X·Y, N)`."""

    def pool(self, values: Tensor) -> Tensor:
        """Value of each fixation `(..., X·Y)`: the sum over the map of the values `(..., seen cell, fixation)`."""
        return values.sum(-2)


def seen_from(values: Tensor, levels: Tensor) -> Tensor:
    """Select the value of every cell at its level of distance from each fixation.

    Args:
        values: `(..., X·Y, N)`, for every cell and level.
        levels: `(X·Y, X·Y)` or `(B, X·Y, X·Y)`, level of the distance between every two cells.

    Returns:
        `(..., seen cell, fixation)`.
    """
    return values.gather(-1, levels.expand(*values.shape[:-1], levels.shape[-1]))

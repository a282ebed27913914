"""One look ahead: what a fixation is expected to make of the belief about the whole map."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from semfov.belief.grid import Grid
from semfov.errors import check, check_shape, values_known

# A batch is looked ahead from a few maps at a time: what lies in between, a number for every cell, level and class,
# then stays in the processor's cache, and the batch costs a quarter.
_CACHED = 2**18


class LevelledModel(Protocol):
    """What looking ahead needs of an observation model (`semfov.FovealObservationModel`)."""

    def level(self, distance: Tensor) -> Tensor:
        """Level of each distance, `(...)` from 0 to N - 1."""
        ...

    def expected_scores(self) -> Tensor:
        """Expected scores `E[S | class k, level n]`, `(K+1, N, K+1)`."""
        ...

    def calibrate_levels(self, scores: Tensor) -> Tensor:
        """Likelihoods `(..., N, K+1)` for scores `(..., N, K+1)` whose row n is seen at level n."""
        ...


@dataclass(frozen=True)
class Outlook:
    """The belief now, and what one more look from each level of distance is expected to leave of it.

    Attributes:
        total: T = Σ β, `(..., X·Y)`.
        mean: p = β / T, `(..., X·Y, K+1)`.
        evidence: r = λ / Σ p λ, the expected look's likelihoods as factors on the mean, `(..., X·Y, N, K+1)`.
    """

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


def look_ahead(beta: Tensor, model: LevelledModel, *, calibrated: bool = False) -> Outlook:
    r"""Simulate Kaplan's update of every cell with the scores expected at every level of distance.

    .. math:: \bar S_n = \sum_k p_k \, E[S \mid k, n], \qquad p'_k = \frac{T p_k + p_k r_k}{T + 1}, \quad
              r_k = \frac{\lambda_k}{\sum_j p_j \lambda_j}

    where λ is :math:`\bar S_n`, or what it is calibrated to at level n.

    Args:
        beta: `(..., X·Y, K+1)`, Dirichlet parameters.
        model: the observation model.
        calibrated: pass the expected scores through the model's calibration, as an agent does that calibrates what it
            sees.
    """
    expected = model.expected_scores().to(beta)
    components = beta.shape[-1]
    check(expected.shape[0] == components, "model", f"{components} classes", expected.shape[0])
    total = beta.sum(-1)
    mean = beta / total[..., None]
    scores = (mean @ expected.flatten(1)).unflatten(-1, expected.shape[1:])
    likelihood = model.calibrate_levels(scores) if calibrated else scores
    return Outlook(total, mean, likelihood / (likelihood * mean[..., None, :]).sum(-1, keepdim=True))


class Lookahead(nn.Module):
    """Base of the acquisition functions of exploration.

    A cell's update depends on the fixation only through the level of the distance between them. So every cell is
    updated N times and not X·Y times; `forward` looks up which of the N counts for each fixation.

    Args:
        model: the observation model (`semfov.FovealObservationModel`).
        grid: the cells, of one image or of a batch.
        calibrated: see `look_ahead`.
    """

    levels: Tensor

    def __init__(self, model: LevelledModel, grid: Grid, *, calibrated: bool = False) -> None:
        super().__init__()
        self.model = model
        self.calibrated = calibrated
        self.register_buffer("levels", model.level(grid.cell_distance))

    def forward(self, beta: Tensor) -> Tensor:
        """Value of fixating each cell, `(..., X·Y)`, for a belief `(..., X·Y, K+1)`."""
        check_shape(beta, "beta", self.levels.shape[-1], None)
        maps = beta.ndim - 2
        if maps == 0 or self.levels.ndim > 2 or not values_known():
            return self._values(beta)
        if beta.numel() == 0:
            return beta.new_zeros(beta.shape[:-1])
        size = beta[(0,) * maps].numel() * len(self.model.expected_scores()[0])
        parts = beta.flatten(0, -3).split(max(_CACHED // size, 1))
        return torch.cat([self._values(part) for part in parts]).unflatten(0, beta.shape[:-2])

    def _values(self, beta: Tensor) -> Tensor:
        worth = self.worth(look_ahead(beta, self.model, calibrated=self.calibrated))
        cells = self.levels.shape[-1]
        # (..., X·Y, N) -> (..., seen cell, fixation)
        return self.pool(worth.gather(-1, self.levels.expand(*worth.shape[:-1], cells)))

    def worth(self, outlook: Outlook) -> Tensor:
        """What seeing a cell from each level is worth, `(..., X·Y, N)`."""
        raise NotImplementedError

    def pool(self, worth: Tensor) -> Tensor:
        """One value for each fixation `(..., X·Y)` from what it is worth at every cell `(..., X·Y, X·Y)`: the sum."""
        return worth.sum(-2)

    def extra_repr(self) -> str:
        """Settings, for `repr`."""
        return f"calibrated={self.calibrated}"

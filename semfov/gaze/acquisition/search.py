"""Acquisition functions of visual search: where is the target?"""

from typing import Protocol

import torch
from torch import Tensor, nn

from semfov.belief.fusion import scale_likelihood
from semfov.errors import check, values_known


class FovealModel(Protocol):
    """What prediction needs of an observation model (`semfov.FovealObservationModel`)."""

    def expected_scores(self) -> Tensor:
        """Expected scores `E[S | class k, level n]`, `(K+1, N, K+1)`, level 0 at the fovea."""
        ...

    def calibrate(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Likelihoods `(..., K+1)` for scores `(..., K+1)` at distances `(...)`."""
        ...


class TargetPosterior(nn.Module):
    r"""Probability that a cell holds the target class: non-predictive search.

    .. math:: a(x) = p_t(x) = \beta_t(x) / \sum_j \beta_j(x)

    Args:
        target: index of the target class, 1..K, or a tensor `(B,)` with one for each episode.

    >>> TargetPosterior(1)(torch.tensor([[[1.0, 3.0], [1.0, 1.0]]]))
    tensor([[0.7500, 0.5000]])
    """

    target: Tensor

    def __init__(self, target: int | Tensor) -> None:
        super().__init__()
        self.register_buffer("target", torch.as_tensor(target))

    def forward(self, beta: Tensor) -> Tensor:
        """Values `(..., X·Y)` for a belief `(..., X·Y, K+1)`."""
        return pick(beta, self.target) / beta.sum(-1)


class PredictedTargetPosterior(nn.Module):
    r"""Probability of the target that one more, foveal look at a cell is expected to leave: predictive search.

    With the scores expected of such a look and one simulated step of Kaplan's rule, of which the mean is known,

    .. math:: \bar S = \sum_k p_k \, E[S \mid k, d = 0], \qquad
              a(x) = \frac{\beta_t (1 + \lambda_t / D)}{1 + \sum_j \beta_j}, \quad D = \sum_j \beta_j \lambda_j

    where λ is `S̄` itself, or `S̄` calibrated at the fovea (Luzio, Bernardino and Moreno, 2024).

    Args:
        target: index of the target class, 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, for the expected scores.
        calibrated: pass `S̄` through the model's calibration, as an agent does that calibrates what it sees.
    """

    target: Tensor

    def __init__(self, target: int | Tensor, model: FovealModel, *, calibrated: bool = False) -> None:
        super().__init__()
        self.model = model
        self.calibrated = calibrated
        self.register_buffer("target", torch.as_tensor(target))

    def forward(self, beta: Tensor) -> Tensor:
        """Values `(..., X·Y)` for a belief `(..., X·Y, K+1)`."""
        expected = self.model.expected_scores()[:, 0].to(beta)
        components = beta.shape[-1]
        check(expected.shape[0] == components, "model", f"{components} classes", expected.shape[0])
        total = beta.sum(-1)
        scores = (beta / total[..., None]) @ expected
        if self.calibrated:
            scores = self.model.calibrate(scores, torch.zeros_like(total))
        likelihood = scale_likelihood(scores)
        share = pick(likelihood, self.target) / (beta * likelihood).sum(-1)
        return pick(beta, self.target) * (1 + share) / (1 + total)


def pick(values: Tensor, target: Tensor) -> Tensor:
    """Component `target` (a scalar, or `(B,)`) of `values` `(B, X·Y, K+1)`, `(B, X·Y)`."""
    components = values.shape[-1]
    if values_known():
        inside = bool(((target >= 0) & (target < components)).all())
        check(inside, "target", f"a class index from 0 to {components - 1}", target.tolist())
    if target.ndim == 0:
        return values[..., target]
    index = target.reshape(*target.shape, *[1] * (values.ndim - target.ndim))
    return values.take_along_dim(index.expand(*values.shape[:-1], 1), -1)[..., 0]

"""Dirichlet log likelihoods as a linear map of log scores."""

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.observation.dirichlet import log_normaliser


def linear_map(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights and constants of the log likelihoods, level by level; alpha `(K+1, N, K+1)` → `(N (K+1), K+1)`."""
    by_level = alpha.transpose(0, 1)
    constant = -log_normaliser(by_level)
    return (by_level - 1).flatten(0, 1), constant.flatten()


def at_level(log_scores: Tensor, level: Tensor, weight: Tensor, constant: Tensor) -> Tensor:
    """Log likelihood of every class for detections `(..., K+1)` at levels `(...)`, by the map of `linear_map`."""
    components = log_scores.shape[-1]
    # One product for all levels and a selection cost less than gathering a matrix for each detection.
    every = F.linear(log_scores, weight, constant).unflatten(-1, (-1, components))
    index = level[..., None, None].expand(*level.shape, 1, components)
    return every.gather(-2, index).squeeze(-2)


class LinearCache:
    """Keeps the linear map of a parameter `ln α` until the parameter changes."""

    def __init__(self) -> None:
        self._cache: tuple[Tensor, int, int, Tensor, Tensor] | None = None

    def __call__(self, log_alpha: Tensor) -> tuple[Tensor, Tensor]:
        """The linear map of this parameter, computed again only if the parameter has changed."""
        key = (log_alpha, log_alpha._version, log_alpha.data_ptr())
        if self._cache is None or self._cache[0] is not log_alpha or self._cache[1:3] != key[1:]:
            with torch.inference_mode(False), torch.no_grad():
                self._cache = (*key, *linear_map(log_alpha.exp()))
        return self._cache[3:]

"""Fit the Dirichlets of an observation model from statistics by class and level."""

import warnings
from typing import Any

import torch
from torch import Tensor

from semfov.errors import check
from semfov.observation.mle import Method, mle, shrink, vacuous
from semfov.observation.statistics import DirichletStatistics

# Beyond this precision A, single-precision scores cannot be told from a single point.
_MAX_PRECISION = 1e6
# Pseudo-counts that draw each class to the uniform density.
_UNIFORM = 1.0


def fit_tables(
    statistics: DirichletStatistics,
    *,
    method: Method = "newton",
    shrinkage: float = 10.0,
    minimum: int = 100,
    enough: int | None = None,
) -> tuple[Tensor, Tensor, Tensor, dict[str, Any]]:
    r"""Maximum a posteriori α `(K+1, N, K+1)`, `ln π`, expected scores, and a record; warns of fallbacks.

    The mean log scores of a class at a level are shrunk to those of the class, and these by one sample to Dir(1, …, 1):

    .. math:: g_{k,d} = \frac{n_{k,d} \bar g_{k,d} + w g_k}{n_{k,d} + w}, \qquad
              g_k = \frac{n_k \bar g_k + \psi(1) - \psi(K+1)}{n_k + 1}

    A level with few objects takes the parameters of its inner neighbour; level 0, which has none, is recorded as its
    own. Cells with `enough` detections get the maximum of the likelihood, as in Luzio, Bernardino and Moreno (2024,
    section III-C); the treatment of the others is our choice.
    """
    check(len(statistics.shape) == 2, "statistics", "a table (K+1, N)", statistics.shape)
    classes = statistics.sum(1)
    uniform = vacuous(statistics.components).to(statistics.count.device)
    parent = shrink(classes.mean_log, classes.count, uniform, _UNIFORM)
    mean_log = shrink(statistics.mean_log, statistics.count, parent[:, None], shrinkage)
    if enough is not None:
        check(enough >= 2, "enough", "2 or more", enough)
        mean_log = torch.where((statistics.count >= enough)[..., None], statistics.mean_log, mean_log)
    alpha = mle(mean_log, method=method, max_precision=_MAX_PRECISION)
    fallback: dict[int, int] = {}
    for level, objects in enumerate(statistics.count[1:].sum(0).tolist()):
        if objects < minimum:
            fallback[level] = fallback.get(level - 1, max(level - 1, 0))
            alpha[:, level] = alpha[:, fallback[level]]
    if fallback:
        text = ", ".join(f"level {n} as level {source}" for n, source in fallback.items() if n > 0)
        text += "; level 0 has no inner neighbour and uses the classes' other levels" * (0 in fallback)
        # Level 4 is the caller of `FovealObservationModel.fit`: the decorator of `fit` adds a frame.
        warnings.warn(f"levels with fewer than {minimum} objects fall back: {text}", stacklevel=4)
    uniform = torch.full_like(classes.mean[0], 1 / statistics.components)
    parent = shrink(classes.mean, classes.count, uniform, _UNIFORM)
    expected = shrink(statistics.mean, statistics.count, parent[:, None], shrinkage)
    for level, source in fallback.items():
        expected[:, level] = expected[:, source]
    expected, prior = expected / expected.sum(-1, keepdim=True), _estimate_prior(statistics.count, shrinkage)
    told = {"method": method, "shrinkage": shrinkage, "minimum": minimum, "enough": enough}
    levels = {str(level): source for level, source in fallback.items()}
    return alpha, prior, expected, {"counts": statistics.count.tolist(), "fallback": levels, **told}


def _estimate_prior(count: Tensor, shrinkage: float = 10.0) -> Tensor:
    """Log class frequencies `(K+1, N)`, those of each level shrunk to those over all, π_k = (n_k + 1) / (n + K + 1)."""
    check(shrinkage > 0, "shrinkage", "a positive number of pseudo-counts", shrinkage)
    count = count.to(torch.float64)
    pooled = count.sum(1, keepdim=True) + 1
    pooled = pooled / pooled.sum()
    return ((count + shrinkage * pooled) / (count.sum(0) + shrinkage)).log()

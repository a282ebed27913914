"""Fit the Dirichlets of an observation model from statistics by class and level."""

import warnings
from collections.abc import Sequence
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
    r"""Fit α `(K+1, N, K+1)`, the maximum a posteriori, `ln π` and expected scores; with a record.

    The mean log scores of a class at a level are shrunk to those of the class, and these by one sample to Dir(1, …, 1):

    .. math:: g_{k,d} = \frac{n_{k,d} \bar g_{k,d} + w g_k}{n_{k,d} + w}, \qquad
              g_k = \frac{n_k \bar g_k + \psi(1) - \psi(K+1)}{n_k + 1}

    A level with fewer than `minimum` objects is fitted to the samples of its neighbours on both sides, too, of as many
    as it needs; a warning tells which. Cells with `enough` detections get the maximum of the likelihood, as in Luzio,
    Bernardino and Moreno (2024, section III-C); the treatment of the others is our choice.
    """
    check(len(statistics.shape) == 2, "statistics", "a table (K+1, N)", statistics.shape)
    objects, counted = statistics.count[1:].sum(0).tolist(), statistics
    pools = [_pool(objects, level, minimum) for level in range(len(objects))]
    statistics = _pooled(statistics, pools)
    widened = {level: pool for level, pool in enumerate(pools) if len(pool) > 1}
    if widened:
        text = ", ".join(f"level {level} from levels {pool[0]} to {pool[-1]}" for level, pool in widened.items())
        # Level 4 is the caller of `FovealObservationModel.fit`: the decorator of `fit` adds a frame.
        warnings.warn(f"levels with fewer than {minimum} objects are fitted with neighbours: {text}", stacklevel=4)
    classes = counted.sum(1)
    uniform = vacuous(statistics.components).to(statistics.count.device)
    parent = shrink(classes.mean_log, classes.count, uniform, _UNIFORM)
    mean_log = shrink(statistics.mean_log, statistics.count, parent[:, None], shrinkage)
    if enough is not None:
        check(enough >= 2, "enough", "2 or more", enough)
        mean_log = torch.where((statistics.count >= enough)[..., None], statistics.mean_log, mean_log)
    alpha = mle(mean_log, method=method, max_precision=_MAX_PRECISION)
    uniform = torch.full_like(classes.mean[0], 1 / statistics.components)
    parent = shrink(classes.mean, classes.count, uniform, _UNIFORM)
    expected = shrink(statistics.mean, statistics.count, parent[:, None], shrinkage)
    expected = expected / expected.sum(-1, keepdim=True)
    prior = _estimate_prior(counted.count, shrinkage)
    told = {"method": method, "shrinkage": shrinkage, "minimum": minimum, "enough": enough}
    levels = {str(level): list(pool) for level, pool in widened.items()}
    return alpha, prior, expected, {"counts": counted.count.tolist(), "pooled": levels, **told}


def _pool(objects: Sequence[int], level: int, minimum: int) -> range:
    """The levels around one, as many on each side as it takes to have `minimum` objects; all where they are fewer."""
    pool = range(level, level + 1)
    while sum(objects[pool.start : pool.stop]) < minimum and len(pool) < len(objects):
        pool = range(max(pool.start - 1, 0), min(pool.stop + 1, len(objects)))
    return pool


def _pooled(statistics: DirichletStatistics, pools: Sequence[range]) -> DirichletStatistics:
    """The statistics with those of a pool of levels in the place of each level."""
    table = DirichletStatistics(statistics.shape, statistics.components, epsilon=statistics.epsilon)
    table.count = torch.stack([statistics.count[:, pool.start : pool.stop].sum(1) for pool in pools], 1)
    table.sums = torch.stack([statistics.sums[:, :, pool.start : pool.stop].sum(2) for pool in pools], 2)
    return table


def _estimate_prior(count: Tensor, shrinkage: float = 10.0) -> Tensor:
    """Log class frequencies `(K+1, N)`, those of each level shrunk to those over all, π_k = (n_k + 1) / (n + K + 1)."""
    check(shrinkage > 0, "shrinkage", "a positive number of pseudo-counts", shrinkage)
    count = count.to(torch.float64)
    pooled = count.sum(1, keepdim=True) + 1
    pooled = pooled / pooled.sum()
    return ((count + shrinkage * pooled) / (count.sum(0) + shrinkage)).log()

"""Fit the Dirichlets of an observation model from statistics by class and level."""

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.errors import check
from semfov.io.files import JsonObject
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
) -> tuple[Tensor, Tensor, Tensor, JsonObject]:
    r"""Fit the parameters of an observation model, the maximum a posteriori.

    The mean log scores of a class at a level are shrunk to those of the class, and these by one sample to Dir(1, …, 1):

    .. math:: g_{k,d} = \frac{n_{k,d} \bar g_{k,d} + w g_k}{n_{k,d} + w}, \qquad
              g_k = \frac{n_k \bar g_k + \psi(1) - \psi(K+1)}{n_k + 1}

    A level with fewer than `minimum` objects is fitted to the samples of its neighbours on both sides, too, of as many
    as it needs; a warning tells which. Cells with `enough` detections get the maximum of the likelihood, as in Luzio,
    Bernardino and Moreno (2024, section III-C); the treatment of the others is our choice.

    Args:
        statistics: sums of the scores by class and level, `(K+1, N)`.
        method: method of `semfov.dirichlet.mle`.
        shrinkage: w, pseudo-counts that draw each cell of the table to its class.
        minimum: least number of objects in a level, background not counted.
        enough: number of detections from which on a cell is not shrunk; None shrinks all cells.

    Returns:
        α `(K+1, N, K+1)`, ln π `(K+1, N)`, expected scores `(K+1, N, K+1)`, and JSON values that record the fit.
    """
    check(len(statistics.shape) == 2, "statistics", "a table (K+1, N)", statistics.shape)
    check(enough is None or enough >= 2, "enough", "2 or more", enough)
    objects = statistics.count[1:].sum(0).tolist()
    pools = [_pool(objects, level, minimum) for level in range(len(objects))]
    widened = {level: pool for level, pool in enumerate(pools) if len(pool) > 1}
    if widened:
        sources = [f"level {level} from levels {pool[0]} to {pool[-1]}" for level, pool in widened.items()]
        text = f"levels with fewer than {minimum} objects are fitted with neighbours: {', '.join(sources)}"
        # Level 4 is the caller of `FovealObservationModel.fit`: the decorator of `fit` adds a frame.
        warnings.warn(text, stacklevel=4)
    cells = _pooled(statistics, pools)
    classes = statistics.sum(1)

    mean_log = _shrunk_mean_log(cells, classes, shrinkage)
    if enough is not None:
        has_enough = (cells.count >= enough)[..., None]
        mean_log = torch.where(has_enough, cells.mean_log, mean_log)
    alpha = mle(mean_log, method=method, max_precision=_MAX_PRECISION)
    log_prior = _estimate_prior(statistics.count, shrinkage)
    expected = _expected_scores(cells, classes, shrinkage)

    record: JsonObject = {
        "counts": statistics.count.tolist(),
        "pooled": {str(level): list(pool) for level, pool in widened.items()},
        "method": method,
        "shrinkage": shrinkage,
        "minimum": minimum,
        "enough": enough,
    }
    return alpha, log_prior, expected, record


def _shrunk_mean_log(cells: DirichletStatistics, classes: DirichletStatistics, shrinkage: float) -> Tensor:
    """Shrink the mean log scores of cells to those of their class, and these to Dir(1, …, 1); → `(K+1, N, K+1)`.

    Args:
        cells: sums by class and level, `(K+1, N)`.
        classes: sums by class, `(K+1,)`.
        shrinkage: w, pseudo-counts.
    """
    uniform = vacuous(classes.components).to(classes.count.device)
    of_class = shrink(classes.mean_log, classes.count, uniform, _UNIFORM)
    return shrink(cells.mean_log, cells.count, of_class[:, None], shrinkage)


def _expected_scores(cells: DirichletStatistics, classes: DirichletStatistics, shrinkage: float) -> Tensor:
    """Estimate the mean scores of cells, with sum 1, shrunk as their mean logarithms are; → `(K+1, N, K+1)`."""
    uniform = torch.full_like(classes.mean[0], 1 / classes.components)
    of_class = shrink(classes.mean, classes.count, uniform, _UNIFORM)
    expected = shrink(cells.mean, cells.count, of_class[:, None], shrinkage)
    return expected / expected.sum(-1, keepdim=True)


def _pool(objects: Sequence[int], level: int, minimum: int) -> range:
    """Widen a level by its neighbours, as many on each side as it takes to have `minimum` objects, at most to all."""
    pool = range(level, level + 1)
    while sum(objects[pool.start : pool.stop]) < minimum and len(pool) < len(objects):
        pool = range(max(pool.start - 1, 0), min(pool.stop + 1, len(objects)))
    return pool


def _pooled(statistics: DirichletStatistics, pools: Sequence[range]) -> DirichletStatistics:
    """Put the statistics of a pool of levels in the place of each level."""
    table = DirichletStatistics(statistics.shape, statistics.components, epsilon=statistics.epsilon)
    levels = [slice(pool.start, pool.stop) for pool in pools]
    table.count = torch.stack([statistics.count[:, part].sum(1) for part in levels], 1)
    table.sums = torch.stack([statistics.sums[:, :, part].sum(2) for part in levels], 2)
    return table


def _estimate_prior(count: Tensor, shrinkage: float = 10.0) -> Tensor:
    """Estimate log class frequencies `(K+1, N)` of counts `(K+1, N)`.

    Those of each level are shrunk to those over all levels, π_k = (n_k + 1) / (n + K + 1).
    """
    check(shrinkage > 0, "shrinkage", "a positive number of pseudo-counts", shrinkage)
    count = count.to(torch.float64)
    pooled = count.sum(1, keepdim=True) + 1
    pooled = pooled / pooled.sum()  # π_k, (K+1, 1)
    frequency = (count + shrinkage * pooled) / (count.sum(0) + shrinkage)
    return frequency.log()

"""From statistics by class and level to the Dirichlets of an observation model."""

import torch
from torch import Tensor

from semfov.errors import check
from semfov.observation.mle import Method, mle, shrink, vacuous
from semfov.observation.statistics import DirichletStatistics

# Scores of single precision cannot tell a precision beyond this from certainty.
MAX_PRECISION = 1e6
# Samples of the uniform density that a class is mixed with, whatever it has of its own.
UNIFORM = 1.0


def fit_table(
    statistics: DirichletStatistics,
    *,
    method: Method = "newton",
    shrinkage: float = 10.0,
    minimum: int = 100,
    enough: int | None = None,
) -> tuple[Tensor, dict[int, int]]:
    r"""Maximum a posteriori α for every class and level, `(K+1, N, K+1)` in float64.

    The mean logs of a cell are shrunk to those of its class over all levels, and these by one sample to those of
    Dir(1, ..., 1) (`semfov.dirichlet.shrink`):

    .. math:: g_{k,d} = \frac{n_{k,d} \bar g_{k,d} + w g_k}{n_{k,d} + w}, \qquad
              g_k = \frac{n_k \bar g_k + \psi(1) - \psi(K+1)}{n_k + 1}

    so that a class without samples gets the uniform density, and a cell without samples that of its class. A level
    with fewer than `minimum` objects in all takes the parameters of its inner neighbour.

    Luzio, Bernardino and Moreno (2024, section III-C) maximise the likelihood alone, and do not say what becomes of
    cells with few samples or none. Cells with `enough` get that maximum; how the others are filled is our choice.

    Args:
        statistics: of shape `(K+1, N)`, background first.
        method: of `semfov.dirichlet.mle`.
        shrinkage: pseudo-counts w.
        minimum: objects, background not counted, that a level needs.
        enough: detections from which a cell is not shrunk, but fitted by maximum likelihood; None shrinks all.

    Returns:
        α, and the levels that fell back: level -> the level that its parameters are of. Level 0 has no inner
        neighbour: it is recorded as falling back on itself, and is what shrinking makes of it.
    """
    check(len(statistics.shape) == 2, "statistics", "a table (K+1, N)", statistics.shape)
    classes = statistics.sum(1)
    uniform = vacuous(statistics.components).to(statistics.count.device)
    parent = shrink(classes.mean_log, classes.count, uniform, UNIFORM)
    mean_log = shrink(statistics.mean_log, statistics.count, parent[:, None], shrinkage)
    if enough is not None:
        check(enough >= 2, "enough", "2 or more", enough)
        mean_log = torch.where((statistics.count >= enough)[..., None], statistics.mean_log, mean_log)
    alpha = mle(mean_log, method=method, max_precision=MAX_PRECISION)
    fallback: dict[int, int] = {}
    for level, objects in enumerate(statistics.count[1:].sum(0).tolist()):
        if objects < minimum:
            fallback[level] = fallback.get(level - 1, max(level - 1, 0))
            alpha[:, level] = alpha[:, fallback[level]]
    return alpha, fallback


def expected_table(statistics: DirichletStatistics, fallback: dict[int, int], shrinkage: float = 10.0) -> Tensor:
    """Mean scores of every class and level, `(K+1, N, K+1)` in float64, shrunk and falling back as in `fit_table`."""
    classes = statistics.sum(1)
    uniform = torch.full_like(classes.mean[0], 1 / statistics.components)
    parent = shrink(classes.mean, classes.count, uniform, UNIFORM)
    table = shrink(statistics.mean, statistics.count, parent[:, None], shrinkage)
    for level, source in fallback.items():
        table[:, level] = table[:, source]
    return table / table.sum(-1, keepdim=True)


def estimate_prior(count: Tensor, shrinkage: float = 10.0) -> Tensor:
    r"""Log frequencies of the classes at each level, `(K+1, N)` in float64.

    .. math:: \pi_{k,d} = \frac{n_{k,d} + w \pi_k}{n_d + w}, \qquad \pi_k = \frac{n_k + 1}{n + K + 1}

    >>> estimate_prior(torch.tensor([[8], [0]]), 10.0).exp().flatten()
    tensor([0.9444, 0.0556], dtype=torch.float64)
    """
    check(shrinkage > 0, "shrinkage", "a positive number of pseudo-counts", shrinkage)
    count = count.to(torch.float64)
    pooled = count.sum(1, keepdim=True) + 1
    pooled = pooled / pooled.sum()
    return ((count + shrinkage * pooled) / (count.sum(0) + shrinkage)).log()

"""Measures of visual search."""

from math import comb

import numpy as np
from numpy.typing import NDArray

_Array = NDArray[np.float64]


def cumulative_performance(found_at: NDArray[np.int64], shifts: int) -> _Array:
    """Fraction of searches that have found their target after 0..`shifts` gaze shifts.

    Shapes: found_at `(..., episodes)` → `(..., shifts+1)`.
    """
    steps = np.arange(shifts + 1)
    when = np.asarray(found_at)[..., None]
    found = (when >= 0) & (when <= steps)
    return np.asarray(found.mean(-2), dtype=np.float64)


def random_search(targets: int, shifts: int, cells: int = 100) -> _Array:
    r"""Probability that random search without return has hit one of `targets` cells after 0..`shifts` gaze shifts.

    The start is not a target cell, so n gaze shifts draw n of the other N = `cells - 1` cells, of which m are targets:

    .. math:: P(n) = 1 - \binom{N - m}{n} \Big/ \binom{N}{n}

    Shapes: → `(shifts+1,)`.
    """
    others = cells - 1
    misses = [comb(others - targets, n) / comb(others, n) if n <= others else 0.0 for n in range(shifts + 1)]
    return 1 - np.array(misses)

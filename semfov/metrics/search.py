"""Figures of merit of visual search."""

from math import comb

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cumulative_performance(found_at: NDArray[np.int64], shifts: int) -> Array:
    """Share of searches that have found their target after 0..`shifts` gaze shifts, `(..., shifts+1)`.

    Args:
        found_at: `(..., episodes)`, gaze shift at which each search found its target, -1 where it did not.
        shifts: last gaze shift.

    >>> cumulative_performance(np.array([1, 3, -1, 1]), 3)
    array([0.  , 0.5 , 0.5 , 0.75])
    """
    steps = np.arange(shifts + 1)
    found = (found_at[..., None] >= 0) & (found_at[..., None] <= steps)
    return np.asarray(found.mean(-2), dtype=np.float64)


def random_search(targets: int, shifts: int, cells: int = 100) -> Array:
    """Chance that random search without return has hit one of `targets` cells after 0..`shifts` gaze shifts.

    The start is none of them, so n shifts draw n of the other `cells - 1` cells: `1 - C(N-m, n) / C(N, n)`.

    >>> random_search(1, 2, cells=5)
    array([0.  , 0.25, 0.5 ])
    """
    others = cells - 1
    misses = [comb(others - targets, n) / comb(others, n) if n <= others else 0.0 for n in range(shifts + 1)]
    return 1 - np.array(misses)

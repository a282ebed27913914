"""Measures of visual search."""

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

"""Means and their errors."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def standard_error(values: Array, axis: int = 0) -> Array:
    """Standard error of the mean along `axis`; NaN for fewer than two values."""
    count = values.shape[axis]
    if count < 2:
        return np.full(np.delete(values.shape, axis), np.nan)
    return np.asarray(values.std(axis, ddof=1) / np.sqrt(count))

"""Standard errors of means."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def standard_error(values: FloatArray, axis: int = 0) -> FloatArray:
    r"""Standard error of the mean along one axis.

    .. math:: \mathrm{SE} = \sqrt{\frac{1}{n (n - 1)} \sum_i (x_i - \bar x)^2}
    """
    values = np.asarray(values, dtype=np.float64)
    count = values.shape[axis]
    if count < 2:
        return np.full(np.delete(values.shape, axis), np.nan)
    return np.asarray(values.std(axis, ddof=1) / np.sqrt(count))

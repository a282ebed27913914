"""Scanpaths simplified by merging fixations that are close together."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Array = NDArray[np.float64]


def merge_close(points: ArrayLike, size: tuple[float, float]) -> _Array:
    """Merge successive fixations that are closer than half a window.

    Ruarte et al. (2025) and the benchmark before it (Travi et al., 2022) do so to compare people's scanpaths with those
    of models that fixate a cell only once. Beginning at the start, a fixation and the next are replaced by their mean
    as long as both differences, in x and in y, are smaller than half the window.

    Args:
        points: `(n, 2)`, fixations in order.
        size: `(width, height)` of the window, in the unit of the points.

    Returns:
        `(m, 2)`, the merged fixations, m ≤ n.

    >>> merge_close([[0, 0], [2, 0], [9, 9]], (10, 10))
    array([[1., 0.],
           [9., 9.]])
    """
    path = list(np.asarray(points, dtype=np.float64))
    half = np.asarray(size) / 2
    index = 0
    while index < len(path) - 1:
        if (np.abs(path[index] - path[index + 1]) < half).all():
            path[index : index + 2] = [(path[index] + path[index + 1]) / 2]
        else:
            index += 1
    return np.array(path)

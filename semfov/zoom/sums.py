"""Sums over all windows of a level, computed anew only where cells have changed."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

Cells = NDArray[np.float32]

Box = tuple[int, int, int, int]
"""Cells `(x1, y1, x2, y2)` of a lattice."""

Place = tuple[slice, slice]
"""Rows and columns of an array."""

EVERYWHERE: Place = (slice(None), slice(None))


class WindowSums:
    r"""Weighted sums of the cells of every window; weight `(span,)`, shape `(rows, columns)`.

    .. math:: S_{ij} = \sum_{k,l} r_k r_l \, x_{i+k,\,j+l}

    A sum along an axis is a product with a banded matrix. Only the windows that hold a cell which has changed are
    summed again. A window that reaches beyond the cells sums those that it holds.

    Shapes: weight `(span,)`, shape `(rows, columns)`.
    """

    def __init__(self, weight: Cells, shape: tuple[int, int], cells: Callable[[Place], Cells]) -> None:
        self._span, self._cells = len(weight), cells
        places = np.arange(max(max(n - self._span, 0) + 1 for n in shape))
        self._band = np.zeros((len(places) + self._span - 1, len(places)), np.float32)
        self._band[places + np.arange(self._span)[:, None], places] = weight[:, None]
        self._sums = np.zeros([max(n - self._span, 0) + 1 for n in shape], np.float32)
        self._changed: Box | None = (0, 0, shape[1], shape[0])

    def mark(self, changed: Box) -> None:
        """Have the windows summed again that hold one of some cells."""
        self._changed = union(changed, self._changed)

    def update(self) -> Cells:
        """Sum the cells of every window, `(down, across)`; the next call changes the result."""
        if self._changed is None:
            return self._sums
        (x1, y1, x2, y2), self._changed = self._changed, None
        reach = self._span - 1
        top, left = max(y1 - reach, 0), max(x1 - reach, 0)
        bottom, right = min(y2, self._sums.shape[0]), min(x2, self._sums.shape[1])
        part = self._cells((slice(top, bottom + reach), slice(left, right + reach)))
        down, across = self._band[: part.shape[0], : bottom - top], self._band[: part.shape[1], : right - left]
        # NumPy would start threads for large pictures, and they would wait at full load for the next product.
        lines = torch.from_numpy(part) @ torch.from_numpy(across)
        self._sums[top:bottom, left:right] = (torch.from_numpy(down).mT @ lines).numpy()
        return self._sums


def union(box: Box, other: Box | None) -> Box:
    """The smallest box that contains both boxes; the first one if there is no other."""
    if other is None:
        return box
    return min(box[0], other[0]), min(box[1], other[1]), max(box[2], other[2]), max(box[3], other[3])


def extent(marked: NDArray[np.bool_]) -> Box:
    """Find the smallest box that contains all marked cells; marked `(rows, columns)`."""
    rows, columns = np.flatnonzero(marked.any(1)), np.flatnonzero(marked.any(0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1

"""Sums over all windows of a level, computed anew only where cells have changed."""

import numpy as np
import torch
from numpy.typing import NDArray

Cells = NDArray[np.float32]

Box = tuple[int, int, int, int]
"""Cells `(x1, y1, x2, y2)` of a lattice."""


class WindowSums:
    r"""Weighted sums of the cells of every window.

    .. math:: S_{ij} = \sum_{k,l} r_k r_l \, x_{i+k,\,j+l}

    A sum along an axis is a product with a banded matrix. Sums are kept between calls. A call sums again the windows
    that hold a cell which has changed.

    Args:
        weight: `(span,)`, r, weights of the cells along a side of a window.
        shape: `(rows, columns)` of the cells.

    Attributes:
        sums: `(down, across)`, S of the last call.

    >>> sums = WindowSums(np.ones(2, np.float32), (3, 3))
    >>> sums.update(np.arange(9, dtype=np.float32).reshape(3, 3), (0, 0, 3, 3))
    array([[ 8., 12.],
           [20., 24.]], dtype=float32)
    """

    def __init__(self, weight: Cells, shape: tuple[int, int]) -> None:
        self._span = len(weight)
        self._places = tuple(max(n - self._span, 0) + 1 for n in shape)
        places = np.arange(max(self._places))
        self._band = np.zeros((len(places) + self._span - 1, len(places)), np.float32)
        self._band[places + np.arange(self._span)[:, None], places] = weight[:, None]
        self.sums = np.zeros(self._places, np.float32)

    def update(self, cells: Cells, changed: Box) -> Cells:
        """Sum the cells of every window.

        Args:
            cells: `(rows, columns)`, x. A window that reaches beyond the cells sums those that it holds.
            changed: the cells that may have changed since the last call, at the first call all of them.

        Returns:
            `(down, across)`; the next call changes it.
        """
        x1, y1, x2, y2 = changed
        reach = self._span - 1
        top, left = max(y1 - reach, 0), max(x1 - reach, 0)
        bottom, right = min(y2, self._places[0]), min(x2, self._places[1])
        part = cells[top : bottom + reach, left : right + reach]
        down, across = self._band[: part.shape[0], : bottom - top], self._band[: part.shape[1], : right - left]
        # NumPy would start threads for large pictures, and they would wait at full load for the next product.
        lines = torch.from_numpy(part) @ torch.from_numpy(across)
        self.sums[top:bottom, left:right] = (torch.from_numpy(down).mT @ lines).numpy()
        return self.sums


def extent(marked: NDArray[np.bool_]) -> Box:
    """Find the box about marked cells.

    Args:
        marked: `(rows, columns)`; at least one cell is marked.

    Returns:
        The box.

    >>> extent(np.array([[False, True, True], [False, False, True]]))
    (1, 0, 3, 2)
    """
    rows, columns = np.flatnonzero(marked.any(1)), np.flatnonzero(marked.any(0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1

"""Sums over all windows of a level, computed anew only where cells have changed."""

import numpy as np
from numpy.typing import NDArray

Cells = NDArray[np.float32]


class WindowSums:
    r"""Weighted sums of the cells of every window.

    .. math:: S_{ij} = \sum_{k,l} r_k r_l \, x_{i+k,\,j+l}

    A sum along an axis is a product with a banded matrix. Sums are kept between calls. A call sums again the windows
    that hold a cell which has changed since the last call.

    Args:
        weight: `(span,)`, r, weights of the cells along a side of a window.
        shape: `(rows, columns)` of the cells.

    >>> sums = WindowSums(np.ones(2, np.float32), (3, 3))
    >>> sums(np.arange(9, dtype=np.float32).reshape(3, 3))
    array([[ 8., 12.],
           [20., 24.]], dtype=float32)
    """

    def __init__(self, weight: Cells, shape: tuple[int, int]) -> None:
        self._span = len(weight)
        self._places = tuple(max(n - self._span, 0) + 1 for n in shape)
        places = np.arange(max(self._places))
        self._band = np.zeros((len(places) + self._span - 1, len(places)), np.float32)
        self._band[places + np.arange(self._span)[:, None], places] = weight[:, None]
        self._cells: Cells | None = None
        self._sums = np.zeros(self._places, np.float32)

    def __call__(self, cells: Cells) -> Cells:
        """Sum the cells of every window.

        Args:
            cells: `(rows, columns)`, x; kept until the next call, so not to be written to. A window that reaches beyond
                the cells sums those that it holds.

        Returns:
            `(down, across)`; the next call changes it.
        """
        if self._cells is None:
            rows, columns = (slice(0, n) for n in self._places)
        else:
            changed = cells != self._cells
            down, across = changed.any(1).nonzero()[0], changed.any(0).nonzero()[0]
            if not len(down):
                return self._sums
            rows, columns = (
                slice(max(int(places[0]) - self._span + 1, 0), min(int(places[-1]) + 1, most))
                for places, most in ((down, self._places[0]), (across, self._places[1]))
            )
        part = cells[rows.start : rows.stop + self._span - 1, columns.start : columns.stop + self._span - 1]
        upper = self._band[: part.shape[0], : rows.stop - rows.start]
        right = self._band[: part.shape[1], : columns.stop - columns.start]
        self._sums[rows, columns] = upper.T @ (part @ right)
        self._cells = cells
        return self._sums

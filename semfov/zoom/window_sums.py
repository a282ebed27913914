"""Sums over the cells of every window of one size, kept up to date as cells change, and boxes of cells.

cells of the picture                        windows of 3 × 3 cells
· · · · · · ·      a cell changes (x)       · ■ ■ ■ ·     Only the windows that start at most two cells
· · · x · · ·     ───────────────────►      · ■ ■ ■ ·     before it hold it. They alone are summed again,
· · · · · · ·                               · ■ ■ ■ ·     the next time that the sums are asked for.
"""

from collections.abc import Callable, Iterator
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_BLOCK = 1024  # windows along a side that are summed by one product

Cells = NDArray[np.float32]
"""Numbers of the cells of a lattice, `(rows, columns)`, or of the windows of a level, `(down, across)`."""

CellBox = tuple[int, int, int, int]
"""Cells `(x1, y1, x2, y2)`: the first column and row, and those after the last."""

CellSlices = tuple[slice, slice]
"""Rows and columns of cells, as slices of an array."""


def extent(marked: NDArray[np.bool_]) -> CellBox:
    """Find the smallest box around marked cells.

    Args:
        marked: `(rows, columns)`, with at least one marked cell.

    Returns:
        The box.
    """
    rows = np.flatnonzero(marked.any(1))
    columns = np.flatnonzero(marked.any(0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def enclosing(first: CellBox | None, second: CellBox) -> CellBox:
    """Find the smallest box around two boxes.

    Args:
        first: a box; None for none.
        second: a box.

    Returns:
        The box around both.
    """
    if first is None:
        return second
    x1, y1, x2, y2 = first
    return min(x1, second[0]), min(y1, second[1]), max(x2, second[2]), max(y2, second[3])


class WindowSums:
    r"""Weighted sums :math:`S(w) = \sum_{x \in w} r(x) \, c(x)` of the cells c of every window w.

    The weight of a cell is the product of those of its row and its column in the window, so the sums are products with
    two banded matrices. Beyond the picture there are no cells: a window that is longer than a side starts at 0 alone.

    Invariant: outside `changed`, the sums are those of the present cells.

    Attributes:
        changed: cells that may have changed since the sums were computed; None for none.
    """

    def __init__(self, weight: Cells, shape: tuple[int, int], read_cells: Callable[[CellSlices], Cells]) -> None:
        """Prepare the sums; nothing is summed yet.

        Args:
            weight: `(span,)`, weights of the cells along a side of a window.
            shape: rows and columns of the cells.
            read_cells: gives the present cells in some rows and columns.
        """
        self._span = len(weight)
        self._read_cells = read_cells
        rows, columns = shape
        down = max(rows - self._span, 0) + 1
        across = max(columns - self._span, 0) + 1
        self._weight = weight
        self._sums = np.zeros((down, across), np.float32)
        self.changed: CellBox | None = (0, 0, columns, rows)

    @cached_property
    def _band(self) -> Cells:
        """The weights of a window that starts at cell n, in column n; one matrix serves both axes, in part."""
        starts = np.arange(min(max(self._sums.shape), _BLOCK))
        band = np.zeros((len(starts) + self._span - 1, len(starts)), np.float32)
        band[starts + np.arange(self._span)[:, None], starts] = self._weight[:, None]
        return band

    def mark(self, box: CellBox) -> None:
        """Note that the cells in a box may have changed.

        Args:
            box: the cells.
        """
        self.changed = enclosing(self.changed, box)

    def update(self) -> Cells:
        """Sum the cells of every window that holds a changed one.

        Returns:
            `(down, across)`, the sums of all windows. The next call changes this array.
        """
        if self.changed is None:
            return self._sums
        x1, y1, x2, y2 = self.changed
        self.changed = None
        reach = self._span - 1
        top = max(y1 - reach, 0)
        left = max(x1 - reach, 0)
        bottom = min(y2, self._sums.shape[0])
        right = min(x2, self._sums.shape[1])
        cells = self._read_cells((slice(top, bottom + reach), slice(left, right + reach)))
        changed_sums = self._sums[top:bottom, left:right]
        if not cells.any():
            # Most levels of a very large picture stay empty, and memory that was never written to is not taken.
            if changed_sums.any():
                changed_sums[:] = 0
            return self._sums
        # NumPy would start threads for large pictures, and they would wait at full load for the next product.
        row_sums = self._sums_of_rows(torch.from_numpy(cells), right - left)
        sums = [
            torch.from_numpy(self._band[: len(part), :count]).mT @ part
            for count, part in self._blocks(row_sums, bottom - top)
        ]
        changed_sums[:] = torch.cat(sums).numpy()
        return self._sums

    def _sums_of_rows(self, cells: Tensor, across: int) -> Tensor:
        """Sum the cells of each row over the columns of windows, `(rows, across)`."""
        sums = [
            part.mT @ torch.from_numpy(self._band[: len(part), :count])
            for count, part in self._blocks(cells.mT, across)
        ]
        return torch.cat(sums, 1)

    def _blocks(self, cells: Tensor, windows: int) -> Iterator[tuple[int, Tensor]]:
        """Divide windows along the first side of cells into blocks, so that the matrix stays small in a long picture.

        Args:
            cells: `(length, n)`, from the first cell of the first window.
            windows: number of windows, each of which starts a cell after the one before.

        Yields:
            The number of windows in a block, and their cells.
        """
        for start in range(0, windows, _BLOCK):
            count = min(_BLOCK, windows - start)
            yield count, cells[start : start + count + self._span - 1]

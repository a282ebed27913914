"""Sums over the cells of every window of one size, kept up to date as cells change, and boxes of cells.

cells of the picture                        windows of 3 × 3 cells
· · · · · · ·      a cell changes (x)       · ■ ■ ■ ·     Only the windows that start at most two cells
· · · x · · ·     ───────────────────►      · ■ ■ ■ ·     before it hold it. They alone are summed again,
· · · · · · ·                               · ■ ■ ■ ·     the next time that the sums are asked for.
"""

from collections.abc import Callable, Iterator
from functools import cached_property

import torch
from torch import Tensor

from semfov.precision import without_autocast

_BLOCK = 1024  # windows along a side that are summed by one product

Cells = Tensor
"""Numbers of the cells of a lattice, `(rows, columns)`, or of the windows of a level, `(down, across)`."""

CellBox = tuple[int, int, int, int]
"""Cells `(x1, y1, x2, y2)`: the first column and row, and those after the last."""

CellSlices = tuple[slice, slice]
"""Rows and columns of cells, as slices of an array."""


def extent(marked: Tensor) -> CellBox:
    """Find the smallest box around marked cells.

    Args:
        marked: `(rows, columns)` boolean, with at least one marked cell.

    Returns:
        The box.
    """
    rows = marked.any(1).nonzero()
    columns = marked.any(0).nonzero()
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


@torch.inference_mode(False)
def writable_tensor(shape: tuple[int, ...], value: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Make a tensor filled with one value, which can be changed in every mode of PyTorch.

    Args:
        shape: shape of the tensor.
        value: the value.
        dtype: its type.
        device: its device.

    Returns:
        The tensor.
    """
    return torch.full(shape, value, dtype=dtype, device=device)


class WindowSums:
    r"""Weighted sums :math:`S(w) = \sum_{x \in w} r(x) \, c(x)` of the cells c of every window w.

    The weight of a cell is the product of those of its row and its column in the window, so the sums are products with
    two banded matrices. Beyond the picture there are no cells: a window that is longer than a side starts at 0 alone.
    The sums are differentiable in the cells, and on the device of the weights.

    Invariant: outside `changed`, the sums are those of the present cells.

    Attributes:
        changed: cells that may have changed since the sums were computed; None for none.
    """

    def __init__(self, weight: Cells, shape: tuple[int, int], read_cells: Callable[[CellSlices], Cells | None]) -> None:
        """Prepare the sums; nothing is summed yet.

        Args:
            weight: `(span,)`, weights of the cells along a side of a window.
            shape: rows and columns of the cells.
            read_cells: gives the present cells in some rows and columns, as a new tensor; None for none but zeros.
        """
        self._span = len(weight)
        self._read_cells = read_cells
        rows, columns = shape
        down = max(rows - self._span, 0) + 1
        across = max(columns - self._span, 0) + 1
        self._weight = weight
        # Most levels of a very large picture stay empty, and take no memory.
        self._sums = weight.new_zeros(()).expand(down, across)
        self._is_empty = True
        self.changed: CellBox | None = (0, 0, columns, rows)

    @cached_property
    def _band(self) -> Cells:
        """The weights of a window that starts at cell n, in column n; one matrix serves both axes, in part."""
        starts = torch.arange(min(max(self._sums.shape), _BLOCK), device=self._weight.device)
        place = torch.arange(self._span, device=self._weight.device)
        band = self._weight.new_zeros(len(starts) + self._span - 1, len(starts))
        band[starts + place[:, None], starts] = self._weight[:, None]
        return band

    def mark(self, box: CellBox) -> None:
        """Mark the cells in a box as possibly changed.

        Args:
            box: the cells.
        """
        self.changed = enclosing(self.changed, box)

    def update(self) -> Cells:
        """Compute the sums of all windows that contain a changed cell.

        Returns:
            `(down, across)`, the sums of all windows; with gradients a copy of them. The next call changes others.
        """
        if self.changed is not None:
            self._sum_changed(self.changed)
            self.changed = None
        return self._sums.clone() if self._sums.requires_grad else self._sums

    def _sum_changed(self, box: CellBox) -> None:
        """Sum the cells of every window that holds a cell of a box."""
        x1, y1, x2, y2 = box
        reach = self._span - 1
        top = max(y1 - reach, 0)
        left = max(x1 - reach, 0)
        bottom = min(y2, self._sums.shape[0])
        right = min(x2, self._sums.shape[1])
        cells = self._read_cells((slice(top, bottom + reach), slice(left, right + reach)))
        if self._is_empty:
            if cells is None:
                return
            self._sums = writable_tensor(self._sums.shape, 0, self._sums.dtype, self._sums.device)
            self._is_empty = False
        self._sums[top:bottom, left:right] = 0 if cells is None else self._summed(cells, bottom - top, right - left)

    def _summed(self, cells: Cells, down: int, across: int) -> Tensor:
        """Sum cells over the windows that start at the first rows and columns, `(down, across)`."""
        with without_autocast(cells):
            row_sums = self._sums_of_rows(cells.to(self._band), across)
            blocks = self._blocks(row_sums, down)
            return torch.cat([self._band[: len(part), :count].mT @ part for count, part in blocks])

    def _sums_of_rows(self, cells: Tensor, across: int) -> Tensor:
        """Sum the cells of each row over the columns of windows, `(rows, across)`."""
        sums = [part.mT @ self._band[: len(part), :count] for count, part in self._blocks(cells.mT, across)]
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

"""The windows that an agent can choose from: squares of cells, at magnifications one octave apart.

level 0                 level 1                 level 2, the last
┌───────────────┐       ┌───────┬───────┐       ┌───┬───────────┐
│               │       │ 16×16 │       │       │8×8│           │
│    32 × 32    │       │ cells │       │       ├───┘           │     A window starts at any cell,
│     cells     │       ├───────┘       │       │               │     so that windows overlap.
│               │       │               │       │               │
└───────────────┘       └───────────────┘       └───────────────┘
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from semfov.errors import check

CELLS = 8  # cells along a side of the closest window
MOST_CELLS = 1 << 22  # cells of a picture, for each of which a belief keeps some numbers by level: a gigabyte at most
MOST_IN_LINE = 1 << 14  # cells along a side; sums over the windows of a strip take kilobytes for each


@dataclass(frozen=True)
class Lattice:
    """A grid of cells over a picture, and the windows of every magnification level on this grid.

    Level 0 has one window, with the whole picture in its upper left corner. A window of level k is half as wide as one
    of level k - 1. Windows of the last level are `CELLS` cells wide. A window starts at the border of a cell, and it
    reaches beyond the picture by less than one cell where the picture is large enough.

    Attributes:
        size: `(width, height)` of the picture in pixels.
        canvas: `(width, height)` of the detector's input.
        magnifications: magnification of each level, in canvas pixels per picture pixel.

    >>> lattice = Lattice((800, 600), (400, 400), (0.5, 1.0))
    >>> lattice.pitch, lattice.columns, lattice.rows
    ((50.0, 50.0), 16, 12)
    >>> [lattice.places(level) for level in range(lattice.levels)]
    [(1, 1), (9, 5)]
    """

    size: tuple[int, int]
    canvas: tuple[int, int]
    magnifications: tuple[float, ...]

    @classmethod
    def over(cls, size: tuple[int, int], canvas: tuple[int, int], *, finest: float = 1.0) -> "Lattice":
        """Create the lattice of a picture, up to the last magnification that is not above `finest`.

        Args:
            size: `(width, height)` of the picture in pixels.
            canvas: `(width, height)` of the detector's input.
            finest: largest magnification, in canvas pixels per picture pixel.

        Returns:
            The lattice.

        Raises:
            InputError: the picture has more cells than a belief may have, or no pixels.

        >>> lattice = Lattice.over((2560, 1920), (416, 416))
        >>> lattice.levels, lattice.columns, lattice.rows, len(lattice)
        (3, 32, 24, 579)
        """
        check(min(size) >= 1, "picture", "a width and a height in pixels", size)
        check(finest > 0, "finest", "a positive magnification", finest)
        # Magnifications one octave apart, from the one that shows the whole picture up to the finest one.
        width, height = size
        magnifications = [min(canvas[0] / width, canvas[1] / height)]
        # Rounding must not cost a picture its level of native pixels.
        while magnifications[-1] * 2 <= finest * (1 + 1e-9):
            magnifications.append(magnifications[-1] * 2)
        lattice = cls(size, canvas, tuple(magnifications))
        columns = lattice.columns
        rows = lattice.rows
        expected = f"at most {MOST_CELLS:,} cells of a belief, {MOST_IN_LINE:,} along a side"
        got = f"{columns:,} × {rows:,} in {width} × {height} px; divide the picture, or reduce it"
        check(columns * rows <= MOST_CELLS and max(columns, rows) <= MOST_IN_LINE, "picture", expected, got)
        return lattice

    def __post_init__(self) -> None:
        check(len(self.magnifications) >= 1, "magnifications", "at least one", self.magnifications)

    @property
    def levels(self) -> int:
        """Number of magnification levels."""
        return len(self.magnifications)

    @property
    def octaves(self) -> Tensor:
        """Number of octaves by which the picture is reduced at each level, `(levels,)`; 0 where it is not reduced.

        >>> Lattice.over((2560, 1920), (416, 416)).octaves
        tensor([2.6215, 1.6215, 0.6215])
        """
        return -torch.tensor(self.magnifications).log2().clamp(max=0)

    @cached_property
    def pitch(self) -> tuple[float, float]:
        """`(width, height)` of a cell in picture pixels."""
        width, height = self.window(self.levels - 1)
        return width / CELLS, height / CELLS

    @cached_property
    def columns(self) -> int:
        """Number of cells in a row."""
        return _rounded_up(self.size[0] / self.pitch[0])

    @cached_property
    def rows(self) -> int:
        """Number of cells in a column."""
        return _rounded_up(self.size[1] / self.pitch[1])

    def window(self, level: int) -> tuple[float, float]:
        """Compute the size of a window.

        Args:
            level: its level, from 0.

        Returns:
            `(width, height)` in picture pixels.
        """
        magnification = self.magnifications[level]
        return self.canvas[0] / magnification, self.canvas[1] / magnification

    def span(self, level: int) -> int:
        """Count the cells along a side of a window.

        Args:
            level: its level, from 0.

        Returns:
            The number of cells.
        """
        return CELLS << (self.levels - 1 - level)

    def places(self, level: int) -> tuple[int, int]:
        """Count the columns and rows of cells at which a window can start.

        Args:
            level: its level, from 0.

        Returns:
            The number of places along a row and down a column.
        """
        span = self.span(level)
        return max(self.columns - span, 0) + 1, max(self.rows - span, 0) + 1

    @cached_property
    def actions(self) -> Tensor:
        """All windows, `(N, 3)`: level, column and row of the first cell; the windows of a level row by row."""
        by_level = []
        for level in range(self.levels):
            across, down = self.places(level)
            row, column = torch.meshgrid(torch.arange(down), torch.arange(across), indexing="ij")
            by_level.append(torch.stack([torch.full_like(row, level), column, row], -1).reshape(-1, 3))
        return torch.cat(by_level)

    def __len__(self) -> int:
        """Count the windows of all levels."""
        return sum(across * down for across, down in map(self.places, range(self.levels)))

    def boxes(self, actions: Tensor) -> Tensor:
        """Compute the boxes of windows, which may reach beyond the picture, in its pixels.

        Args:
            actions: `(..., 3)`: level, column and row of the first cell.

        Returns:
            `(..., 4)`, `(x1, y1, x2, y2)` in picture pixels.
        """
        levels = actions[..., 0]
        first_cells = actions[..., 1:]
        # In double precision, so that each edge is rounded once, as in `_middle`.
        pitch = torch.tensor(self.pitch, dtype=torch.float64)
        sizes = torch.tensor([self.window(level) for level in range(self.levels)], dtype=torch.float64)
        lower = first_cells * pitch
        upper = lower + sizes[levels]
        return torch.cat([lower, upper], -1).float()

    def fixations(self, actions: Tensor) -> Tensor:
        """Compute the centres and magnifications of windows.

        Args:
            actions: `(..., 3)`: level, column and row of the first cell.

        Returns:
            `(..., 3)`, `(x, y, m)` in picture pixels and canvas pixels per picture pixel.
        """
        boxes = self.boxes(actions).double()
        # Edges are between pixels, and places count from the centre of the first pixel.
        centres = (boxes[..., :2] + boxes[..., 2:]) / 2 - 0.5
        levels = actions[..., :1]
        magnifications = torch.tensor(self.magnifications, dtype=torch.float64)[levels]
        return torch.cat([centres, magnifications], -1).float()

    def fixation(self, level: int, column: int, row: int) -> tuple[float, float, float]:
        """Compute centre and magnification of one window: a row of `fixations`, without tensors.

        Args:
            level: of the window.
            column: of its first cell.
            row: of its first cell.

        Returns:
            `(x, y, m)`.
        """
        width, height = self.window(level)
        centre_x = _middle(column * self.pitch[0], width)
        centre_y = _middle(row * self.pitch[1], height)
        # Rounded as the tensors of `fixations` are, so that both name the same window.
        x, y, magnification = np.array([centre_x, centre_y, self.magnifications[level]], np.float32).tolist()
        return x, y, magnification

    def number(self, level: int, column: int, row: int) -> int:
        """Find the index of a window in `actions`.

        Args:
            level: of the window.
            column: of its first cell.
            row: of its first cell.

        Returns:
            The index.
        """
        before = sum(across * down for across, down in map(self.places, range(level)))
        return before + row * self.places(level)[0] + column


def _middle(start: float, length: float) -> float:
    """Find the middle of a side, whose ends are single-precision as those of `boxes`; pixel centres are at integers."""
    return (float(np.float32(start)) + float(np.float32(start + length))) / 2 - 0.5


def _rounded_up(ratio: float) -> int:
    """Round a ratio up, except where only rounding has put it above a whole number."""
    return max(1, -int(-(ratio - 1e-6) // 1))

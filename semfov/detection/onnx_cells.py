"""The cells that heads without queries lay over a canvas, level by level.

A level with stride s has a cell for every s × s pixels. Cells are numbered row by row, the finest level first:

    canvas 64 × 64, stride 8: cells 0 … 63;  stride 16: cells 64 … 79;  stride 32: cells 80 … 83
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.errors import check
from semfov.sensor.constants import constant

STRIDES = (8, 16, 32, 64)
"""Strides of the levels in canvas pixels; heads have the first three of them, or all."""

Canvas = tuple[int, int]
"""`(width, height)` in pixels."""


class CellBoxes(NamedTuple):
    """Boxes of a head with cells: how many a cell has, and the number of levels; both 0 for a head without cells."""

    anchors: int
    levels: int


def cells(canvas: Canvas, stride: int) -> tuple[int, int]:
    """Count the columns and rows of a level's map, rounded up where the canvas is not a multiple of the stride.

    Args:
        canvas: `(width, height)` in pixels.
        stride: side of a cell in pixels.

    Returns:
        `(columns, rows)`.
    """
    return -(-canvas[0] // stride), -(-canvas[1] // stride)


def cell_count(canvas: Canvas, strides: Sequence[int]) -> int:
    """Count the cells of all levels.

    Args:
        canvas: `(width, height)` in pixels.
        strides: strides of the levels in pixels.

    Returns:
        The number of cells.
    """
    total = 0
    for stride in strides:
        columns, rows = cells(canvas, stride)
        total += columns * rows
    return total


def box_counts(canvas: Canvas) -> dict[int, CellBoxes]:
    """List the possible numbers of boxes on a canvas, for each kind of head that has boxes in cells.

    Args:
        canvas: `(width, height)` in pixels.

    Returns:
        The anchors and levels of a head, by its number of boxes.
    """
    counts = {}
    for anchors in (3, 1):
        for levels in (4, 3):
            counts[anchors * cell_count(canvas, STRIDES[:levels])] = CellBoxes(anchors, levels)
    return counts


@constant
def cell_grid(
    count: int,
    canvas: Canvas,
    strides: tuple[int, ...],
    offset: float,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """List column, row and stride of every cell of all levels.

    Args:
        count: number of rows of the output that is decoded.
        canvas: `(width, height)` in pixels.
        strides: strides of the levels in pixels.
        offset: where a cell is anchored, in cells: 0 in its corner, 0.5 in its middle.
        dtype: dtype of the grid.
        device: device of the grid.

    Returns:
        `(N, 3)`, with columns and rows in cells, and the stride in pixels.

    Raises:
        InputError: the canvas has another number of cells.
    """
    expected = cell_count(canvas, strides)
    every_cell = f"{expected} rows, one for each cell of a {canvas[0]} x {canvas[1]} canvas at strides {strides}"
    check(count == expected, "output of the head", every_cell, count)
    levels = []
    for stride in strides:
        columns, rows = (torch.arange(side, device=device, dtype=dtype) + offset for side in cells(canvas, stride))
        x, y = torch.meshgrid(columns, rows, indexing="xy")
        level = torch.stack([x, y, torch.full_like(x, stride)], -1)  # (rows, columns, 3)
        levels.append(level.reshape(-1, 3))
    return torch.cat(levels)

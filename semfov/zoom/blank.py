"""Blank parts of a picture: without data, or in the single colour of a border."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.windowed import LargePicture
from semfov.zoom.lattice import Lattice

_CORNER = 64  # side in pixels of the corners in which a colour of the border is looked for

_Colour = tuple[int, ...]
_Spans = list[tuple[int, int]]
"""First and end of several parts of a line."""


def blank_cells(picture: LargePicture, lattice: Lattice) -> Tensor | None:
    """Find cells without data, and cells of a corner's colour that reach the border of the picture.

    Args:
        picture: source of the pixels.
        lattice: its cells.

    Returns:
        `(rows, columns)` boolean; None where no cell is blank.
    """
    colours = _corner_colours(picture, lattice.size)
    if not colours and picture.nothing is None:
        return None
    width, height = lattice.size
    coarse = picture.reduction(1 / lattice.magnifications[0])  # as coarse as the overview
    pixels = picture.read((0, 0, width, height), coarse).numpy()
    pixel_rows, pixel_columns = pixels.shape[1:]
    cell_width, cell_height = lattice.pitch
    cell_rows = _cell_pixels(lattice.rows, cell_height * (pixel_rows / height), pixel_rows)
    cell_columns = _cell_pixels(lattice.columns, cell_width * (pixel_columns / width), pixel_columns)
    blank = np.zeros((lattice.rows, lattice.columns), bool)
    for colour in colours:
        blank |= _border_of_colour(pixels, colour, cell_rows, cell_columns)
    if picture.nothing is not None:
        blank |= _of_colour(pixels, picture.nothing, cell_rows, cell_columns)
    return torch.from_numpy(blank) if blank.any() else None


def _corner_colours(picture: LargePicture, size: tuple[int, int]) -> set[_Colour]:
    """Find the colours of the corners that have one colour alone."""
    width, height = size
    corner_width = min(_CORNER, width)
    corner_height = min(_CORNER, height)
    colours = set()
    for y in (0, height - corner_height):
        for x in (0, width - corner_width):
            corner = picture.pixels((x, y, x + corner_width, y + corner_height))
            if (corner == corner[0, 0]).all():
                colours.add(tuple(corner[0, 0].tolist()))
    return colours


def _border_of_colour(
    pixels: NDArray[np.uint8], colour: _Colour, cell_rows: _Spans, cell_columns: _Spans
) -> NDArray[np.bool_]:
    """Find cells of a colour that reach the border over cells of it; arguments and result as for `_of_colour`."""
    # A pixel of each cell first: most cells have another colour, and the others are few strips.
    first_rows = [first for first, _ in cell_rows]
    first_columns = [first for first, _ in cell_columns]
    sample = pixels[:, first_rows][:, :, first_columns]
    has_colour = _of_colour(sample, colour, _single_pixels(len(cell_rows)), _single_pixels(len(cell_columns)))
    candidates = reaching_border(has_colour)
    for x1, x2 in _runs(candidates.any(0)):
        for y1, y2 in _runs(candidates[:, x1:x2].any(1)):
            candidates[y1:y2, x1:x2] &= _of_colour(pixels, colour, cell_rows[y1:y2], cell_columns[x1:x2])
    return reaching_border(candidates)


def _single_pixels(count: int) -> _Spans:
    """List first and end of parts of a line of one pixel each."""
    return [(pixel, pixel + 1) for pixel in range(count)]


def _of_colour(
    pixels: NDArray[np.uint8], colour: _Colour, cell_rows: _Spans, cell_columns: _Spans
) -> NDArray[np.bool_]:
    """Find cells all of whose pixels have a colour, up to rounding.

    Args:
        pixels: `(3, h, w)`.
        colour: red, green and blue.
        cell_rows: first and end of the rows of pixels of each row of cells.
        cell_columns: the same of columns.

    Returns:
        `(rows, columns)` of the cells.
    """
    top = cell_rows[0][0]
    bottom = cell_rows[-1][1]
    left = cell_columns[0][0]
    right = cell_columns[-1][1]
    width = right - left
    channels_last = pixels[:, top:bottom, left:right].transpose(1, 2, 0)
    values = channels_last.reshape(bottom - top, -1)  # three in a row for each pixel
    # Bytes would wrap round at black and white.
    lowest = np.array([max(value, 1) - 1 for value in colour], np.uint8)
    highest = np.array([min(value, 254) + 1 for value in colour], np.uint8)
    # One comparison for both limits: bytes below the lowest wrap round to large ones.
    differs = values - np.tile(lowest, width) > np.tile(highest - lowest, width)
    # Over the rows of a cell first: they are adjacent in memory, and leave little for the other steps.
    rows_differ = np.stack([differs[first - top : end - top].any(0) for first, end in cell_rows])
    pixels_differ = np.logical_or.reduce(rows_differ.reshape(len(cell_rows), width, -1), -1)
    cells_differ = np.stack([pixels_differ[:, first - left : end - left].any(1) for first, end in cell_columns], 1)
    return ~cells_differ


def _cell_pixels(cells: int, pitch: float, length: int) -> _Spans:
    """List first and end of the pixels of each cell; those at the border of two cells count for both.

    Args:
        cells: number of cells.
        pitch: pixels of a cell.
        length: number of pixels.
    """
    spans = []
    for cell in range(cells):
        # At least one pixel, also where cells are smaller than pixels.
        first = min(int(cell * pitch), length - 1)
        end = max(int(np.ceil((cell + 1) * pitch)), first + 1)
        spans.append((first, min(end, length)))
    return spans


def _runs(marked: NDArray[np.bool_] | np.bool_) -> _Spans:
    """List first and end of each run of marked places in a row."""
    changes = np.flatnonzero(np.diff(np.pad(marked.astype(np.int8), 1))).tolist()
    return [*zip(changes[::2], changes[1::2], strict=True)]


def reaching_border(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep the marked cells that are connected to the border by marked cells.

    Runs of marked cells in a row are linked where they touch. To grow the border cell by cell would take as many steps
    as the longest way is long, and a picture may hold a maze.

    Args:
        cells: `(rows, columns)`.

    Returns:
        `(rows, columns)`, the marked cells that are kept.
    """
    begins = _begin_of_runs(cells)
    # 0 is all beyond the border, and the runs are numbered from 1.
    runs = np.cumsum(begins, dtype=np.int32).reshape(cells.shape) * cells
    touch = _begin_of_runs(cells[:-1] & cells[1:])
    outer = np.concatenate([runs[0], runs[-1], runs[:, 0], runs[:, -1]])
    outer = outer[outer > 0]
    first = np.concatenate([runs[:-1][touch], outer])
    second = np.concatenate([runs[1:][touch], np.zeros_like(outer)])
    reaches = _least_linked(int(begins.sum()) + 1, first, second) == 0
    return reaches[runs] & cells


def _begin_of_runs(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep the first of each run of marked cells in a row; `(rows, columns)`."""
    begins = marked.copy()
    begins[:, 1:] &= ~marked[:, :-1]
    return begins


def _least_linked(count: int, first: NDArray[np.int32], second: NDArray[np.int32]) -> NDArray[np.int32]:
    """Find for each of some numbers the least one to which links lead, over others as well.

    Args:
        count: how many numbers there are, from 0.
        first: the numbers at one end of the links.
        second: those at the other end.

    Returns:
        `(count,)`.
    """
    least = np.arange(count, dtype=np.int32)
    while True:
        ends = np.stack([least[first], least[second]])
        differ = ends[0] != ends[1]
        if not differ.any():
            return least
        first = first[differ]
        second = second[differ]
        np.minimum.at(least, ends.max(0)[differ], ends.min(0)[differ])
        # Links of links halve the ways: a maze would take as many rounds as its way is long.
        while not np.array_equal(further := least[least], least):
            least = further

"""The ground of a picture where there is nothing to see: without data, or in the one colour of a blank border."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.windowed import LargePicture
from semfov.zoom.lattice import Lattice

_Spans = list[tuple[int, int]]


def blank_cells(picture: LargePicture, lattice: Lattice) -> Tensor | None:
    """Cells `(rows, columns)` without data, or of a corner's colour up to the border; None where no cell is blank."""
    (width, height), (wide, high) = lattice.size, (min(64, length) for length in lattice.size)
    corners = [(x, y, x + wide, y + high) for y in (0, height - high) for x in (0, width - wide)]
    parts = [picture.pixels(box) for box in corners]
    colours: set[tuple[int, ...]] = {tuple(part[0, 0].tolist()) for part in parts if (part == part[0, 0]).all()}
    if not colours and picture.nothing is None:
        return None
    reduction = picture.reduction(1 / lattice.magnifications[0])
    pixels = picture.read((0, 0, width, height), reduction).numpy()
    blank, (height, width) = np.zeros((lattice.rows, lattice.columns), bool), pixels.shape[1:]
    down = _spans(lattice.rows, lattice.pitch[1] * (height / lattice.size[1]), height)
    across = _spans(lattice.columns, lattice.pitch[0] * (width / lattice.size[0]), width)
    # A pixel of each cell first: most cells have another colour, and the others are few strips.
    some = pixels[:, [first for first, _ in down]][:, :, [first for first, _ in across]]
    rows, columns = ([(n, n + 1) for n in range(length)] for length in blank.shape)
    for colour in colours:
        perhaps = _from_border(_of_colour(some, colour, rows, columns))
        for x1, x2 in _runs(perhaps.any(0)):
            for y1, y2 in _runs(perhaps[:, x1:x2].any(1)):
                perhaps[y1:y2, x1:x2] &= _of_colour(pixels, colour, down[y1:y2], across[x1:x2])
        blank |= _from_border(perhaps)
    if picture.nothing is not None:
        blank |= _of_colour(pixels, picture.nothing, down, across)
    return torch.from_numpy(blank) if blank.any() else None


def _of_colour(pixels: NDArray[np.uint8], colour: tuple[int, ...], down: _Spans, across: _Spans) -> NDArray[np.bool_]:
    """Whether all pixels of some cells have a colour, up to rounding; pixels `(3, h, w)` → `(rows, columns)`."""
    low, span = np.array([(max(value, 1) - 1, min(value, 254) - max(value, 1) + 2) for value in colour]).T.astype(
        np.uint8
    )
    (top, bottom), (left, right) = ((spans[0][0], spans[-1][1]) for spans in (down, across))
    part, width = pixels[:, top:bottom, left:right].transpose(1, 2, 0), right - left
    # Bytes below the lowest wrap round to large ones.
    other = part.reshape(bottom - top, -1) - np.tile(low, width) > np.tile(span, width)
    other = np.stack([other[first - top : end - top].any(0) for first, end in down])
    other = np.logical_or.reduce(other.reshape(len(down), width, -1), -1)
    return ~np.stack([other[:, first - left : end - left].any(1) for first, end in across], 1)


def _spans(cells: int, pitch: float, length: int) -> _Spans:
    """First and end of the pixels of each cell; those at the border of two cells count for both."""
    firsts = [min(int(cell * pitch), length - 1) for cell in range(cells)]
    return [(first, min(max(int(np.ceil((n + 1) * pitch)), first + 1), length)) for n, first in enumerate(firsts)]


def _runs(marked: NDArray[np.bool_] | np.bool_) -> list[tuple[int, int]]:
    """First and end of each run of marked places in a row."""
    turns = np.flatnonzero(np.diff(np.pad(marked.astype(np.int8), 1))).tolist()
    return [*zip(turns[::2], turns[1::2], strict=True)]


def _from_border(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those of some cells that reach the border over their neighbours."""
    reached = cells.copy()
    reached[1:-1, 1:-1] = False
    while True:
        wider = np.pad(reached, 1)
        grown = cells & (wider[1:-1, 1:-1] | wider[:-2, 1:-1] | wider[2:, 1:-1] | wider[1:-1, :-2] | wider[1:-1, 2:])
        if (grown == reached).all():
            return reached
        reached = grown

"""The ground of a picture where there is nothing to see: without data, or in the one colour of a blank border."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.windowed import LargePicture
from semfov.zoom.glances import Window
from semfov.zoom.lattice import Lattice


def blank_cells(picture: LargePicture, lattice: Lattice) -> Tensor | None:
    """Cells whose pixels have no data, or all have the colour of a corner and lie in one blank area with the border.

    >>> from semfov.data.large import open_large
    >>> scan = torch.randint(256, (3, 1600, 1600), dtype=torch.uint8)
    >>> scan[:, :, 800:] = 0
    >>> blank_cells(open_large(scan), Lattice.over((1600, 1600), (400, 400))).float().mean(0)[[0, 15, 16, 31]]
    tensor([0., 0., 1., 1.])

    Shapes: → `(rows, columns)` boolean; None where no cell is blank.
    """
    (width, height), (wide, high) = lattice.size, (min(64, length) for length in lattice.size)
    corners = [(x, y, x + wide, y + high) for y in (0, height - high) for x in (0, width - wide)]
    colours = {colour for box in corners if (colour := _only_colour(picture.pixels(box))) is not None}
    if not colours and picture.nothing is None:
        return None
    reduction = picture.reduction(1 / lattice.magnifications[0])
    pixels = picture.read((0, 0, width, height), reduction).numpy()
    blank = np.zeros((lattice.rows, lattice.columns), bool)
    for colour in colours:
        blank |= _from_border(_of_colour(pixels, colour, lattice))
    if picture.nothing is not None:
        blank |= _of_colour(pixels, picture.nothing, lattice)
    return torch.from_numpy(blank) if blank.any() else None


def not_blank(windows: Sequence[Window], blank: Tensor | None) -> list[Window]:
    """The windows that show more than blank cells; all of them where all are blank."""
    if blank is None:
        return [*windows]
    seen = [each for each in windows if not blank[each.cells[1] : each.cells[3], each.cells[0] : each.cells[2]].all()]
    return seen or [*windows]


def _only_colour(pixels: NDArray[np.uint8]) -> tuple[int, ...] | None:
    """The colour of all pixels; None where there are several."""
    colour = pixels[0, 0]
    return tuple(colour.tolist()) if (pixels == colour).all() else None


def _of_colour(pixels: NDArray[np.uint8], colour: tuple[int, ...], lattice: Lattice) -> NDArray[np.bool_]:
    """Whether all pixels of each cell have a colour, up to rounding; pixels `(3, h, w)` → `(rows, columns)`."""
    low, span = np.array([(max(value, 1) - 1, min(value, 254) - max(value, 1) + 2) for value in colour]).T.astype(
        np.uint8
    )
    height, width = pixels.shape[1:]
    # Bytes below the lowest wrap round to large ones.
    other = pixels.transpose(1, 2, 0).reshape(height, -1) - np.tile(low, width) > np.tile(span, width)
    # Pixels at the border of two cells count for both.
    down = _spans(lattice.rows, lattice.pitch[1] * (height / lattice.size[1]), height)
    other = np.stack([other[first:end].any(0) for first, end in down])
    other = np.logical_or.reduce(other.reshape(lattice.rows, width, -1), -1)
    across = _spans(lattice.columns, lattice.pitch[0] * (width / lattice.size[0]), width)
    return ~np.stack([other[:, first:end].any(1) for first, end in across], 1)


def _spans(cells: int, pitch: float, length: int) -> Iterator[tuple[int, int]]:
    """First and end of the pixels of each cell."""
    for cell in range(cells):
        first = min(int(cell * pitch), length - 1)
        yield first, min(max(int(np.ceil((cell + 1) * pitch)), first + 1), length)


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

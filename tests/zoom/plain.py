"""What a belief expects of the windows of a picture, computed from scratch from the looks so far, one by one."""

from collections.abc import Sequence

import numpy as np
import torch

from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.hints import Gist
from semfov.zoom.looks import WindowLook
from semfov.zoom.survey import STEPS


def cells_shown(lattice: Lattice, look: Gist) -> tuple[slice, slice]:
    """Rows and columns of the cells that a look shows."""
    (x, y), (rows, columns) = look.first, look.scores.shape[:2]
    return slice(y, y + rows * look.scale), slice(x, x + columns * look.scale)


def left(lattice: Lattice, looks: Sequence[WindowLook]) -> np.ndarray:
    """u(x), 0 in the windows that were looked at as closely as possible and 1 elsewhere, `(rows, columns)`."""
    cells = np.ones((lattice.rows, lattice.columns))
    for look in looks:
        if look.gist is None:
            x1, y1, x2, y2 = look.window.cells
            cells[max(y1, 0) : y2, max(x1, 0) : x2] = 0
    return cells


def closest(lattice: Lattice, looks: Sequence[WindowLook]) -> np.ndarray:
    """s(x), the level of the closest look that has closer ones at each cell, `(rows, columns)`."""
    cells = np.full((lattice.rows, lattice.columns), -1)
    for look in looks:
        if look.gist is not None:
            at = cells_shown(lattice, look.gist)
            cells[at] = np.maximum(cells[at], look.gist.level)
    return cells


def expected(
    lattice: Lattice, evidence: GlimpseEvidence, target: int, looks: Sequence[WindowLook]
) -> dict[int, np.ndarray]:
    r"""Objects that looks of each level find in each cell, :math:`n_k(x) = u(x) \, \lambda_{k - s(x)}(x)`.

    The rates λ of a look depend on those of the looks before it.
    """
    source = np.full((lattice.rows, lattice.columns), -1)
    rates = np.zeros((STEPS, lattice.rows, lattice.columns))
    for window_look in looks:
        look = window_look.gist
        if look is None:
            continue
        at = cells_shown(lattice, look)
        before = None
        if look.level:
            known = np.zeros([n * look.scale for n in look.scores.shape[:2]])
            for (row, column), level in np.ndenumerate(source[at]):
                known[row, column] = rates[min(max(look.level - level, 0), STEPS - 1)][at][row, column]
            rows, columns = look.scores.shape[:2]
            sums = known.reshape(rows, look.scale, columns, look.scale).sum((1, 3))
            before = torch.from_numpy(np.log(sums + 1e-6)).float()[None]
        told = evidence.rates(look, torch.tensor([target]), before)[0].exp().double().numpy() / look.scale**2
        for row, column in np.ndindex(*source[at].shape):
            if source[at][row, column] < look.level:
                rates[:, at[0].start + row, at[1].start + column] = told[:, row // look.scale, column // look.scale]
                source[at[0].start + row, at[1].start + column] = look.level
    levels = {}
    for level in range(lattice.levels):
        cells = levels[level] = np.zeros(source.shape)
        for (row, column), seen in np.ndenumerate(source):
            if 1 <= level - seen <= STEPS and seen >= 0:
                cells[row, column] = rates[level - seen - 1, row, column]
        cells *= left(lattice, looks)
    return levels


def sums(lattice: Lattice, cells: np.ndarray, level: int, weight: np.ndarray) -> np.ndarray:
    r""":math:`S_{ij} = \sum_{k,l} r_k r_l \, x_{i+k,\,j+l}`, over the windows of a level, `(down, across)`."""
    (across, down), span = lattice.places(level), lattice.span(level)
    found = np.zeros((down, across))
    for row, column in np.ndindex(down, across):
        part = cells[row : row + span, column : column + span]
        found[row, column] = weight[: part.shape[0]] @ part @ weight[: part.shape[1]]
    return found

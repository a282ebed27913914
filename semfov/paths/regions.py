"""Named regions of a map of what is where: adjacent cells with the same most probable class."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.grid import Grid


class Region(NamedTuple):
    """Region of adjacent cells with one class.

    Attributes:
        name: name of the class.
        cells: numbers of the cells, in their order.
        probability: highest probability of the class in them.
        place: centre `(x, y)` of the first cell with that probability, in pixels.
    """

    name: str
    cells: list[int]
    probability: float
    place: tuple[float, float]


def named_regions(grid: Grid, probabilities: Tensor, classes: Sequence[str]) -> list[Region]:
    """Find the regions of adjacent cells with one class that is more probable than background.

    The class must also have a probability of 3 / K, or 0.5 where that is more, so that a map without knowledge, in
    which all classes are equally probable, has no regions.

    Args:
        grid: the cells.
        probabilities: `(X·Y, K+1)`, probability of each class in each cell.
        classes: names of the classes, background first.

    Returns:
        The regions, the largest first.
    """
    probabilities = probabilities.detach().cpu()
    background = probabilities[:, 0]  # (X·Y,), as the four below
    highest, best = probabilities[:, 1:].max(-1)
    threshold = background.clamp(min=min(0.5, 3 / len(classes)))
    label = torch.where(highest > threshold, best + 1, 0)  # background where no class stands out
    regions = []
    for cells in _regions(label.reshape(grid.rows, grid.columns)):
        peak = cells[int(highest[cells].argmax())]
        x, y = grid.centres[peak].tolist()
        regions.append(Region(classes[int(label[peak])], cells, float(highest[peak]), (x, y)))
    return sorted(regions, key=lambda region: -len(region.cells))


def _regions(labels: Tensor) -> list[list[int]]:
    """Find the regions of cells that touch at a side and share a label other than 0.

    Args:
        labels: `(Y, X)`.

    Returns:
        The cells of each region in their order.
    """
    rows, columns = labels.shape
    label_of = labels.flatten().tolist()
    visited: set[int] = set()
    regions = []
    for first, label in enumerate(label_of):
        if label == 0 or first in visited:
            continue
        # From the first cell the region grows by neighbours with its label, until it has none.
        region = []
        border = [first]
        visited.add(first)
        while border:
            cell = border.pop()
            region.append(cell)
            unvisited = _neighbours(cell, rows, columns) - visited
            alike = {neighbour for neighbour in unvisited if label_of[neighbour] == label}
            visited |= alike
            border += alike
        regions.append(sorted(region))
    return regions


def _neighbours(cell: int, rows: int, columns: int) -> set[int]:
    """List the cells that share a side with a cell."""
    row, column = divmod(cell, columns)
    places = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
    return {y * columns + x for y, x in places if 0 <= y < rows and 0 <= x < columns}

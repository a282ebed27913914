"""Fixations in bins of a raster, and predictors for any picture: centre bias and saccade length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations


@dataclass(frozen=True)
class Events:
    """The fixations of one picture to be predicted: all except the first of each scanpath.

    Attributes:
        bins: `(E, 2)`, column and row of the fixated bin.
        before: `(E, 2)`, column and row of the bin of the previous fixation.
        visited: `(E, X·Y)`, 1 for cells of the grid of looks that were fixated before, else 0.
        number: `(E,)`, number of gaze shifts before, from 0.
        person: `(E,)`, index of the scanpath.
        cells: for each scanpath `(n,)`, the fixated cells of the grid of looks.
        fine: for each scanpath `(n,)`, the fixated bins.
    """

    bins: Tensor
    before: Tensor
    visited: Tensor
    number: Tensor
    person: Tensor
    cells: tuple[Tensor, ...]
    fine: tuple[Tensor, ...]

    def __len__(self) -> int:
        return len(self.number)


def events_of(people: Sequence[Fixations], raster: Grid, grid: Grid, longest: int) -> Events:
    """The events of all people in one picture.

    Args:
        people: the fixations of each person in pixels of the picture; points outside it belong to the nearest bin.
        raster: the bins.
        grid: the grid of looks.
        longest: number of fixations of a scanpath that are used, the first ones.

    Returns:
        The events.
    """
    bins, before, visited, number, person, cells, fine = [], [], [], [], [], [], []
    for index, each in enumerate(people):
        points = torch.from_numpy(each.points[:longest])
        path_bins, cell = bins_of(raster, points), grid.cell_of(points)
        cells.append(cell)
        fine.append(raster.cell_of(points))
        bins.append(path_bins[1:])
        before.append(path_bins[:-1])
        visited.append(F.one_hot(cell[:-1], len(grid)).cumsum(0).clamp(max=1).float())
        number.append(torch.arange(len(path_bins) - 1))
        person.append(torch.full((len(path_bins) - 1,), index))
    return Events(
        torch.cat(bins),
        torch.cat(before),
        torch.cat(visited),
        torch.cat(number),
        torch.cat(person),
        tuple(cells),
        tuple(fine),
    )


def bins_of(raster: Grid, points: Tensor) -> Tensor:
    """Column and row of the bin of each point, `(n, 2)`."""
    bins = raster.cell_of(points)
    return torch.stack([bins % raster.columns, bins // raster.columns], -1)


@dataclass(frozen=True)
class Habits:
    """Viewing habits of people in any picture, as log densities over bins.

    Attributes:
        centre: `(H, W)`, log density of all fixations except the first of each scanpath.
        jump: `(2H-1, 2W-1)`, log density of displacements from one fixation to the next; the zero displacement is in
            the middle.
    """

    centre: Tensor
    jump: Tensor

    @classmethod
    def of(cls, events: Sequence[Events], columns: int, rows: int, *, blur: float = 1.0, floor: float = 0.05) -> Habits:
        """Measure habits: counts, blurred by a Gaussian of `blur` bins (twice as wide for the centre), plus `floor`."""
        bins, before = (torch.cat([getattr(each, name) for each in events]) for name in ("bins", "before"))
        centre, jump = torch.zeros(rows, columns), torch.zeros(2 * rows - 1, 2 * columns - 1)
        one = torch.ones(len(bins))
        centre.index_put_((bins[:, 1], bins[:, 0]), one, accumulate=True)
        step = bins - before
        jump.index_put_((step[:, 1] + rows - 1, step[:, 0] + columns - 1), one, accumulate=True)
        return cls(_log(blurred(centre[None], 2 * blur)[0] + floor), _log(blurred(jump[None], blur)[0] + floor))

    def near(self, before: Tensor) -> Tensor:
        """Log density `(E, H, W)` of the bin after each fixation `(E, 2)`; within the picture it may not sum to 1."""
        height, width = self.centre.shape
        rows = height - 1 - before[:, 1, None, None] + torch.arange(height)[:, None]
        columns = width - 1 - before[:, 0, None, None] + torch.arange(width)
        return self.jump[rows, columns]


def blurred(maps: Tensor, sigma: float) -> Tensor:
    """Blur maps `(E, H, W)` by a Gaussian of `sigma` bins; they are reflected at the border."""
    if sigma == 0 or not len(maps):
        return maps
    reach = min(int(3 * sigma + 0.5), min(maps.shape[-2:]) - 1)
    return gaussian_blur2d(maps[:, None], (2 * reach + 1,) * 2, (sigma, sigma), border_type="reflect")[:, 0]


def enlarged(values: Tensor, grid: Grid, rows: int, columns: int) -> Tensor:
    """Interpolate values `(E, X·Y)` of cells bilinearly between the cell centres, to maps `(E, rows, columns)`."""
    maps = values.reshape(-1, 1, grid.rows, grid.columns)
    if (grid.rows, grid.columns) == (rows, columns):
        return maps[:, 0]
    return F.interpolate(maps, (rows, columns), mode="bilinear", align_corners=False)[:, 0]


def _log(counts: Tensor) -> Tensor:
    return (counts / counts.sum()).log()

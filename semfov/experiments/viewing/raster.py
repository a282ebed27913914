"""Pictures in equal bins, and what foretells fixations in any picture: the centre, and how far eyes jump."""

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
    """The fixations of one picture that are foretold, each after the one before it in its scanpath.

    Attributes:
        bins: `(E, 2)`, column and row of the bin that is fixated.
        before: `(E, 2)`, of the fixation before.
        visited: `(E, X·Y)`, 1 for cells of the looks' grid that were fixated before, else 0.
        number: `(E,)`, gaze shifts before, from 0.
        person: `(E,)`, index of the scanpath.
        cells: for each scanpath `(n,)`, cells of the looks' grid that are fixated.
        fine: the same in bins.
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
    """Events of all people in one picture.

    Args:
        people: their fixations, in pixels of the picture; points beside it count to the nearest bin.
        raster: the bins.
        grid: cells that looks are from.
        longest: fixations of a scanpath that count.
    """
    bins, before, visited, number, person, cells, fine = [], [], [], [], [], [], []
    for index, each in enumerate(people):
        points = torch.from_numpy(each.points[:longest])
        found, cell = places(raster, points), grid.cell_of(points)
        cells.append(cell)
        fine.append(raster.cell_of(points))
        bins.append(found[1:])
        before.append(found[:-1])
        visited.append(F.one_hot(cell[:-1], len(grid)).cumsum(0).clamp(max=1).float())
        number.append(torch.arange(len(found) - 1))
        person.append(torch.full((len(found) - 1,), index))
    return Events(
        torch.cat(bins),
        torch.cat(before),
        torch.cat(visited),
        torch.cat(number),
        torch.cat(person),
        tuple(cells),
        tuple(fine),
    )


def places(raster: Grid, points: Tensor) -> Tensor:
    """Column and row of the bin of each point, `(n, 2)`."""
    bins = raster.cell_of(points)
    return torch.stack([bins % raster.columns, bins // raster.columns], -1)


@dataclass(frozen=True)
class Habits:
    """What people do in any picture, as logarithms of densities over bins.

    Attributes:
        centre: `(H, W)`, of all fixations but the first of each scanpath.
        jump: `(2H-1, 2W-1)`, of displacements from one fixation to the next; no displacement is in the middle.
    """

    centre: Tensor
    jump: Tensor

    @classmethod
    def of(cls, events: Sequence[Events], columns: int, rows: int, *, blur: float = 1.0, floor: float = 0.05) -> Habits:
        """Counts, blurred by a Gaussian of so many bins (the centre's twice as wide), and a little everywhere."""
        bins, before = (torch.cat([getattr(each, name) for each in events]) for name in ("bins", "before"))
        centre, jump = torch.zeros(rows, columns), torch.zeros(2 * rows - 1, 2 * columns - 1)
        one = torch.ones(len(bins))
        centre.index_put_((bins[:, 1], bins[:, 0]), one, accumulate=True)
        step = bins - before
        jump.index_put_((step[:, 1] + rows - 1, step[:, 0] + columns - 1), one, accumulate=True)
        return cls(_log(blurred(centre[None], 2 * blur)[0] + floor), _log(blurred(jump[None], blur)[0] + floor))

    def near(self, before: Tensor) -> Tensor:
        """Log density of the bin after each fixation `(E, 2)`, `(E, H, W)`; in the picture it need not sum to 1."""
        height, width = self.centre.shape
        rows = height - 1 - before[:, 1, None, None] + torch.arange(height)[:, None]
        columns = width - 1 - before[:, 0, None, None] + torch.arange(width)
        return self.jump[rows, columns]


def blurred(maps: Tensor, sigma: float) -> Tensor:
    """Maps `(E, H, W)` blurred by a Gaussian of so many bins; at the border they are mirrored."""
    if sigma == 0 or not len(maps):
        return maps
    reach = min(int(3 * sigma + 0.5), min(maps.shape[-2:]) - 1)
    return gaussian_blur2d(maps[:, None], (2 * reach + 1,) * 2, (sigma, sigma), border_type="reflect")[:, 0]


def enlarged(values: Tensor, grid: Grid, rows: int, columns: int) -> Tensor:
    """Values `(E, X·Y)` of cells as maps `(E, H, W)`, bilinear between their centres."""
    maps = values.reshape(-1, 1, grid.rows, grid.columns)
    if (grid.rows, grid.columns) == (rows, columns):
        return maps[:, 0]
    return F.interpolate(maps, (rows, columns), mode="bilinear", align_corners=False)[:, 0]


def _log(counts: Tensor) -> Tensor:
    return (counts / counts.sum()).log()

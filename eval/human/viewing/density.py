"""Densities of the next fixation: fixations in bins, habits of people in any picture, and weights of maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn import functional as F

from eval.human.habits.gaze_habits import standardised as over_cells
from eval.human.habits.log_linear import fit_log_linear
from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.errors import check


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
    paths = [torch.from_numpy(each.points[:longest]) for each in people]
    cells, fine = (tuple(each.cell_of(path) for path in paths) for each in (grid, raster))
    columns = []
    for index, (path, cell) in enumerate(zip(paths, cells, strict=True)):
        along = bins_of(raster, path)
        seen = F.one_hot(cell[:-1], len(grid)).cumsum(0).clamp(max=1).float()
        shifts = torch.arange(len(along) - 1)
        columns.append((along[1:], along[:-1], seen, shifts, torch.full_like(shifts, index)))
    bins, before, visited, number, person = map(torch.cat, zip(*columns, strict=True))
    return Events(bins, before, visited, number, person, cells, fine)


def bins_of(raster: Grid, points: Tensor) -> Tensor:
    """Column and row of the bin of each point, `(n, 2)`."""
    bins = raster.cell_of(points)
    return torch.stack([bins % raster.columns, bins // raster.columns], -1)


HABITS = ("centre bias", "distance", "return")
"""Predictors of fixations in any picture: position, distance from the last fixation, and earlier visits."""


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

    def term(self, name: str, before: Tensor, visited: Tensor, grid: Grid) -> Tensor:
        """Maps `(E, H, W)` of one of `HABITS`, after fixations in the bins `before` and of the cells `visited`."""
        height, width = self.centre.shape
        return {
            "centre bias": lambda: self.centre.expand(len(before), -1, -1),
            "distance": lambda: self.near(before),
            "return": lambda: enlarged(visited, grid, height, width),
        }[name]()

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


RIDGE = 1e-3
"""Ridge penalty of the fit.

It is negligible against thousands of fixations, but it determines the weight of a map that is constant.
"""


@dataclass(frozen=True)
class DensityWeights:
    """Weights of the terms of a density.

    Attributes:
        terms: names of the terms.
        values: `(T,)`, their weights.
        blur: standard deviation of the maps' blur, in bins.
        bits: mean log likelihood of the fitted fixations in bits, relative to a uniform density.
    """

    terms: tuple[str, ...]
    values: Tensor
    blur: float
    bits: float


def standardised_maps(maps: Tensor) -> Tensor:
    """Standardise maps `(E, H, W)` to mean 0 and standard deviation 1; a constant map becomes 0."""
    return over_cells(maps.flatten(-2)).view_as(maps)


def log_densities(terms: Sequence[Tensor], weights: Tensor) -> Tensor:
    r"""Log density of the next fixation over the bins, `(E, H, W)`.

    .. math:: \ln p(u) = \sum_t w_t f_t(u) - \ln \sum_v e^{\sum_t w_t f_t(v)}

    Args:
        terms: the T terms, maps `(E, H, W)` or `(1, H, W)`.
        weights: `(T,)`, their weights.

    Returns:
        `(E, H, W)`, the log density for each of E fixations.
    """
    total = sum((weight * term for weight, term in zip(weights, terms, strict=True)), torch.zeros(()))
    return total - total.logsumexp((-1, -2), keepdim=True)


def fit_density(names: Sequence[str], terms: Sequence[Tensor], bins: Tensor, blur: float = 0.0) -> DensityWeights:
    """Fit the weights of a density by maximum likelihood (`eval.human.habits.log_linear`).

    Args:
        names: names of the terms.
        terms: maps `(E, H, W)` or `(1, H, W)`.
        bins: `(E, 2)`, column and row of the bin of each fixation.
        blur: standard deviation of the blur that was applied to the maps, for the record.

    Returns:
        The fitted weights.
    """
    check(len(names) == len(terms) > 0, "terms", f"{len(names)} maps, at least one", len(terms))
    height, width = terms[0].shape[-2:]
    features = torch.stack([term.expand(len(bins), -1, -1).flatten(1) for term in terms], -1)
    weights = fit_log_linear(features, bins[:, 1] * width + bins[:, 0], ridge=RIDGE).to(features)
    with torch.no_grad():
        likelihood = float(values_in_bins(log_densities(terms, weights), bins).mean())
    return DensityWeights(tuple(names), weights, blur, (likelihood + math.log(height * width)) / math.log(2))


def values_in_bins(maps: Tensor, bins: Tensor) -> Tensor:
    """Values `(E,)` of maps `(E, H, W)` in the bins `(E, 2)`."""
    return maps.expand(len(bins), -1, -1)[torch.arange(len(bins)), bins[:, 1], bins[:, 0]]

"""Rows of the tables: models of the next fixation, fitted on one half of the pictures and scored on the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from eval.human.viewing.density import (
    HABITS,
    DensityWeights,
    Events,
    Habits,
    blurred,
    fit_density,
    log_densities,
    standardised_maps,
)
from eval.human.viewing.run import ViewingRun
from semfov.errors import check
from semfov.metrics.averages import standard_error
from semfov.metrics.scanpath import auc, log_likelihood, nss

_Array = NDArray[np.float64]

PEOPLE = "other people"
"""Fixations of all other people in the same picture."""


@dataclass(frozen=True)
class Row:
    """One model of the next fixation.

    Attributes:
        name: its name in tables.
        maps: names of the maps that it uses.
        habits: the terms of `HABITS` that it also uses.
    """

    name: str
    maps: tuple[str, ...] = ()
    habits: tuple[str, ...] = ()

    @property
    def group(self) -> str:
        """`alone`, or `with habits`."""
        return "with habits" if len(self.habits) == len(HABITS) else "alone"


def rows_of(names: Sequence[str], saliency: Sequence[str]) -> list[Row]:
    """All rows: baselines, every map alone and with habits, saliency combined with landing, and other people."""
    rows = [Row("random"), Row("centre bias", (), HABITS[:1]), Row("nearby", (), HABITS)]
    several = [(f"landing + {name}", ("landing", name)) for name in saliency]
    for name, maps in [*((name, (name,)) for name in names), *several, (PEOPLE, (PEOPLE,))]:
        rows += [Row(name, maps), Row(name, maps, HABITS)]
    return rows


@dataclass
class Half:
    """One half of the pictures with its events, and the maps of the models for them.

    Attributes:
        run: the run.
        pictures: indices of the pictures.
        events: events of each picture.
        habits: habits measured on the half for fitting.
    """

    run: ViewingRun
    pictures: Sequence[int]
    events: list[Events]
    habits: Habits

    def map_of(self, name: str, place: int) -> Tensor:
        """Maps `(E, H, W)` or `(1, H, W)` of a picture."""
        if name == PEOPLE:
            return people_maps(self.events[place], *self.habits.centre.shape)
        return self.run.maps(name, self.pictures[place])

    def terms(self, row: Row, place: int, blur: float, chosen: Tensor) -> list[Tensor]:
        """Terms of a row's density for some events of a picture."""
        events, (height, width) = self.events[place], self.habits.centre.shape
        terms = []
        for name in row.maps:
            maps = self.map_of(name, place)
            maps = maps if len(maps) == 1 else maps[chosen]
            smooth = blurred(maps, blur)
            if name == PEOPLE:  # a density is used as its logarithm, after a small constant is added
                smooth = (smooth / smooth.sum((-1, -2), keepdim=True) + 0.1 / (height * width)).log()
            terms.append(standardised_maps(smooth).expand(len(chosen), -1, -1))
        before, visited, grid = events.before[chosen], events.visited[chosen], self.run.grid(self.pictures[place])
        return terms + [self.habits.term(name, before, visited, grid) for name in row.habits]


def people_maps(events: Events, rows: int, columns: int) -> Tensor:
    """For each event, counts `(E, H, W)` of all other people's fixations in bins, without first fixations."""
    count = torch.zeros(int(events.person.max()) + 1, rows * columns)
    bins = events.bins[:, 1] * columns + events.bins[:, 0]
    count.index_put_((events.person, bins), torch.ones(len(bins)), accumulate=True)
    others = count.sum(0) - count
    return others[events.person].view(-1, rows, columns)


def fit_row(row: Row, half: Half) -> DensityWeights:
    """Fit the weights and the blur of a row by maximum likelihood."""
    density = half.run.config.density
    names = [*row.maps, *row.habits]
    sizes = torch.tensor([len(each) for each in half.events])
    generator = torch.Generator().manual_seed(density.seed)
    drawn = torch.randperm(int(sizes.sum()), generator=generator)[: density.events].sort().values
    first = sizes.cumsum(0) - sizes
    draws = [
        (place, drawn[(drawn >= start) & (drawn < start + size)] - start)
        for place, (start, size) in enumerate(zip(first.tolist(), sizes.tolist(), strict=True))
    ]
    draws = [(place, chosen) for place, chosen in draws if len(chosen)]
    bins = torch.cat([half.events[place].bins[chosen] for place, chosen in draws])
    if not names:
        return DensityWeights((), torch.zeros(0), 0.0, 0.0)
    blurs = [each for each in density.blurs if not (PEOPLE in row.maps and each == 0)] if row.maps else [0.0]
    fits = []
    for blur in blurs:
        split = [half.terms(row, place, blur, chosen) for place, chosen in draws]
        fits.append(fit_density(names, [torch.cat(term) for term in zip(*split, strict=True)], bins, blur))
    return max(fits, key=lambda each: each.bits)


def score_row(row: Row, weights: DensityWeights, half: Half, place: int) -> _Array:
    """NSS, AUC and bits above a uniform density for each event of a picture, `(E, 3)`."""
    events = half.events[place]
    every = torch.arange(len(events))
    height, width = half.habits.centre.shape
    if not weights.terms:
        density = torch.full((len(events), height, width), -np.log(height * width))
    else:
        density = log_densities(half.terms(row, place, weights.blur, every), weights.values)
    x, y = (events.bins[:, axis, None].numpy() for axis in (0, 1))
    log = density.double().numpy()
    figures = nss(np.exp(log), x, y), auc(log, x, y), log_likelihood(log, x, y)
    return np.concatenate(figures, axis=1)


MEASURES = ("NSS", "AUC", "log likelihood")
"""Conditional scores of each fixation; the log likelihood is in bits above a uniform density."""


@dataclass(frozen=True)
class Scored:
    """A row with its fitted weights and its scores.

    Attributes:
        row: the row.
        weights: the fitted weights of its terms.
        pictures: `(P, 3)`, mean of each of `MEASURES` over the fixations of each picture.
        shifts: `(P, N, 3)`, the same over the fixations after 1, 2, … gaze shifts; NaN where a picture has none.
    """

    row: Row
    weights: DensityWeights
    pictures: _Array
    shifts: _Array

    def difference(self, other: Scored, figure: int = 0) -> tuple[float, float]:
        """Mean difference of a score from that of another row, paired by picture, and its standard error."""
        gap = self.pictures[:, figure] - other.pictures[:, figure]
        return float(gap.mean()), float(standard_error(gap))


def halves(run: ViewingRun) -> tuple[Half, Half]:
    """Split the pictures alternately into a half for fitting and a half for reporting; habits are from the first."""
    order = list(range(len(run.scenes)))
    check(len(order) >= 2, "data", "at least two pictures, one to fit on and one to report on", len(order))
    fitted, reported = (order[1::2], order[::2]) if run.config.swap else (order[::2], order[1::2])
    events = {index: run.events(index) for index in order}
    density = run.config.density
    habits = Habits.of([events[index] for index in fitted], density.columns, density.rows)
    first, second = (Half(run, part, [events[index] for index in part], habits) for part in (fitted, reported))
    return first, second


def score_all(run: ViewingRun, fitted: Half, reported: Half, *, longest: int = 8) -> dict[tuple[str, str], Scored]:
    """Fit and score every row; results by name and group (`Row.group`)."""
    scored = {}
    for row in tqdm(rows_of(run.names, run.config.models), desc="scoring", unit="row"):
        weights = fit_row(row, fitted)
        means, shifts = [], []
        for place, events in enumerate(reported.events):
            figures = score_row(row, weights, reported, place)
            means.append(figures.mean(0))
            number = events.number.numpy()
            shifts.append([_mean(figures[number == n]) for n in range(longest)])
        scored[row.name, row.group] = Scored(row, weights, np.array(means), np.array(shifts))
    return scored


def _mean(values: _Array) -> Sequence[float]:
    return list(values.mean(0)) if len(values) else [float("nan")] * values.shape[1]

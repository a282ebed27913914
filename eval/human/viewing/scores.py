"""Fits and scores all rows; scores are averaged over fixations, then over pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from eval.human.viewing.density import DensityWeights
from eval.human.viewing.raster import Habits
from eval.human.viewing.rows import Half, Row, fit_row, rows_of, score_row
from eval.human.viewing.run import ViewingRun
from semfov.errors import check
from semfov.metrics.averages import standard_error

_Array = NDArray[np.float64]

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

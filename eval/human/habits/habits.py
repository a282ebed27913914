"""Fit the terms of gaze habits on half of the people and pictures, and evaluate them on the other half."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from eval.human.habits.gaze_habits import GazeHabits, age_bins, standardised, step_bins
from eval.human.habits.log_linear import fit_log_linear, log_probability
from eval.human.habits.viewings import Choices
from semfov.belief.grid import Grid
from semfov.errors import DataError
from semfov.metrics.averages import standard_error

EDGES = (0.05, 0.11, 0.16, 0.22, 0.3, 0.4, 0.55)
"""Borders of the bins of saccade length, in units of the image's longer side. The first bin is the cell itself."""
AGES = (1.0, 2.0, 3.0, 6.0)
"""Upper limits of the age bins of inhibition of return, in fixations. The last bin has no limit."""

_Term = Literal["policy", "centre", "steps", "return"]
_ORDER: tuple[_Term, ...] = ("policy", "centre", "steps", "return")
"""Terms in the order in which they are added."""


@dataclass(frozen=True)
class Halves:
    """The choices to fit on, and the choices of other people in other pictures.

    Shapes: place `(X·Y)`.
    """

    fitted: Choices
    held_out: Choices
    place: Tensor
    grid: Grid

    @classmethod
    def of(cls, choices: Choices, grid: Grid, smoothing: float) -> Halves:
        """Split choices into people with odd numbers in every other picture, and the other people in the other ones."""
        other = choices.subject % 2 == 0
        between = choices.picture % 2 == 1
        fitted, held_out = choices[~other & ~between], choices[other & between]
        if not len(fitted) or not len(held_out):
            raise DataError(
                "fixations: expected at least two people and two pictures, as one half is fitted and the other half "
                f"held out; got {len(fitted)} fixations to fit and {len(held_out)} to hold out"
            )
        counts = torch.bincount(fitted.next_cell, minlength=len(grid)).double() + smoothing
        return cls(fitted, held_out, (counts / counts.sum()).log(), grid)

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of choices, people and pictures in both halves."""
        return {
            f"{half}_{what}": size
            for half, some in (("fitted", self.fitted), ("held_out", self.held_out))
            for what, size in (
                ("choices", len(some)),
                ("people", len(some.subject.unique())),
                ("pictures", len(some.picture.unique())),
            )
        }


@dataclass(frozen=True)
class FittedTerms:
    """Some terms of the model, fitted together.

    Shapes: weights `(F,)`.
    """

    policy: str | None
    terms: tuple[_Term, ...]
    weights: Tensor
    fitted: float
    even: float
    gain: float
    error: float

    def figures(self) -> dict[str, Any]:
        """Return the attributes as JSON values."""
        return {**vars(self), "terms": list(self.terms), "weights": self.weights.tolist()}


def fit_terms(halves: Halves, policy: str | None, ridge: float) -> list[FittedTerms]:
    """Add the terms one after another, the values of a policy first, and fit all of them again each time."""
    order = _ORDER if policy is not None else _ORDER[1:]
    base = _bits(halves, None, ("centre",), _fit(halves, None, ("centre",), ridge))[1]
    fits = []
    for number in range(1, len(order) + 1):
        terms = order[:number]
        weights = _fit(halves, policy, terms, ridge)
        fitted, held_out = _bits(halves, policy, terms, weights)
        over = _mean_by_picture(held_out - base, halves.held_out.picture)
        error = float(standard_error(over.numpy()))
        even = float(_mean_by_picture(held_out, halves.held_out.picture).mean())
        mean = float(_mean_by_picture(fitted, halves.fitted.picture).mean())
        fits.append(FittedTerms(policy, terms, weights, mean, even, float(over.mean()), error))
    return fits


def _features_of(choices: Choices, halves: Halves, policy: str | None, terms: tuple[_Term, ...]) -> Tensor:
    """Compute the features of every cell for every choice."""
    shape = len(choices), len(halves.grid)
    columns = []
    for term in terms:
        if term == "policy":
            assert policy is not None
            columns.append(standardised(choices.values[policy])[..., None])
        elif term == "centre":
            columns.append(halves.place.float().expand(shape)[..., None])
        elif term == "steps":
            bins = step_bins(halves.grid, choices.cell, torch.tensor(EDGES))
            columns.append(torch.nn.functional.one_hot(bins, len(EDGES) + 1).float())
        else:
            bins = age_bins(choices.age, torch.tensor(AGES))
            columns.append(torch.nn.functional.one_hot(bins + 1, len(AGES) + 2)[..., 1:].float())
    return torch.cat(columns, -1)


def habits_of(model: FittedTerms, halves: Halves) -> GazeHabits:
    """Convert a fitted model with all terms into a `GazeHabits`, which draws fixations."""
    assert model.terms == _ORDER
    pull, centre, *rest = model.weights.tolist()
    step, back = torch.tensor(rest[: len(EDGES) + 1]), torch.tensor(rest[len(EDGES) + 1 :])
    place = (centre * halves.place).float()
    return GazeHabits(pull, place - place.mean(), step, EDGES, back, AGES, halves.grid.columns)


def _mean_by_picture(values: Tensor, picture: Tensor) -> Tensor:
    """Compute the mean of the values of each picture."""
    _, number = picture.unique(return_inverse=True)
    count = torch.bincount(number)
    return torch.zeros(len(count), dtype=values.dtype).index_add(0, number, values) / count


def _fit(halves: Halves, policy: str | None, terms: tuple[_Term, ...], ridge: float) -> Tensor:
    return fit_log_linear(_features_of(halves.fitted, halves, policy, terms), halves.fitted.next_cell, ridge=ridge)


def _bits(halves: Halves, policy: str | None, terms: tuple[_Term, ...], weights: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the information gain of every choice over a uniform one, in bits, for both halves."""
    bits = []
    for choices in (halves.fitted, halves.held_out):
        log = log_probability(_features_of(choices, halves, policy, terms), choices.next_cell, weights)
        bits.append((log + math.log(len(halves.grid))) / math.log(2))
    return bits[0], bits[1]

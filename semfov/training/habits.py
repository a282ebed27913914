"""The terms of gaze habits, fitted one after another on half of the people and pictures, and judged on the others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import DataError
from semfov.gaze.habits import GazeHabits, age_bins, standardised, step_bins
from semfov.gaze.log_linear import fit_log_linear, log_probability
from semfov.metrics.averages import standard_error
from semfov.training.viewings import Choices

EDGES = (0.05, 0.11, 0.16, 0.22, 0.3, 0.4, 0.55)
"""Borders of the bins of saccade length, in longer sides of the image; the first bin holds the cell itself."""
AGES = (1.0, 2.0, 3.0, 6.0)
"""Last ages of the bins of inhibition of return but the last, in fixations."""

Term = Literal["policy", "centre", "steps", "return"]
ORDER: tuple[Term, ...] = ("policy", "centre", "steps", "return")
"""Terms in the order in which they are added."""


@dataclass(frozen=True)
class Halves:
    """Choices to fit on, and those of other people in other pictures.

    Attributes:
        fitted: to fit on.
        held_out: to judge by.
        place: `(X·Y)`, log of how often people of the fitted half fixated each cell.
        grid: the cells; distances are in longer sides, so one size of picture stands for all of its shape.
        sizes: choices, people and pictures of both, for metadata.
    """

    fitted: Choices
    held_out: Choices
    place: Tensor
    grid: Grid

    @classmethod
    def of(cls, choices: Choices, grid: Grid, smoothing: float) -> Halves:
        """People of odd numbers on every other picture, and people of even numbers on the pictures between.

        Args:
            choices: all of them.
            grid: the cells.
            smoothing: fixations that every cell is given before they are counted.

        Raises:
            DataError: there are too few people or pictures for two halves.
        """
        other = choices.subject % 2 == 0
        between = choices.picture % 2 == 1
        fitted, held_out = choices[~other & ~between], choices[other & between]
        if not len(fitted) or not len(held_out):
            raise DataError("fixations: too few to fit and to judge by; expected two people and two pictures at least")
        counts = torch.bincount(fitted.taken, minlength=len(grid)).double() + smoothing
        return cls(fitted, held_out, (counts / counts.sum()).log(), grid)

    @property
    def sizes(self) -> dict[str, int]:
        """How much there is to fit on and to judge by."""
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
class Fitted:
    """Some terms, fitted together.

    Attributes:
        policy: whose values are in; None for none.
        terms: that are in.
        weights: `(F,)`.
        fitted: bits that a fixation of the fitted half gains over one that is even over the cells.
        even: the same of the held-out half.
        gain: bits over the centre bias alone, of the held-out half, mean over pictures.
        error: its standard error over pictures.
    """

    policy: str | None
    terms: tuple[Term, ...]
    weights: Tensor
    fitted: float
    even: float
    gain: float
    error: float

    def figures(self) -> dict[str, Any]:
        """As JSON values."""
        return {**vars(self), "terms": list(self.terms), "weights": self.weights.tolist()}


def fit_terms(halves: Halves, policy: str | None, ridge: float) -> list[Fitted]:
    """The terms added one after another, fitted anew each time.

    Args:
        halves: choices to fit on and to judge by.
        policy: whose values the first term is; None leaves it out.
        ridge: see `fit_log_linear`.
    """
    order = ORDER if policy is not None else ORDER[1:]
    base = _bits(halves, None, ("centre",), _fit(halves, None, ("centre",), ridge))[1]
    found = []
    for number in range(1, len(order) + 1):
        terms = order[:number]
        weights = _fit(halves, policy, terms, ridge)
        fitted, held_out = _bits(halves, policy, terms, weights)
        over = mean_by_picture(held_out - base, halves.held_out.picture)
        error = float(standard_error(over.numpy()))
        even = float(mean_by_picture(held_out, halves.held_out.picture).mean())
        mean = float(mean_by_picture(fitted, halves.fitted.picture).mean())
        found.append(Fitted(policy, terms, weights, mean, even, float(over.mean()), error))
    return found


def features_of(choices: Choices, halves: Halves, policy: str | None, terms: tuple[Term, ...]) -> Tensor:
    """Features of every cell for every choice, `(n, X·Y, F)`: one for policy and centre each, one for each bin."""
    shape = len(choices), len(halves.grid)
    parts = []
    for term in terms:
        if term == "policy":
            assert policy is not None
            parts.append(standardised(choices.values[policy])[..., None])
        elif term == "centre":
            parts.append(halves.place.float().expand(shape)[..., None])
        elif term == "steps":
            bins = step_bins(halves.grid, choices.cell, torch.tensor(EDGES))
            parts.append(torch.nn.functional.one_hot(bins, len(EDGES) + 1).float())
        else:
            bins = age_bins(choices.age, torch.tensor(AGES))
            parts.append(torch.nn.functional.one_hot(bins + 1, len(AGES) + 2)[..., 1:].float())
    return torch.cat(parts, -1)


def habits_of(model: Fitted, halves: Halves) -> GazeHabits:
    """The model with all of its terms, as what draws fixations."""
    assert model.terms == ORDER
    pull, centre, *rest = model.weights.tolist()
    step, back = torch.tensor(rest[: len(EDGES) + 1]), torch.tensor(rest[len(EDGES) + 1 :])
    place = (centre * halves.place).float()
    return GazeHabits(pull, place - place.mean(), step, EDGES, back, AGES, halves.grid.columns)


def mean_by_picture(values: Tensor, picture: Tensor) -> Tensor:
    """Mean of the values of each picture."""
    _, number = picture.unique(return_inverse=True)
    count = torch.bincount(number)
    return torch.zeros(len(count), dtype=values.dtype).index_add(0, number, values) / count


def _fit(halves: Halves, policy: str | None, terms: tuple[Term, ...], ridge: float) -> Tensor:
    return fit_log_linear(features_of(halves.fitted, halves, policy, terms), halves.fitted.taken, ridge=ridge)


def _bits(halves: Halves, policy: str | None, terms: tuple[Term, ...], weights: Tensor) -> tuple[Tensor, Tensor]:
    """Bits of every choice over an even one, of both halves."""
    told = []
    for choices in (halves.fitted, halves.held_out):
        log = log_probability(features_of(choices, halves, policy, terms), choices.taken, weights)
        told.append((log + math.log(len(halves.grid))) / math.log(2))
    return told[0], told[1]

"""Measures of searches, of deciding whether a target is present, and of explorations; standard errors of means."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.scene import Annotation
from semfov.errors import check, check_whole
from semfov.metrics.labels import as_numbers, as_outcomes

_MOST_SHIFTS = 1_000_000

FloatArray = NDArray[np.float64]


def cumulative_performance(found_at: NDArray[np.int64], shifts: int) -> FloatArray:
    """Compute the fraction of searches that have found their target after each gaze shift.

    Args:
        found_at: `(..., episodes)`, gaze shift at which each search found its target; -1 where it did not.
        shifts: last gaze shift.

    Returns:
        `(..., shifts + 1)`, after 0, 1, … gaze shifts; NaN without episodes.

    Raises:
        InputError: `shifts` is no whole number of 0 or more, or there are no numbers of searches.
    """
    check_whole(shifts, "shifts", 0, _MOST_SHIFTS)
    steps = np.arange(shifts + 1)
    numbers = as_numbers(found_at, "found_at").detach().double().cpu().numpy()
    check(numbers.ndim > 0, "found_at", "a number for each search", numbers)
    shift = numbers[..., None]
    found = (shift >= 0) & (shift <= steps)  # (..., episodes, shifts + 1)
    if not found.shape[-2]:
        return np.full((*found.shape[:-2], len(steps)), np.nan)
    return np.asarray(found.mean(-2), dtype=np.float64)


def scores_by_presence(score: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Divide scores into two groups: cases with the target, and cases without.

    Args:
        score: `(M,)`.
        present: `(M,)`, whether the target is there.

    Returns:
        Both, at least one of each.

    Raises:
        InputError: the shapes differ, or one of the two is missing.
    """
    scores = as_numbers(score, "score")
    is_present = as_outcomes(present, "present").to(scores.device)
    expected = f"one outcome for each score {(*scores.shape,)}"
    check(is_present.shape == scores.shape, "present", expected, (*is_present.shape,))
    has_both = bool(is_present.any() and not is_present.all())
    check(has_both, "present", "both true and false values", "only one of the two")
    return scores[is_present].double(), scores[~is_present].double()


def area_under_roc(score: Tensor, present: Tensor) -> float:
    """Compute the area under the ROC (Hanley and McNeil, 1982), P(s₊ > s₋) + P(s₊ = s₋) / 2.

    Args:
        score: `(M,)`, s.
        present: `(M,)`, whether the target is there.

    Returns:
        The area, from 0 to 1.

    Raises:
        InputError: the shapes differ, or cases with or without the target are missing.
    """
    positive, negative = scores_by_presence(score, present)
    negative = negative.sort().values
    # For each s₊ the number of s₋ below it, and of those up to it: one that equals it counts for one half.
    below = torch.searchsorted(negative, positive)
    up_to = torch.searchsorted(negative, positive, right=True)
    return float((below + up_to).double().mean() / (2 * len(negative)))


def answers_of(annotation: Annotation, grid: Grid, components: int) -> Tensor:
    """Find the classes that are correct for each cell: those of the objects whose boxes overlap it.

    Args:
        annotation: the objects.
        grid: the cells.
        components: number of classes with background, K+1.

    Returns:
        `(X·Y, K+1)` boolean.
    """
    overlap = grid.footprint(annotation.boxes)  # (M, X·Y)
    classes = F.one_hot(annotation.labels, components)  # (M, K+1)
    objects_of_class = overlap.T.float() @ classes.float()
    return objects_of_class > 0


def right_cells(beta: Tensor, answers: Tensor) -> Tensor:
    """Find the cells whose most probable class, a single one, is right.

    Args:
        beta: `(B, X·Y, C)`, the belief.
        answers: `(X·Y, C)`, correct classes (`answers_of`).

    Returns:
        `(B, X·Y)` boolean.
    """
    best = beta == beta.amax(-1, keepdim=True)  # (B, X·Y, C)
    right = best & as_outcomes(answers, "answers")
    # Sums of a short dimension take a seventh of the time of `any`.
    is_single = best.sum(-1) == 1
    return (right.sum(-1) > 0) & is_single


def standard_error(values: FloatArray) -> FloatArray:
    """Compute the standard error of the mean along the first axis, the root of Σ (x - x̄)² / (n (n - 1)).

    Args:
        values: `(n, ...)`.

    Returns:
        `(...)`; NaN for fewer than two values.
    """
    values = np.asarray(values, dtype=np.float64)
    check(values.ndim > 0, "values", "several values", values)
    if len(values) < 2:
        return np.full(values.shape[1:], np.nan)
    deviation = values.std(0, ddof=1)
    return np.asarray(deviation / np.sqrt(len(values)))

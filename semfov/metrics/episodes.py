"""Measures of searches, of deciding whether a target is present, and of explorations; standard errors of means."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.scene import Annotation
from semfov.errors import check
from semfov.metrics.labels import as_numbers, as_outcomes

FloatArray = NDArray[np.float64]


def cumulative_performance(found_at: NDArray[np.int64], shifts: int) -> FloatArray:
    """Fraction of searches, `(..., episodes)`, that have found their target after 0..`shifts` gaze shifts."""
    steps = np.arange(shifts + 1)
    when = np.asarray(found_at)[..., None]
    found = (when >= 0) & (when <= steps)
    return np.asarray(found.mean(-2), dtype=np.float64)


def scores_by_presence(score: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Scores of the cases with the target, and of those without; there is at least one of each."""
    scores = as_numbers(score, "score")
    there = as_outcomes(present, "present").to(scores.device)
    check(there.shape == scores.shape, "present", f"one outcome for each score {(*scores.shape,)}", (*there.shape,))
    check(bool(there.any() and not there.all()), "present", "both true and false values", "only one of the two")
    return scores[there].double(), scores[~there].double()


def area_under_roc(score: Tensor, present: Tensor) -> float:
    """Area under the ROC (Hanley and McNeil, 1982), P(s₊ > s₋) + P(s₊ = s₋) / 2; score and present `(M,)`."""
    hit, miss = scores_by_presence(score, present)
    miss = miss.sort().values
    below = torch.searchsorted(miss, hit) + torch.searchsorted(miss, hit, right=True)
    return float(below.double().mean() / (2 * len(miss)))


def answers_of(annotation: Annotation, grid: Grid, components: int) -> Tensor:
    """The classes that are correct for each cell: those of the objects whose boxes overlap it; → `(X·Y, K+1)`."""
    overlap = grid.footprint(annotation.boxes)
    classes = F.one_hot(annotation.labels, components)
    return overlap.T.float() @ classes.float() > 0


def right_cells(beta: Tensor, answers: Tensor) -> Tensor:
    """Cells `(B, X·Y)` whose most probable class is one of the answers; beta `(B, X·Y, C)`, answers `(X·Y, C)`."""
    best = beta == beta.amax(-1, keepdim=True)
    # Sums of a short dimension take a seventh of the time of `any`.
    return ((best & as_outcomes(answers, "answers")).sum(-1) > 0) & (best.sum(-1) == 1)


def standard_error(values: FloatArray) -> FloatArray:
    """Standard error of the mean along the first axis, the root of Σ (x - x̄)² / (n (n - 1))."""
    values = np.asarray(values, dtype=np.float64)
    if len(values) < 2:
        return np.full(values.shape[1:], np.nan)
    return np.asarray(values.std(0, ddof=1) / np.sqrt(len(values)))

"""How soon searches find their target, and how straight they go there."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.errors import check
from semfov.metrics.search import cumulative_performance

Array = NDArray[np.float64]


def found_at(points: ArrayLike, box: ArrayLike) -> int:
    """Gaze shift after which the gaze is first on the target, 0 for the first fixation; -1 where it never is.

    Args:
        points: `(n, 2)`, fixations in order.
        box: `(x1, y1, x2, y2)`, of the target, in the same frame; its edges belong to it.

    >>> found_at([[0, 0], [5, 5], [6, 6]], [4, 4, 8, 8])
    1
    """
    x, y = _points(points).T
    x1, y1, x2, y2 = np.asarray(box)
    on = (x1 <= x) & (x <= x2) & (y1 <= y) & (y <= y2)
    return int(on.argmax()) if on.any() else -1


def mean_performance(found: Sequence[int], groups: Sequence[Hashable], shifts: int) -> Array:
    r"""Share of searches that have found their target after 0, 1, … gaze shifts, averaged over groups of searches.

    .. math:: P(n) = \frac1{|G|} \sum_{g \in G} \frac{|\{i \in g : 0 \le f_i \le n\}|}{|g|}

    Ruarte et al. (2025) average over people, each person's searches first; Yang et al. (2020) over target categories.

    Args:
        found: gaze shift at which each search found its target, -1 where it did not.
        groups: of each search: its person, or its target's category.
        shifts: last gaze shift.

    Returns:
        `(shifts+1,)`.

    >>> mean_performance([1, -1, 0], ["ann", "ann", "bob"], 1)
    array([0.5 , 0.75])
    """
    check(len(found) == len(groups) > 0, "groups", f"one for each of {len(found)} searches, at least one", len(groups))
    members: dict[Hashable, list[int]] = {}
    for each, group in zip(found, groups, strict=True):
        members.setdefault(group, []).append(each)
    curves = [cumulative_performance(np.array(each), shifts) for each in members.values()]
    return np.asarray(np.mean(curves, axis=0))


def performance_area(curve: ArrayLike) -> float:
    r"""Area under a curve of cumulative performance by the trapezoidal rule, its fixations spread over [0, 1].

    .. math:: A = \frac1{N-1} \left( \tfrac12 P_1 + P_2 + \dots + P_{N-1} + \tfrac12 P_N \right)

    "AUCperf" of Ruarte et al. (2025), who take N = 10 fixations on COCO-Search18, the first among them.

    Args:
        curve: `(N,)`, share found by the 1st, 2nd, … fixation.

    >>> performance_area([0.0, 0.5, 1.0])
    0.5
    """
    values = np.asarray(curve, dtype=np.float64)
    check(values.ndim == 1 and len(values) >= 2, "curve", "at least two values in a row", values.shape)
    return float(np.trapezoid(values, np.linspace(0, 1, len(values))))


def tfp_auc(found: Sequence[int], categories: Sequence[Hashable], shifts: int = 6) -> float:
    r"""Area under the target fixation probability: a plain sum over fixations of the mean over target categories.

    .. math:: \sum_{n=0}^{N} P(n), \quad P \text{ averaged over categories}

    TFP-AUC of Yang et al. (2020): six gaze shifts, so that seven fixations are summed and 7 is the largest value.

    Args:
        found: gaze shift at which each search found its target, -1 where it did not.
        categories: of the targets.
        shifts: last gaze shift.

    >>> tfp_auc([1, -1], ["cup", "fork"], shifts=2)
    1.0
    """
    return float(mean_performance(found, categories, shifts).sum())


def probability_mismatch(curve: ArrayLike, reference: ArrayLike) -> float:
    r"""How far a curve of target fixation probability is from people's (Yang et al., 2020).

    .. math:: \sum_n | P(n) - P_{\text{people}}(n) |

    Args:
        curve: `(N,)`, share found by the 1st, 2nd, … fixation.
        reference: `(N,)`, that of people.

    >>> probability_mismatch([0.0, 0.5, 0.5], [0.0, 0.25, 1.0])
    0.75
    """
    ours, theirs = np.asarray(curve, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    check(ours.shape == theirs.shape, "reference", f"a curve of {ours.shape}", theirs.shape)
    return float(np.abs(ours - theirs).sum())


def scanpath_ratio(points: ArrayLike, box: ArrayLike) -> float:
    r"""Straight way to the target over the way that the gaze went (Yang et al., 2020), at most 1.

    .. math:: \min\left(1, \frac{\|c - p_0\|}{\sum_{i=1}^{m} \|p_i - p_{i-1}\|}\right)

    c is the centre of the target and m the first fixation on it. NaN where the target was never fixated, or at once.

    Args:
        points: `(n, 2)`, fixations in order.
        box: `(x1, y1, x2, y2)`, of the target.

    >>> scanpath_ratio([[0, 0], [0, 6], [8, 6]], [7, 5, 9, 7])
    0.7142857142857143
    """
    path, edges = _points(points), np.asarray(box, dtype=np.float64)
    last = found_at(path, edges)
    if last < 1:
        return float("nan")
    way = np.linalg.norm(np.diff(path[: last + 1], axis=0), axis=1).sum()
    straight = np.linalg.norm((edges[:2] + edges[2:]) / 2 - path[0])
    return float(min(straight / way, 1.0))


def _points(points: ArrayLike) -> Array:
    array = np.asarray(points, dtype=np.float64)
    check(array.ndim == 2 and array.shape[1] == 2 and len(array) > 0, "points", "(n, 2), at least one", array.shape)
    return array

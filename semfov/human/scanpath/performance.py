"""How soon searches find their target, and how direct their scanpaths are."""

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.data.fixations.record import as_array, as_path
from semfov.errors import check
from semfov.metrics.episodes import cumulative_performance
from semfov.metrics.labels import as_labels, as_numbers

_Array = NDArray[np.float64]


def found_at(points: ArrayLike, box: ArrayLike) -> int:
    """Find the gaze shift after which the gaze is on the target for the first time.

    Args:
        points: `(n, 2)`, fixations in order.
        box: `(x1, y1, x2, y2)` of the target, in the same frame; its edges belong to it.

    Returns:
        0 for the first fixation, and so on; -1 where the target is never fixated.

    Raises:
        InputError: `points` is not of shape `(n, 2)`, or is empty.

    >>> found_at([[0, 0], [5, 5], [6, 6]], [4, 4, 8, 8])
    1
    """
    x, y = as_path(points, "points", least=1).T
    x1, y1, x2, y2 = _corners(box)
    on_target = (x1 <= x) & (x <= x2) & (y1 <= y) & (y <= y2)  # (n,)
    return int(on_target.argmax()) if on_target.any() else -1


def mean_performance(found: Sequence[int], groups: Sequence[Hashable], shifts: int) -> _Array:
    r"""Compute the fraction of searches that have found their target after each gaze shift, averaged over groups.

    .. math:: P(n) = \frac1{|G|} \sum_{g \in G} \frac{|\{i \in g : 0 \le f_i \le n\}|}{|g|}

    In Ruarte et al. (2025) a group is a person, in Yang et al. (2020) a target category.

    Args:
        found: gaze shift at which each search found its target, -1 where it did not.
        groups: group of each search, such as its person or its target's category.
        shifts: last gaze shift.

    Returns:
        `(shifts+1,)`, for 0, 1, … gaze shifts.

    Raises:
        InputError: there is no search, or `groups` has another length than `found`.

    >>> mean_performance([1, -1, 0], ["ann", "ann", "bob"], 1)
    array([0.5 , 0.75])
    """
    numbers = as_numbers(found, "found")
    are_shifts = bool(((numbers == numbers.floor()) & (numbers >= -1)).all())
    check(are_shifts, "found", "numbers of gaze shifts, and -1 where the target was not found", numbers.tolist()[:5])
    shifts_found = numbers.tolist()
    names = as_labels(groups, "groups")
    expected = f"one for each of {len(shifts_found)} searches, at least one"
    check(len(shifts_found) == len(names) > 0, "groups", expected, len(names))
    by_group: dict[Hashable, list[float]] = {}
    for shift, group in zip(shifts_found, names, strict=True):
        by_group.setdefault(group, []).append(shift)
    # Groups count the same, however many searches they have.
    curves = [cumulative_performance(np.array(searches), shifts) for searches in by_group.values()]
    return np.asarray(np.mean(curves, axis=0))


def performance_area(curve: ArrayLike) -> float:
    r"""Compute the area under a curve of cumulative performance, with its fixations spread over [0, 1].

    The trapezoidal rule:

    .. math:: A = \frac1{N-1} \left( \tfrac12 P_1 + P_2 + \dots + P_{N-1} + \tfrac12 P_N \right)

    This is "AUCperf" of Ruarte et al. (2025), who take N = 10 fixations on COCO-Search18, the first one included.

    Args:
        curve: `(N,)`, fraction found by the 1st, 2nd, … fixation.

    Returns:
        The area, from 0 to 1.

    Raises:
        InputError: the curve has fewer than two values.

    >>> performance_area([0.0, 0.5, 1.0])
    0.5
    """
    values = as_array(curve, "curve", finite=True)
    check(values.ndim == 1 and len(values) >= 2, "curve", "an array of shape (N,) with N of 2 or more", values.shape)
    return float(np.trapezoid(values, np.linspace(0, 1, len(values))))


def tfp_auc(found: Sequence[int], categories: Sequence[Hashable], shifts: int = 6) -> float:
    r"""Compute the area under the target fixation probability: a sum over fixations of the mean over categories.

    .. math:: \sum_{n=0}^{N} P(n), \quad P \text{ averaged over categories}

    TFP-AUC of Yang et al. (2020), with six gaze shifts: seven fixations are summed, and 7 is the largest value.

    Args:
        found: gaze shift at which each search found its target, -1 where it did not.
        categories: category of each search's target.
        shifts: last gaze shift, N.

    Returns:
        The area, from 0 to N + 1.

    Raises:
        InputError: there is no search, or `categories` has another length than `found`.

    >>> tfp_auc([1, -1], ["cup", "fork"], shifts=2)
    1.0
    """
    return float(mean_performance(found, categories, shifts).sum())


def probability_mismatch(curve: ArrayLike, reference: ArrayLike) -> float:
    r"""Compute the distance between a curve of target fixation probability and that of people (Yang et al., 2020).

    .. math:: \sum_n | P(n) - P_{\text{people}}(n) |

    Args:
        curve: `(N,)`, fraction found by the 1st, 2nd, … fixation.
        reference: `(N,)`, the same curve of people.

    Returns:
        The distance, from 0 to N.

    Raises:
        InputError: the curves differ in length.

    >>> probability_mismatch([0.0, 0.5, 0.5], [0.0, 0.25, 1.0])
    0.75
    """
    ours = as_array(curve, "curve", finite=True)
    theirs = as_array(reference, "reference", finite=True)
    check(ours.shape == theirs.shape, "reference", f"a curve of shape {ours.shape}, as `curve`", theirs.shape)
    return float(np.abs(ours - theirs).sum())


def scanpath_ratio(points: ArrayLike, box: ArrayLike) -> float:
    r"""Compute the scanpath ratio (Yang et al., 2020): direct distance to the target over the length of the scanpath.

    .. math:: \min\left(1, \frac{\|c - p_0\|}{\sum_{i=1}^{m} \|p_i - p_{i-1}\|}\right)

    c is the centre of the target, and m the first fixation on it.

    Args:
        points: `(n, 2)`, fixations in order.
        box: `(x1, y1, x2, y2)` of the target, in the same frame.

    Returns:
        The ratio, from 0 to 1; NaN where the target was never fixated, or by the first fixation already.

    Raises:
        InputError: `points` is not of shape `(n, 2)`, or is empty.

    >>> scanpath_ratio([[0, 0], [0, 6], [8, 6]], [7, 5, 9, 7])
    0.7142857142857143
    """
    path = as_path(points, "points", least=1)
    edges = _corners(box)
    last = found_at(path, edges)
    # Before a saccade there is no length to compare with.
    if last < 1:
        return float("nan")
    length = np.linalg.norm(np.diff(path[: last + 1], axis=0), axis=1).sum()
    direct = np.linalg.norm((edges[:2] + edges[2:]) / 2 - path[0])
    return float(min(direct / length, 1.0))


def _corners(box: ArrayLike) -> _Array:
    """Take a box as an array `(4,)`, and check it."""
    corners = as_array(box, "box")
    check(corners.shape == (4,), "box", "(x1, y1, x2, y2)", f"shape {corners.shape}")
    check(bool((corners[:2] <= corners[2:]).all()), "box", "x1 <= x2 and y1 <= y2", corners.tolist())
    return corners

"""Alignments of scanpaths against brute force over all alignments."""

from functools import cache

import numpy as np
import pytest

from semfov.metrics.scanpath import dynamic_time_warping, scanmatch, time_delay_embedding
from tests.refusals import refused

RNG = np.random.default_rng(0)
SIZE = (80, 60)


def path(count):
    return RNG.uniform(0, (79, 59), (count, 2))


def all_pairings(n, m):
    """All sets of pairs (i, j) that ascend in both, as tuples."""
    if not (n and m):
        return [()]
    without = all_pairings(n - 1, m)
    with_last = [(*rest, (n - 1, j)) for j in range(m) for rest in all_pairings(n - 1, j)]
    return without + with_last


@pytest.mark.parametrize(("n", "m", "gap", "threshold"), [(3, 4, 0.0, 3.5), (4, 2, -0.5, 2.0), (1, 4, -1.0, 9.0)])
def test_scanmatch_is_the_best_of_all_alignments(n, m, gap, threshold):
    ours, theirs = path(n), path(m)
    cell = lambda point: np.floor((point + 0.5) / SIZE * (12, 8))  # noqa: E731
    score = lambda i, j: threshold - np.linalg.norm(cell(ours[i]) - cell(theirs[j]))  # noqa: E731
    best = max(sum(score(i, j) for i, j in pairs) + gap * (n + m - 2 * len(pairs)) for pairs in all_pairings(n, m))
    got = scanmatch(ours, theirs, SIZE, threshold=threshold, gap=gap)
    assert got == pytest.approx(best / (threshold * max(n, m)))


def test_durations_repeat_letters():
    ours, theirs = path(2), path(3)
    longer = scanmatch(ours.repeat([3, 1], axis=0), theirs, SIZE)
    times = ([150.0, 20.0], [50.0, 60.0, 40.0])
    assert scanmatch(ours, theirs, SIZE, durations=times) == pytest.approx(longer)
    assert scanmatch(ours, ours, SIZE, durations=(times[0], times[0])) == 1
    refused("durations", scanmatch, ours, theirs, SIZE, durations=([1.0], [1.0]))


def test_the_substitution_matrix_of_the_toolbox_has_the_published_range():
    """ScanMatch's default of 12 × 8 cells and 3.5: equal letters add 3.5, opposite corners 3.5 - √(11² + 7²)."""
    corners = [[0.0, 0.0]], [[79.0, 59.0]]
    assert scanmatch(*corners, SIZE, gap=-1e5) * 3.5 == pytest.approx(3.5 - np.hypot(11, 7))


@pytest.mark.parametrize(("n", "m"), [(1, 3), (3, 3), (4, 5)])
def test_time_warping_is_the_cheapest_of_all_alignments(n, m):
    ours, theirs = path(n), path(m)

    @cache
    def cheapest(i, j):
        before = [cheapest(i - a, j - b) for a, b in ((1, 0), (0, 1), (1, 1)) if i >= a and j >= b]
        return float(np.linalg.norm(ours[i] - theirs[j])) + (min(before) if before else 0.0)

    assert dynamic_time_warping(ours, theirs) == pytest.approx(cheapest(n - 1, m - 1))


@pytest.mark.parametrize("length", [1, 2, 3])
def test_time_delay_embedding_by_loops(length):
    ours, theirs = path(5), path(4)
    nearest = [
        min(
            np.sqrt(sum(np.sum((ours[i + k] - theirs[j + k]) ** 2) for k in range(length))) / length
            for j in range(len(theirs) - length + 1)
        )
        for i in range(len(ours) - length + 1)
    ]
    assert time_delay_embedding(ours, theirs, length=length) == pytest.approx(np.mean(nearest))


def test_short_and_wrong_scanpaths_durations_and_cells():
    for wrong in [{"durations": ([np.nan], [1.0])}, {"durations": ([1e12], [1.0])}, {"cells": (0, 1)}]:
        refused(f"^{next(iter(wrong))}: expected", scanmatch, [[1.0, 1.0]], [[1.0, 1.0]], SIZE, **wrong)
    assert np.isnan(time_delay_embedding(path(2), path(5)))
    for measure in (dynamic_time_warping, time_delay_embedding):
        for bad in (np.zeros((0, 2)), np.zeros((3, 3)), [[np.nan, 0.0]]):
            for pair in ((bad, path(3)), (path(3), bad)):
                refused(r"ours|theirs", measure, *pair)

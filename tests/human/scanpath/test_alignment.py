"""Comparisons of scanpaths: alignments, MultiMatch, saccades and sequences of labels, against independent programs."""

import math
import warnings
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import wasserstein_distance
from sklearn.cluster import MeanShift

from semfov.errors import InputError
from semfov.human.scanpath.sequence import fitted_clusters
from semfov.metrics.scanpath import (
    cell_labels,
    cluster_labels,
    direction_distance,
    dynamic_time_warping,
    edit_distance,
    length_distance,
    merge_close,
    multimatch,
    saccades,
    scanmatch,
    sequence_score,
    time_delay_embedding,
)
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


def test_durations_repeat_letters_whose_substitution_has_the_published_range():
    ours, theirs = path(2), path(3)
    longer = scanmatch(ours.repeat([3, 1], axis=0), theirs, SIZE)
    times = ([150.0, 20.0], [50.0, 60.0, 40.0])
    assert scanmatch(ours, theirs, SIZE, durations=times) == pytest.approx(longer)
    assert scanmatch(ours, ours, SIZE, durations=(times[0], times[0])) == 1
    refused("durations", scanmatch, ours, theirs, SIZE, durations=([1.0], [1.0]))
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


package = pytest.importorskip("multimatch_gaze", reason="pip install multimatch-gaze")


def as_package_array(path, durations):
    rows = [(x, y, t) for (x, y), t in zip(path, durations, strict=True)]
    return np.array(rows, dtype=[("start_x", "<f8"), ("start_y", "<f8"), ("duration", "<f8")])


@pytest.mark.parametrize("seed", range(12))
def test_all_five_similarities_match_the_package(seed):
    generator = np.random.default_rng(seed)
    size = (1680, 1050)
    n, m = generator.integers(3, 12, 2)
    a, b = generator.uniform(0, size, (n, 2)), generator.uniform(0, size, (m, 2))
    s, t = generator.uniform(0.05, 0.9, n), generator.uniform(0.05, 0.9, m)
    ours = multimatch(a, b, size, (s, t))
    np.testing.assert_allclose(
        ours, package.docomparison(as_package_array(a, s), as_package_array(b, t), size), atol=1e-12
    )
    assert ours.mean == pytest.approx(np.mean(ours[:4]))


def test_a_scanpath_matches_itself_and_its_reverse_has_the_opposite_direction():
    path = np.array([[0.0, 0.0], [100.0, 0.0], [200.0, 0.0]])
    same = multimatch(path, path, (400, 300), ([1, 2, 3], [1, 2, 3]))
    assert same == (1, 1, 1, 1, 1)
    back = multimatch(path, path[::-1], (400, 300))
    assert back.direction == pytest.approx(0)
    assert back.length == 1
    assert back.shape == pytest.approx(1 - 200 / 1000)
    assert math.isnan(back.duration)


def test_invalid_and_short_scanpaths_are_refused_by_name():
    assert all(map(math.isnan, multimatch([[0, 0], [1, 1]], [[0, 0], [1, 1], [2, 2]], (10, 10))))
    refused(r"^ours:", multimatch, [0, 1, 2], [[0, 0]] * 3, (10, 10))
    refused(r"^theirs:", multimatch, [[0, 0]] * 3, [0, 1, 2], (10, 10))
    with pytest.raises(
        InputError, match=r"^durations: expected 3 and 4 numbers, one for each fixation, got \(\(3,\), \(2,\)\)"
    ):
        multimatch([[0, 0]] * 3, [[0, 0]] * 4, (10, 10), ([1, 2, 3], [1, 2]))
    refused(r"^points: .*got 2 outside it", cell_labels, [[100, 0], [0, 0], [120, 0]], 2, 2, (100, 100))
    for figure in [sequence_score, edit_distance]:
        refused(r"^ours:", figure, [], [1])
        refused(r"^theirs:", figure, [1], [])
    for wrong in [{"durations": ([np.nan], [1.0])}, {"durations": ([1e12], [1.0])}, {"cells": (0, 1)}]:
        refused(f"^{next(iter(wrong))}: expected", scanmatch, [[1.0, 1.0]], [[1.0, 1.0]], SIZE, **wrong)
    assert np.isnan(time_delay_embedding(path(2), path(5)))
    for measure in (dynamic_time_warping, time_delay_embedding):
        for bad in (np.zeros((0, 2)), np.zeros((3, 3)), [[np.nan, 0.0]]):
            for pair in ((bad, path(3)), (path(3), bad)):
                refused(r"ours|theirs", measure, *pair)


def test_byte_coordinates_do_not_overflow_and_zero_durations_are_equal():
    path = np.array([[200, 10], [100, 250], [250, 20], [5, 5]], dtype=np.uint8)
    other = np.array([[10, 200], [255, 0], [30, 30]], dtype=np.uint8)
    times = np.array([200, 3, 250, 9], dtype=np.uint8), np.array([4, 255, 7], dtype=np.uint8)
    expected = multimatch(path.tolist(), other.tolist(), (256, 256), tuple(each.tolist() for each in times))
    assert multimatch(path, other, (256, 256), times) == expected
    assert multimatch(path, path, (256, 256), ([0] * 4, [0] * 4)).duration == 1


def test_lengths_of_saccades_as_scipy_and_directions_by_the_cheapest_matching():
    """Twin: of as many directions, the best cyclic matching of the sorted ones."""
    a, b = RNG.uniform(-np.pi, np.pi, (2, 9))
    away = lambda x, y: np.abs((x - y + np.pi) % (2 * np.pi) - np.pi)  # noqa: E731
    best = min(away(np.sort(a), np.roll(np.sort(b), shift)).mean() for shift in range(9))
    assert direction_distance(a, b) == pytest.approx(best)
    assert direction_distance(a, a + 2 * np.pi) == pytest.approx(0)
    assert direction_distance([0.0], [np.pi]) == pytest.approx(np.pi)
    assert np.isnan(direction_distance(a, []))
    a, b = RNG.exponential(3, 7), RNG.exponential(5, 11)
    assert length_distance(a, b) == pytest.approx(wasserstein_distance(a, b))
    assert length_distance(a, a) == 0
    assert np.isnan(length_distance([], a))
    lengths, directions = saccades([np.array([[0, 0], [0, 2], [0, 2]]), np.array([[5, 5]]), [[1, 1], [0, 1]]])
    np.testing.assert_allclose(lengths, [2, 1])
    np.testing.assert_allclose(np.abs(directions), [np.pi / 2, np.pi])


sequences = st.lists(st.sampled_from(["cup", "fork", "oven", "tv"]), min_size=1, max_size=9)


def needleman_wunsch(a, b, gap=0.0):
    table = np.zeros((len(a) + 1, len(b) + 1))
    for i in range(len(a)):
        for j in range(len(b)):
            table[i + 1, j + 1] = max(table[i, j] + (a[i] == b[j]), table[i, j + 1] + gap, table[i + 1, j] + gap)
    return table[-1, -1] / max(len(a), len(b))


def levenshtein(a, b):
    if not a or not b:
        return len(a) + len(b)
    return min(
        levenshtein(a[1:], b) + 1, levenshtein(a, b[1:]) + 1, levenshtein(a[1:], b[1:]) + (a[0] != b[0])
    )  # fmt: skip


@given(sequences, sequences)
def test_the_sequence_score_is_an_alignment_without_gap_penalty(a, b):
    assert sequence_score(a, b) == pytest.approx(needleman_wunsch(a, b))
    assert sequence_score(a, b) == pytest.approx(sequence_score(b, a))
    assert sequence_score(a, a) == 1


@given(sequences.map(lambda word: word[:5]), sequences.map(lambda word: word[:5]))
def test_the_edit_distance_is_the_levenshtein_distance(a, b):
    assert edit_distance(a, b) == levenshtein(a, b)


def test_cell_labels_match_the_grid():
    from semfov.belief.grid import Grid

    grid = Grid(5, 4, (101, 77))
    np.testing.assert_array_equal(cell_labels(grid.centres.numpy(), 5, 4, (101, 77)), np.arange(20))
    assert cell_labels([[-0.5, -0.5], [100.5, 76.5]], 5, 4, (101, 77)).tolist() == [0, 19]
    # 1025 can be represented in half precision and 1025.5 cannot.
    assert cell_labels(np.array([[1025, 0]], dtype=np.float16), 4096, 1, (4096, 1)).tolist() == [1025]


def test_consecutive_fixations_closer_than_half_a_window_are_merged():
    path = [[0.0, 0.0], [4.0, 4.0], [5.0, 5.0], [50.0, 50.0]]
    # (0, 0) and (4, 4) merge into (2, 2); the next fixation is 3 away and merges, too.
    np.testing.assert_allclose(merge_close(path, (10, 10)), [[3.5, 3.5], [50, 50]])
    np.testing.assert_allclose(merge_close(path, (1, 1)), path)
    # Both differences have to be small.
    np.testing.assert_allclose(merge_close([[0.0, 0.0], [1.0, 30.0]], (10, 10)), [[0, 0], [1, 30]])
    np.testing.assert_allclose(merge_close([[0.0, 0.0], [50, 50], [52, 50]], (10, 10)), [[0, 0], [51, 50]])
    np.testing.assert_allclose(merge_close([[0.0, 0.0], [2, 0]], (10, 10)), [[1, 0]])
    # Half a window apart is not closer than half a window.
    np.testing.assert_allclose(merge_close([[0.0, 0.0], [5, 0]], (10, 10)), [[0, 0], [5, 0]])
    # Bytes do not wrap around.
    np.testing.assert_allclose(merge_close(np.array([[200, 0], [202, 2]], dtype=np.uint8), (10, 10)), [[201, 1]])


def test_labels_in_an_array_equal_labels_in_a_list():
    """Also -1, whose hash in Python is not -1."""
    assert sequence_score(np.array([3, -1, 300_000]), [3, -1, 300_000]) == 1
    assert edit_distance([3, -1], np.array([3, -1])) == 0


def test_clusters_are_those_of_scikit_learn():
    generator = np.random.default_rng(0)
    places = np.array([[100.0, 100.0], [400.0, 100.0], [250.0, 400.0]])
    truth = np.repeat([0, 1, 2], 20)
    points = places[truth] + generator.normal(0, 10, (60, 2))
    labels = cluster_labels(points, points, bandwidth=60)
    assert len(set(labels.tolist())) == 3
    assert all(len(set(labels[truth == place].tolist())) == 1 for place in range(3))
    assert len(set(cluster_labels(points, points, bandwidth=1000).tolist())) == 1
    points = np.random.default_rng(0).uniform(0, 500, (40, 2))
    expected = MeanShift(bandwidth=90, bin_seeding=True).fit(points).predict(points)
    assert cluster_labels(points, points, bandwidth=90).tolist() == expected.tolist()


def test_only_the_warning_about_bins_is_suppressed(monkeypatch):
    """That warning comes where every fixation has its own bin."""
    points = [[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]]
    assert sorted(cluster_labels(points, points, bandwidth=1).tolist()) == [0, 1, 2]
    monkeypatch.setattr(MeanShift, "fit", lambda self, points: warnings.warn("another", stacklevel=1))
    with pytest.warns(UserWarning, match="another"):
        fitted_clusters(points)


def test_similarities_beyond_the_screen_end_at_0_and_another_unit_is_refused():
    ours, theirs = np.array([[0.0, 0], [300, 0], [0, 0]]), np.array([[2000.0, 0], [0, 0], [2000, 0]])
    same = multimatch(ours, theirs, (400, 300))
    assert (same.shape, same.length, same.position) == (0, 0, 0)
    assert 0 <= same.direction <= 1
    expected = r"size: expected the screen in the unit of the fixations, got fixations over .*, \d+ of its diagonals"
    refused(expected, multimatch, ours, theirs, (1, 1))

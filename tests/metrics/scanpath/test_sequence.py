"""Scanpaths as sequences of labels, against the usual alignments by dynamic programming."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.cluster import MeanShift

from semfov.metrics.scanpath import cell_labels, cluster_labels, edit_distance, merge_close, sequence_score
from semfov.metrics.scanpath.sequence import fitted_clusters
from tests.refusals import refused

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


def test_empty_sequences_and_points_outside_the_picture_are_refused_by_name():
    refused(r"^points: .*got 2 outside it", cell_labels, [[100, 0], [0, 0], [120, 0]], 2, 2, (100, 100))
    for figure in [sequence_score, edit_distance]:
        refused(r"^ours:", figure, [], [1])
        refused(r"^theirs:", figure, [1], [])


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

"""Metrics of searches and explorations against simulation, counts by hand, sklearn and closed forms."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from eval.chance import random_search
from eval.presence import _threshold_for, hits_at
from semfov import Grid
from semfov.data import Annotation
from semfov.errors import InputError
from semfov.metrics.episodes import answers_of, area_under_roc, cumulative_performance, right_cells, standard_error
from tests.refusals import refused


def test_standard_error():
    values = np.array([[1.0, 2.0], [3.0, 2.0], [5.0, 2.0]])
    np.testing.assert_allclose(standard_error(values), [2 / np.sqrt(3), 0])
    assert np.isnan(standard_error(values[:1])).all()
    np.testing.assert_allclose(standard_error(values.T, axis=1), standard_error(values))
    assert standard_error(values[:, :1], axis=1).shape == (3,)
    # For a and b the standard deviation is |a - b| / √2, and the standard error of their mean |a - b| / 2.
    np.testing.assert_allclose(standard_error(np.array([[1.0, 2.0], [4.0, 2.0]])), [1.5, 0])


def test_random_search_equals_simulation():
    generator = np.random.default_rng(0)
    hits = np.array([min(np.flatnonzero(np.isin(generator.permutation(19), range(3)))) + 1 for _ in range(20_000)])
    simulated = [(hits <= n).mean() for n in range(20)]
    np.testing.assert_allclose(random_search(3, 19, cells=20), simulated, atol=0.015)
    assert random_search(3, 25, cells=20)[-1] == 1


def test_curves_by_hand():
    found = np.array([[1, -1, 2], [0, 0, 5]])
    curves = cumulative_performance(found, 3)
    np.testing.assert_allclose(curves, [[0, 1 / 3, 2 / 3, 2 / 3], [2 / 3] * 4])
    # By default there are 100 cells, and the search starts in one of them.
    np.testing.assert_allclose(random_search(1, 2), [0, 1 / 99, 2 / 99])
    np.testing.assert_allclose(random_search(0, 4, cells=5), 0)


def test_a_cell_is_right_if_an_object_of_its_single_most_probable_class_overlaps_it():
    # Section IV-A: the "highest categorical score" must fit an overlapping object, and background has a score, too.
    answers = torch.tensor([[False, True, False]] * 4)
    beta = torch.tensor([[[0.2, 0.7, 0.1], [0.6, 0.3, 0.1], [0.1, 0.3, 0.6], [0.4, 0.35, 0.25]]])
    assert right_cells(beta, answers).sum(-1).tolist() == [1]
    # Without the background column, classes slightly less probable than background are right, too.
    assert right_cells(beta[..., 1:], answers[:, 1:]).sum(-1).tolist() == [3]
    answers = torch.tensor([[False, True], [False, True], [True, True]])
    beta = torch.tensor([[[0.5, 0.5], [0.5, 0.6], [0.6, 0.5]]])
    assert right_cells(beta, answers).sum(-1).tolist() == [2]


def test_answers_are_the_classes_of_overlapping_objects():
    annotation = Annotation(
        torch.tensor([[1.0, 1, 19, 19], [15, 5, 45, 15], [62, 42, 78, 58]]),
        torch.tensor([1, 2, 3]),
        torch.zeros(3, dtype=torch.bool),
        (80, 60),
    )
    answers = answers_of(annotation, Grid(4, 3, (80, 60)), 4)
    found = {cell: set(row.nonzero()[:, 0].tolist()) for cell, row in enumerate(answers) if row.any()}
    assert found == {0: {1, 2}, 1: {2}, 2: {2}, 11: {3}}
    # Also if the picture shows none of the last classes.
    annotation = Annotation(
        torch.tensor([[1.0, 1, 5, 5]]), torch.tensor([1]), torch.zeros(1, dtype=torch.bool), (20, 10)
    )
    answers = answers_of(annotation, Grid(2, 1, (20, 10)), 5)
    assert answers.tolist() == [[False, True, False, False, False], [False] * 5]


# Few values, so that many are tied.
scores = st.lists(st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.9, 1.0]) | st.floats(0, 1), min_size=1, max_size=25)
shares = st.sampled_from([0.0, 0.01, 0.05, 0.25, 0.5, 0.9]) | st.floats(0, 0.99)


def cases(hits, misses, seed=0):
    """Scores of present and absent targets in random order, and which are present."""
    order = torch.randperm(len(hits) + len(misses), generator=torch.Generator().manual_seed(seed))
    values = torch.tensor([*hits, *misses], dtype=torch.float64)
    return values[order], (torch.arange(len(values)) < len(hits))[order]


@given(scores, scores, st.integers(0, 100))
def test_area_equals_the_mann_whitney_statistic(hits, misses, seed):
    statistic = mannwhitneyu(hits, misses, method="asymptotic").statistic if len({*hits, *misses}) > 1 else None
    expected = 0.5 if statistic is None else statistic / (len(hits) * len(misses))
    assert area_under_roc(*cases(hits, misses, seed)) == pytest.approx(expected, abs=1e-12)


@given(scores, shares)
def test_threshold_is_the_smallest_that_keeps_the_allowed_false_alarms(misses, share):
    values = torch.tensor(misses, dtype=torch.float64)
    got = _threshold_for(values, share)

    def alarms(threshold):
        return sum(value >= threshold for value in misses)

    assert alarms(got) / len(misses) <= share
    # The next smaller number gives too many false alarms.
    assert alarms(math.nextafter(got, -math.inf)) / len(misses) > share


def test_the_allowed_false_alarms_are_those_of_exact_fractions():
    """As many as the decimal share of all cases, also where the product of floats is below a whole number."""
    assert 0.29 * 100 < 29
    for count in range(1, 130):
        misses = torch.arange(count, dtype=torch.float64)
        for percent in (0, 1, 2, 5, 7, 29, 57, 58, 99):
            allowed = Fraction(percent, 100) * count // 1
            assert int((misses >= _threshold_for(misses, percent / 100)).sum()) == allowed
        for alarms in range(count):
            assert int((misses >= _threshold_for(misses, alarms / count)).sum()) == alarms


@given(scores, scores, shares)
def test_hits_equal_trying_every_threshold(hits, misses, share):
    candidates = [*hits, *misses, 2.0]
    passing = [t for t in candidates if sum(m >= t for m in misses) / len(misses) <= share]
    expected = max(sum(h >= t for h in hits) for t in passing) / len(hits)
    assert hits_at(*cases(hits, misses), share) == pytest.approx(expected, abs=1e-12)


def test_cases_of_both_kinds_are_needed():
    for present in [[True, True], [False, False], []]:
        with pytest.raises(InputError, match="present: expected both true and false values"):
            area_under_roc(torch.zeros(len(present)), torch.tensor(present, dtype=torch.bool))
    refused("absent: expected at least one case", _threshold_for, torch.zeros(0), 0.1)


def test_hits_lie_above_the_false_alarms():
    # The threshold is the next double above the absent case, so an equal score does not reach it.
    score = torch.tensor([0.3, 0.3, 0.30000004])
    assert hits_at(score, torch.tensor([True, False, True]), 0.0) == 0.5
    score = torch.tensor([0.3, math.nextafter(0.3, 1)], dtype=torch.float64)
    assert hits_at(score, torch.tensor([False, True]), 0.0) == 1
    score = torch.tensor([0.5, 0.7, 0.1], dtype=torch.float64)
    assert _threshold_for(score, 1.0) == -math.inf
    assert hits_at(score, torch.tensor([False, True, True]), 1.0) == 1

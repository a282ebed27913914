"""Metrics of deciding whether a target is present, against scipy and against trying every threshold."""

import math
from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from eval.presence import _threshold_for, hits_at
from semfov.errors import InputError
from semfov.metrics.episodes import area_under_roc

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
    with pytest.raises(InputError, match="absent: expected at least one case"):
        _threshold_for(torch.zeros(0), 0.1)


def test_hits_lie_above_the_false_alarms():
    # The threshold is the next double above the absent case, so an equal score does not reach it.
    score = torch.tensor([0.3, 0.3, 0.30000004])
    assert hits_at(score, torch.tensor([True, False, True]), 0.0) == 0.5
    score = torch.tensor([0.3, math.nextafter(0.3, 1)], dtype=torch.float64)
    assert hits_at(score, torch.tensor([False, True]), 0.0) == 1
    score = torch.tensor([0.5, 0.7, 0.1], dtype=torch.float64)
    assert _threshold_for(score, 1.0) == -math.inf
    assert hits_at(score, torch.tensor([False, True, True]), 1.0) == 1

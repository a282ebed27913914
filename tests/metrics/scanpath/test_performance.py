"""How soon and how straight searches reach their target, against counting by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import trapezoid

from semfov.errors import InputError
from semfov.metrics.scanpath import (
    found_at,
    mean_performance,
    performance_area,
    probability_mismatch,
    scanpath_ratio,
    tfp_auc,
)

searches = st.lists(st.tuples(st.integers(-1, 12), st.sampled_from("abc")), min_size=1, max_size=30)


@given(searches, st.integers(0, 10))
def test_groups_count_alike_however_many_searches_they_have(cases, shifts):
    found, groups = zip(*cases, strict=True)
    expected = []
    for n in range(shifts + 1):
        shares = []
        for group in set(groups):
            own = [f for f, g in cases if g == group]
            shares.append(sum(0 <= f <= n for f in own) / len(own))
        expected.append(sum(shares) / len(shares))
    np.testing.assert_allclose(mean_performance(found, groups, shifts), expected, atol=1e-12)
    assert tfp_auc(found, groups, shifts) == pytest.approx(sum(expected))


@given(st.lists(st.floats(0, 1), min_size=2, max_size=20))
def test_area_is_scipys_trapezoid(curve):
    assert performance_area(curve) == pytest.approx(trapezoid(curve, dx=1 / (len(curve) - 1)))


def test_a_search_that_finds_at_once_has_area_one_and_a_mismatch_of_nothing():
    assert performance_area(np.ones(7)) == pytest.approx(1)
    assert probability_mismatch(np.ones(7), np.ones(7)) == 0
    assert probability_mismatch(torch.zeros(7), torch.ones(7)) == 7


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_the_edges_of_a_box_are_on_the_target(kind):
    path = kind([[0.0, 0.0], [10.0, 20.0], [15.0, 25.0]])
    assert found_at(path, (10, 20, 30, 40)) == 1
    assert found_at(path, (10.001, 20, 30, 40)) == 2
    assert found_at(path, (50, 50, 60, 60)) == -1


def test_the_straight_way_has_ratio_one_and_a_detour_less():
    box = (90, -10, 110, 10)
    assert scanpath_ratio([[0, 0], [50, 0], [100, 0]], box) == pytest.approx(1)
    assert scanpath_ratio([[0, 0], [0, 100], [100, 100], [100, 0]], box) == pytest.approx(1 / 3)
    # What comes after the target does not count; nor does a gaze that stops short of its centre gain.
    assert scanpath_ratio([[0, 0], [92, 0], [500, 500]], box) == 1
    assert np.isnan(scanpath_ratio([[100, 0], [0, 0]], box))
    assert np.isnan(scanpath_ratio([[0, 0], [1, 1]], box))


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: mean_performance([1], ["a", "b"], 3), "groups"),
        (lambda: mean_performance([], [], 3), "groups"),
        (lambda: performance_area([0.5]), "curve"),
        (lambda: probability_mismatch([0.5], [0.5, 0.6]), "reference"),
        (lambda: found_at([1, 2], (0, 0, 1, 1)), "points"),
    ],
)
def test_what_cannot_be_is_refused_by_name(call, argument):
    with pytest.raises(InputError, match=f"^{argument}:"):
        call()

"""How soon and how straight searches reach their target, against counting by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import trapezoid

from semfov.metrics.scanpath import (
    found_at,
    mean_performance,
    performance_area,
    probability_mismatch,
    scanpath_ratio,
    tfp_auc,
)
from tests.refusals import refused

searches = st.lists(st.tuples(st.integers(-1, 12), st.sampled_from("abc")), min_size=1, max_size=30)


@given(searches, st.integers(0, 10))
def test_groups_have_equal_weight_whatever_their_number_of_searches(cases, shifts):
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
def test_area_equals_the_trapezoid_rule_of_scipy(curve):
    assert performance_area(curve) == pytest.approx(trapezoid(curve, dx=1 / (len(curve) - 1)))


def test_the_four_edges_of_a_box_are_on_the_target():
    for kind in [np.array, torch.tensor]:
        path = kind([[0.0, 0.0], [10.0, 20.0], [15.0, 25.0]])
        assert found_at(path, (10, 20, 30, 40)) == 1
        assert found_at(path, (10.001, 20, 30, 40)) == 2
        assert found_at(path, (50, 50, 60, 60)) == -1
    box = (10, 20, 30, 40)
    for point in ([10, 20], [30, 20], [10, 40], [30, 40]):
        assert found_at([point], box) == 0
    for point in ([9.9, 30], [30.1, 30], [20, 19.9], [20, 40.1]):
        assert found_at([point], box) == -1


def test_scanpath_ratios_by_hand():
    box = (90, -10, 110, 10)
    assert scanpath_ratio([[0, 0], [50, 0], [100, 0]], box) == pytest.approx(1)
    assert scanpath_ratio([[0, 0], [0, 100], [100, 100], [100, 0]], box) == pytest.approx(1 / 3)
    # Fixations after the target do not count; stopping short of its centre does not raise the ratio above 1.
    assert scanpath_ratio([[0, 0], [92, 0], [500, 500]], box) == 1
    assert np.isnan(scanpath_ratio([[100, 0], [0, 0]], box))
    assert np.isnan(scanpath_ratio([[0, 0], [1, 1]], box))
    # From (10, 20) via (10, 50) to (50, 50): 30 and 40 along two sides of a triangle whose third side is 50.
    assert scanpath_ratio([[10, 20], [10, 50], [50, 50]], (45, 45, 55, 55)) == pytest.approx(50 / 70)


def test_byte_coordinates_do_not_overflow():
    """Their differences and sums do not wrap around at 256."""
    path, box = np.array([[200, 250], [250, 200]], dtype=np.uint8), np.array([240, 190, 254, 210], dtype=np.uint8)
    assert scanpath_ratio(path, box) == pytest.approx(min(1, np.hypot(47, 50) / np.hypot(50, 50)))
    path = np.array([[10, 100], [40, 60], [250, 210]], dtype=np.uint8)
    box = np.array([240, 200, 252, 220], dtype=np.uint8)
    assert scanpath_ratio(path, box) == pytest.approx(np.hypot(236, 110) / (50 + np.hypot(210, 150)))
    found, everyone = np.array([0, 1, 1], dtype=np.uint8), np.array([1, 1, 1], dtype=np.uint8)
    assert probability_mismatch(found, everyone) == 1


def test_areas_by_hand():
    assert performance_area(np.ones(7)) == pytest.approx(1)
    assert probability_mismatch(np.ones(7), np.ones(7)) == 0
    assert probability_mismatch(torch.zeros(7), torch.ones(7)) == 7
    # One search, found by the second of three fixations.
    assert performance_area(np.array([False, True, True])) == pytest.approx(0.75)
    assert tfp_auc([0, 0], ["cup", "fork"]) == 7
    assert tfp_auc([6, 7], ["cup", "fork"]) == 0.5


def test_invalid_arguments_are_refused_by_name():
    for call, argument in [
        (lambda: mean_performance([1], ["a", "b"], 3), "groups"),
        (lambda: mean_performance([], [], 3), "groups"),
        (lambda: performance_area([0.5]), "curve"),
        (lambda: probability_mismatch([0.5], [0.5, 0.6]), "reference"),
        (lambda: found_at([1, 2], (0, 0, 1, 1)), "points"),
        (lambda: found_at(np.zeros((0, 2)), (0, 0, 1, 1)), "points"),
    ]:
        refused(f"^{argument}:", call)
    for call, named in [
        (lambda: found_at([[5, 5]], [8, 4, 4, 8]), "box: expected x1 <= x2 and y1 <= y2"),
        (lambda: found_at([[5, 5]], [4, 4, 8]), r"box: expected \(x1, y1, x2, y2\), got shape \(3,\)"),
        (lambda: found_at([[5, 5]], [4, 4, float("nan"), 8]), "box: expected x1 <= x2 and y1 <= y2"),
        (lambda: found_at([[float("nan"), 5]], [4, 4, 8, 8]), "points: expected finite numbers"),
        (lambda: scanpath_ratio([[0, 0], [5, 5]], [8, 8, 4, 4]), "box: expected x1 <= x2 and y1 <= y2"),
    ]:
        refused(named, call)

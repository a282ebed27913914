"""Metrics of conditional and of fixation maps, against their definitions and closed forms."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.stats import entropy, mannwhitneyu, multivariate_normal

from semfov.metrics.scanpath import (
    auc,
    auc_borji,
    auc_judd,
    auc_shuffled,
    correlation,
    information_gain,
    kullback_leibler,
    log_density,
    log_likelihood,
    nss,
    similarity,
)
from tests.refusals import refused

SHAPE = (12, 17)


def test_metrics_match_their_definitions():
    """Pixel by pixel."""
    generator = np.random.default_rng(3)
    values = np.round(generator.uniform(0, 1, SHAPE), 1)
    x, y = np.array([0, 16, 5]), np.array([0, 11, 7])
    at = values[y, x]
    np.testing.assert_allclose(nss(values, x, y), (at - values.mean()) / values.std())
    np.testing.assert_allclose(auc(values, x, y), [(values < v).mean() + (values == v).mean() / 2 for v in at])
    others = values[::2, ::3].ravel()
    rows, columns = (each.ravel() for each in np.mgrid[0:12:2, 0:17:3])
    expected = mannwhitneyu(at, others).statistic / (len(at) * len(others))
    assert auc_shuffled(values, x, y, columns, rows) == pytest.approx(expected)


@pytest.mark.parametrize("levels", [4, 1000], ids=["many ties", "few ties"])
def test_area_of_judd_equals_a_loop_over_thresholds(levels):
    generator = np.random.default_rng(4)
    values = np.round(generator.uniform(0, 1, SHAPE) * levels) / levels
    x, y = np.array([0.0, 16.4, 5.3, 2.0]), np.array([0.2, 11.4, 6.6, 9.0])
    fixated = np.zeros(SHAPE, dtype=bool)
    for point in zip([0, 11, 7, 9], [0, 16, 5, 2], strict=True):
        fixated[point] = True
    passed = [values >= threshold for threshold in sorted(values[fixated], reverse=True)]
    curve = [(0, 0), *((each[~fixated].mean(), each[fixated].mean()) for each in passed), (1, 1)]
    expected = sum((b[0] - a[0]) * (a[1] + b[1]) / 2 for a, b in pairwise(curve))
    assert auc_judd(values, x, y) == pytest.approx(expected, abs=1e-12)


def test_log_likelihood_of_a_gaussian_matches_its_entropy():
    """Mean log likelihood of draws from a normal density is minus its entropy."""
    sigma, side = 6.0, 80
    y, x = np.mgrid[0:side, 0:side]
    normal = multivariate_normal(mean=[side / 2, side / 2], cov=sigma**2)
    density = log_density(normal.pdf(np.stack([x, y], -1)))
    draws = np.clip(normal.rvs(20_000, random_state=0), 0, side - 1)
    bits = log_likelihood(density, draws[:, 0], draws[:, 1]).mean()
    entropy = np.log2(2 * np.pi * np.e * sigma**2)
    assert bits == pytest.approx(2 * np.log2(side) - entropy, abs=0.03)


def test_batches_of_tensors_equal_single_maps():
    maps = torch.rand(2, 3, *SHAPE, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x, y = torch.zeros(2, 3, 4), torch.ones(2, 3, 4)
    for figure, given in ((nss, maps), (auc, maps), (log_likelihood, torch.tensor(log_density(maps)))):
        together = figure(given, x, y)
        assert together.shape == (2, 3, 4)
        np.testing.assert_allclose(together[1, 2], figure(given[1, 2], x[1, 2], y[1, 2]))
    values = log_density(np.arange(6.0).reshape(2, 3))
    assert log_likelihood(values, [0.49], [0.4]) == log_likelihood(values, [0], [0])
    assert log_likelihood(values, [0.51], [0.4]) == log_likelihood(values, [1], [0])


def test_errors_say_which_values_and_how_many_points_are_wrong():
    refused(r"got values from -2 to 1, with sums from -1 to 2$", log_density, [[[-2.0, 1.0]], [[1.0, 1.0]]])
    refused(r"got 2 of 3 outside it", nss, np.ones(SHAPE), [17, 3, 0], [0, 3, 12])


def test_densities_have_a_floor_and_all_metrics_double_precision():
    values = np.zeros(SHAPE)
    values[0, 0] = 1
    assert log_likelihood(log_density(values), [5], [5])[0] == -np.inf
    assert log_likelihood(log_density(values, floor=0.1), [5], [5])[0] == pytest.approx(np.log2(0.1))
    assert np.exp(log_density(values, floor=0.1)).sum() == pytest.approx(1)
    maps = torch.rand(2, 3, *SHAPE, generator=torch.Generator().manual_seed(4))
    maps[1] *= 100
    density = log_density(maps, floor=0.2)
    np.testing.assert_allclose(np.exp(density).sum((-1, -2)), 1, rtol=1e-12)
    np.testing.assert_array_equal(density, log_density(maps.double(), floor=0.2))
    maps = torch.rand(SHAPE, generator=torch.Generator().manual_seed(6))
    assert nss(maps, [3], [4]) == nss(maps.double(), [3], [4])
    # 1025.5 cannot be represented in half precision.
    wide = log_density(np.arange(2000.0)[None])
    assert log_likelihood(wide, np.array([1025], np.float16), np.array([0], np.float16)) == log_likelihood(
        wide, [1025], [0]
    )


def test_a_uniform_map_is_at_chance_and_does_not_affect_other_maps():
    flat = np.ones(SHAPE)
    x, y = [3, 4], [5, 6]
    assert nss(flat, x, y).tolist() == [0, 0]
    assert nss(flat / flat.size, x, y).tolist() == [0, 0]
    assert auc(flat, x, y).tolist() == [0.5, 0.5]
    np.testing.assert_allclose(log_likelihood(log_density(flat), x, y), 0, atol=1e-12)
    maps = np.stack([np.ones(SHAPE), np.random.default_rng(5).uniform(0, 1, SHAPE)])
    got = nss(maps, [[3], [4]], [[5], [6]])
    assert got[0, 0] == 0
    assert got[1, 0] == pytest.approx((maps[1, 6, 4] - maps[1].mean()) / maps[1].std())


def test_one_fixation_and_one_other_pixel_are_enough():
    assert auc_judd([[0.0, 1.0]], [1], [0]) == 1
    # The only threshold passes both pixels: the curve is a straight line from corner to corner.
    assert auc_judd([[1.0, 0.0]], [1], [0]) == 0.5
    assert auc_shuffled([[0.0, 1.0]], [1], [0], [0], [0]) == 1
    assert auc_shuffled([[0.0, 1.0]], [0], [0], [1], [0]) == 0


def test_kl_divergence_equals_scipy():
    first, second = np.random.default_rng(4).random((2, *SHAPE)) + 0.01
    assert kullback_leibler(first, second) == pytest.approx(entropy(first.ravel(), second.ravel()))
    assert kullback_leibler(first, 7 * first) == pytest.approx(0)
    hole = second.copy()
    hole[0, 0] = 0
    assert kullback_leibler(first, hole) == np.inf
    first[0, 0] = 0
    assert np.isfinite(kullback_leibler(first, hole))
    refused("maps", kullback_leibler, -first, second)


def test_correlation_and_similarity_equal_their_formulas():
    rng = np.random.default_rng(3)
    first, second = rng.random((2, 4, *SHAPE))
    expected = [np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in zip(first, second, strict=True)]
    np.testing.assert_allclose(correlation(first, second), expected)
    assert correlation(np.ones(SHAPE), first[0]) == 0
    refused("maps", correlation, first, second[:, :-1])
    first, second = np.random.default_rng(5).random((2, *SHAPE))
    distance = np.abs(first / first.sum() - second / second.sum()).sum() / 2
    assert similarity(first, second) == pytest.approx(1 - distance)
    assert similarity(first, 3 * first) == pytest.approx(1)


def test_figures_of_maps_equal_those_of_pysaliency(monkeypatch):
    theirs = pytest.importorskip("pysaliency.metrics", exc_type=ImportError)
    roc = pytest.importorskip("pysaliency.roc", exc_type=ImportError)
    monkeypatch.setattr(np, "trapz", np.trapezoid, raising=False)
    rng = np.random.default_rng(8)
    first, second = rng.random((2, *SHAPE))
    x, y, other_x, other_y = (rng.integers(side, size=9) for side in (17, 12, 17, 12))
    p, q = first / first.sum(), second / second.sum()
    free = np.ones(SHAPE, bool)
    free[y, x] = False
    assert nss(first, x, y).mean() == pytest.approx(theirs.NSS(first, x, y).mean())
    assert correlation(first, second) == pytest.approx(theirs.CC(first, second))
    assert similarity(p, q) == pytest.approx(theirs.SIM(p, q))
    divergence = theirs.probabilistic_image_based_kl_divergence(np.log(q), np.log(p))
    assert kullback_leibler(p, q) == pytest.approx(divergence)
    assert auc(first, x, y).mean() == pytest.approx(roc.general_roc(first[y, x], first.ravel())[0])
    assert auc_judd(first, x, y) == pytest.approx(roc.general_roc(first[y, x], first[free], judd=1)[0])
    shuffled = roc.general_roc(first[y, x], first[other_y, other_x])[0]
    assert auc_shuffled(first, x, y, other_x, other_y) == pytest.approx(shuffled)


def test_the_expectation_of_auc_borji_is_the_mean_auc():
    rng = np.random.default_rng(6)
    saliency, x, y = rng.random(SHAPE), rng.integers(17, size=30), rng.integers(12, size=30)
    mean = auc(saliency, x, y).mean()
    # The standard deviation of a draw is below .08, that of the mean of 400 below .004.
    assert auc_borji(saliency, x, y, draws=400) == pytest.approx(mean, abs=0.016)
    assert auc_borji(saliency, x, y, seed=1) == auc_borji(saliency, x, y, seed=1)


NAN = float("nan")
MAP = [[0.1, 0.2], [0.3, 0.4]]


def test_what_is_no_map_or_point_is_refused_by_name():
    for call, argument in [
        (lambda: nss(np.ones(SHAPE), [17], [0]), "x, y"),
        (lambda: nss(np.ones(SHAPE), [-0.6], [0]), "x, y"),
        (lambda: nss(np.ones((2, *SHAPE)), [1], [0]), "x, y"),
        (lambda: log_density(np.zeros(SHAPE)), "maps"),
        (lambda: log_density(-np.ones(SHAPE)), "maps"),
        (lambda: auc_judd(np.ones((1, 1)), [0], [0]), "saliency"),
        (lambda: nss(np.ones(5), [1], [0]), "maps"),
        (lambda: nss(np.ones((0, 5)), [], []), "maps"),
        (lambda: nss(np.ones(SHAPE), [1, 2], [0]), "x, y"),
        (lambda: nss(np.ones(SHAPE), [0], [11.5]), "x, y"),
        (lambda: nss(np.ones(SHAPE), [16.5], [0]), "x, y"),
        (lambda: auc_judd(np.ones((2, *SHAPE)), [[1], [1]], [[1], [1]]), "saliency"),
        (lambda: auc_judd(np.ones(SHAPE), [], []), "saliency"),
        (lambda: auc_shuffled(np.ones(SHAPE), [], [], [1], [1]), "x, other_x"),
        (lambda: auc_shuffled(np.ones(SHAPE), [1], [1], [], []), "x, other_x"),
    ]:
        refused(rf"^{argument}:", call)
    for call, named in [
        (lambda: auc([[0.1, NAN], [0.3, 0.4]], [1], [1]), "maps: expected numbers, got NaN in 1 of 4 pixels"),
        (lambda: nss([[0.1, NAN], [0.3, 0.4]], [1], [1]), "maps: expected numbers, got NaN"),
        (lambda: auc_judd([[0.1, NAN], [0.3, 0.4]], [1], [1]), "maps: expected numbers, got NaN"),
        (lambda: auc_shuffled([[0.1, NAN], [0.3, 0.4]], [1], [1], [0], [0]), "maps: expected numbers, got NaN"),
        (lambda: log_density([[0.1, NAN]]), "maps: expected finite numbers"),
        (lambda: nss(log_density([[0.0, 0.2], [0.3, 0.5]]), [1], [1]), "maps: expected finite numbers, got infinity"),
        (lambda: auc(MAP, [NAN], [1]), "x, y: expected points inside"),
        (lambda: log_density(MAP, floor=1.5), "floor: expected a number from 0 to 1, got 1.5"),
        (lambda: log_density(MAP, floor=-0.1), "floor: expected a number from 0 to 1"),
        (lambda: log_density(MAP, floor=NAN), "floor: expected a number from 0 to 1"),
        (
            lambda: information_gain(log_density(np.ones((4, 4))), log_density(np.ones((40, 40))), [1], [1]),
            r"baseline: expected densities over \(4, 4\) pixels, as `density`, got \(40, 40\)",
        ),
    ]:
        refused(named, call)


def test_maps_of_any_type_have_the_same_figures():
    """Halves, whole numbers and tensors; the baseline may be one for all maps."""
    for kind in (np.float16, np.uint8, np.int64, np.float32):
        maps = np.array([[1, 2], [3, 4]]).astype(kind)
        assert auc(maps, [1], [1]) == auc(torch.tensor(maps), [1], [1]) == 0.875
        assert information_gain(log_density(maps), log_density(np.ones((2, 2))), [1], [1])[0] == pytest.approx(
            np.log2(0.4 / 0.25)
        )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_correlation_without_numbers_is_refused(value):
    maps = np.random.default_rng(0).random((2, 4, 5))
    maps[1, 2, 3] = value
    for pair in ((maps[0], maps[1]), (maps[1], maps[0])):
        refused("maps: expected finite numbers, got NaN or infinity in 1 of 20 pixels", correlation, *pair)


def test_a_log_likelihood_needs_logarithms_of_a_density():
    density = np.random.default_rng(0).random((4, 5))
    density /= density.sum()
    expected = np.log2(density[2, 3] * 20)
    assert log_likelihood(np.log(density), [3], [2])[0] == pytest.approx(expected)
    assert log_likelihood(np.log(density).astype(np.float16), [3], [2])[0] == pytest.approx(expected, abs=0.01)
    for wrong in (density, np.log(density) + 3, np.log2(density), np.full((4, 5), -np.inf), density * 1e4):
        refused("density: expected natural logarithms of densities", log_likelihood, wrong, [3], [2])
        refused("density: expected natural logarithms", information_gain, np.log(density), wrong, [3], [2])

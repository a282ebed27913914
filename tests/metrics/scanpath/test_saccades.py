"""Distances of distributions of saccades against SciPy and against brute force over shifts of the circle."""

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from semfov.metrics.scanpath import direction_distance, length_distance, saccades

RNG = np.random.default_rng(1)


def test_lengths_as_scipy():
    a, b = RNG.exponential(3, 7), RNG.exponential(5, 11)
    assert length_distance(a, b) == pytest.approx(wasserstein_distance(a, b))
    assert length_distance(a, a) == 0
    assert np.isnan(length_distance([], a))


def test_directions_are_the_cheapest_matching_around_the_circle():
    """Twin: of as many directions, the best cyclic matching of the sorted ones."""
    a, b = RNG.uniform(-np.pi, np.pi, (2, 9))
    away = lambda x, y: np.abs((x - y + np.pi) % (2 * np.pi) - np.pi)  # noqa: E731
    best = min(away(np.sort(a), np.roll(np.sort(b), shift)).mean() for shift in range(9))
    assert direction_distance(a, b) == pytest.approx(best)
    assert direction_distance(a, a + 2 * np.pi) == pytest.approx(0)
    assert direction_distance([0.0], [np.pi]) == pytest.approx(np.pi)
    assert np.isnan(direction_distance(a, []))


def test_saccades_of_several_paths():
    lengths, directions = saccades([np.array([[0, 0], [0, 2], [0, 2]]), np.array([[5, 5]]), [[1, 1], [0, 1]]])
    np.testing.assert_allclose(lengths, [2, 1])
    np.testing.assert_allclose(np.abs(directions), [np.pi / 2, np.pi])

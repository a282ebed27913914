"""Metrics of searches against simulation and counts by hand."""

import numpy as np

from eval.chance import random_search
from semfov.metrics.episodes import cumulative_performance


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

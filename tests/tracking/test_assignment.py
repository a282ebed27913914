"""Cheapest pairs against SciPy, and against all ways to pair."""

from itertools import permutations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from semfov.tracking.assignment import cheapest_pairs


def cost_of(costs, pairs):
    return float(costs[pairs[:, 0], pairs[:, 1]].sum())


@pytest.mark.parametrize("seed", range(40))
def test_small_tables_cost_what_the_best_of_all_ways_costs(seed):
    random = np.random.default_rng(seed)
    rows, columns = random.integers(1, 5, 2).tolist()
    costs = random.normal(-0.3, 1, (rows, columns)).round(1)
    costs[random.random(costs.shape) < 0.3] = np.inf
    alone = np.concatenate([costs, np.zeros((rows, rows))], 1)
    best = min(alone[np.arange(rows), order].sum() for order in permutations(range(rows + columns), rows))
    pairs = cheapest_pairs(costs)
    assert cost_of(costs, pairs) == pytest.approx(best)
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)


@pytest.mark.parametrize("shape", [(60, 40), (40, 60)])
def test_large_tables_cost_what_those_of_scipy_cost(shape):
    costs = np.random.default_rng(1).normal(-0.5, 1, shape)
    alone = np.concatenate([costs, np.zeros((shape[0], shape[0]))], 1)
    rows, columns = linear_sum_assignment(alone)
    assert cost_of(costs, cheapest_pairs(costs)) == pytest.approx(alone[rows, columns].sum())


@pytest.mark.parametrize("costs", [np.zeros((0, 3)), np.zeros((3, 0)), np.ones((2, 2)), np.full((2, 2), np.inf)])
def test_nobody_is_paired_at_a_loss(costs):
    assert cheapest_pairs(costs).shape == (0, 2)

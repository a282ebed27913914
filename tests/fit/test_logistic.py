"""Logistic regressions: against scipy's minimiser, on cases so few that a whole Newton step can lead away."""

import numpy as np
import pytest
import scipy.optimize
import torch

from semfov.fit.logistic import logistic_regression


def few_cases(count, seed, spread):
    generator = torch.Generator().manual_seed(seed)
    facts = 3 * torch.randn(count, 7, generator=generator, dtype=torch.float64)
    right = torch.rand(count, generator=generator) < 0.5
    known = spread * torch.randn(count, generator=generator, dtype=torch.float64)
    return facts, right, known


def penalised_loss(coefficients, facts, right, known, ridge):
    """The loss, with half a case for and against that has no facts but the offset."""
    offset, weights = coefficients[0], coefficients[1:]
    log_odds = known.numpy() + offset + facts.numpy() @ weights
    losses = np.logaddexp(0, log_odds) - right.numpy() * log_odds
    of_offset = 0.5 * (np.logaddexp(0, offset) + np.logaddexp(0, -offset))
    return losses.sum() + of_offset + 0.5 * ridge * (weights @ weights) + 0.5e-6 * offset**2


@pytest.mark.parametrize("spread", [0.0, 2.0, 4.0])
@pytest.mark.parametrize("count", [8, 12, 30])
def test_the_least_loss_is_found_also_for_few_cases(count, spread):
    for seed in range(4):
        facts, right, known = few_cases(count, seed, spread)
        fitted = np.array(logistic_regression(facts, right, known=known, ridge=1e-2))
        cases = (facts, right, known, 1e-2)
        best = scipy.optimize.minimize(penalised_loss, np.zeros(8), cases, method="BFGS", options={"gtol": 1e-7})
        assert penalised_loss(fitted, *cases) <= best.fun + 1e-6


def test_facts_that_separate_the_cases_give_finite_coefficients():
    facts = torch.tensor([[-2.0], [-1.0], [1.0], [2.0]], dtype=torch.float64)
    for ridge in (0.0, 1e-12):
        offset, slope = logistic_regression(facts, facts[:, 0] > 0, ridge=ridge)
        assert np.isfinite([offset, slope]).all()
        assert slope > 10

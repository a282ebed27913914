"""Numerical accuracy: single against double precision over long episodes, special functions against mpmath."""

import math

import mpmath
import numpy as np
import pytest
import torch

from semfov import dirichlet, fusion

mp = mpmath.mp.clone()
mp.dps = 60


def likelihoods(count: int, components: int, sharpness: float) -> torch.Tensor:
    """Score vectors from flat (0.1) to nearly one-hot (5)."""
    generator = torch.Generator().manual_seed(int(10 * sharpness))
    return (sharpness * torch.randn(count, components, generator=generator, dtype=torch.float64)).softmax(-1)


@pytest.mark.parametrize("sharpness", [0.1, 1.0, 5.0])
@pytest.mark.parametrize("components", [2, 81])
def test_300_updates_in_single_precision_are_close_to_double_precision(components, sharpness):
    """Kaplan's rule only multiplies and adds positive numbers, so rounding errors grow slowly."""
    double = torch.full((components,), 0.5, dtype=torch.float64)
    single = double.float()
    for likelihood in likelihoods(300, components, sharpness):
        double = fusion.kaplan(double, likelihood)
        single = fusion.kaplan(single, likelihood.float())
    error = float((single.double() / double - 1).abs().max())
    assert error < 3e-5
    assert single.argmax() == double.argmax()
    assert float(double.sum()) > 0.5 * components


@pytest.mark.parametrize("sharpness", [0.1, 5.0])
def test_300_updates_in_double_precision_are_close_to_sixty_digits(sharpness):
    """The reference is computed with sixty digits."""
    double = torch.full((5,), 0.5, dtype=torch.float64)
    exact = [mp.mpf(1) / 2] * 5
    for likelihood in likelihoods(300, 5, sharpness):
        double = fusion.kaplan(double, likelihood)
        given = [mp.mpf(float(value)) for value in likelihood]
        expected = mp.fsum(b * v for b, v in zip(exact, given, strict=True))
        least = min(given) / expected
        exact = [b * (1 + v / expected) / (1 + least) for b, v in zip(exact, given, strict=True)]
    np.testing.assert_allclose(double.numpy(), [float(value) for value in exact], rtol=1e-13)


TAILS = [1e-8, 1e-4, 0.02, 0.5, 1.0, 1.5, 37.0, 1e3, 1e5, 1e7]


def rows() -> torch.Tensor:
    """Parameters for every pair of magnitudes, with their geometric mean as a third parameter."""
    return torch.tensor([[a, b, math.sqrt(a * b)] for a in TAILS for b in TAILS], dtype=torch.float64)


def exact_normaliser(row: list[mpmath.mpf]) -> mpmath.mpf:
    return mp.fsum(mp.loggamma(a) for a in row) - mp.loggamma(mp.fsum(row))


def assert_close_to_exact(found: torch.Tensor, exact: list[mpmath.mpf], size: list[mpmath.mpf]) -> None:
    """The error is at most the rounding error of the largest term of the sum, `size`."""
    for value, wanted, largest in zip(found.tolist(), exact, size, strict=True):
        assert abs(value - wanted) <= 1e-14 * max(abs(largest), 1), (value, float(wanted), float(largest))


def test_log_density_is_accurate_for_tiny_and_huge_parameters():
    table = [[mp.mpf(a) for a in row] for row in rows().tolist()]
    size = [mp.fsum(abs(mp.loggamma(a)) for a in row) + abs(mp.loggamma(mp.fsum(row))) for row in table]
    assert_close_to_exact(dirichlet.log_normaliser(rows()), [exact_normaliser(row) for row in table], size)
    alpha = rows()
    log_scores = torch.tensor([-1e-9, -300.0, -21.0], dtype=torch.float64).expand_as(alpha)
    exact, size = [], []
    for row, logs in zip(alpha.tolist(), log_scores.tolist(), strict=True):
        row = [mp.mpf(a) for a in row]
        terms = [(a - 1) * mp.mpf(log) for a, log in zip(row, logs, strict=True)]
        exact.append(mp.fsum(terms) - exact_normaliser(row))
        size.append(max(map(abs, terms)) + mp.fsum(abs(mp.loggamma(a)) for a in (*row, mp.fsum(row))))
    assert_close_to_exact(dirichlet.log_prob(alpha, log_scores), exact, size)


def test_entropy_is_accurate_for_tiny_and_huge_parameters():
    exact, size = [], []
    for row in [[mp.mpf(a) for a in row] for row in rows().tolist()]:
        total = mp.fsum(row)
        terms = [(a - 1) * (mp.digamma(a) - mp.digamma(total)) for a in row]
        exact.append(exact_normaliser(row) - mp.fsum(terms))
        largest = max(abs((a - 1) * mp.digamma(b)) for a in row for b in (a, total))
        size.append(largest + abs(mp.loggamma(total)) + max(abs(mp.loggamma(a)) for a in row))
    assert_close_to_exact(dirichlet.entropy(rows()), exact, [5 * value for value in size])


def test_divergence_is_accurate_for_tiny_and_huge_parameters():
    """Between neighbouring rows of the table: negative at most by the rounding error of the terms."""
    alpha, other = rows(), rows().roll(1, 0)
    exact, size = [], []
    for a, b in zip(alpha.tolist(), other.tolist(), strict=True):
        a, b = [mp.mpf(x) for x in a], [mp.mpf(x) for x in b]
        total = mp.fsum(a)
        terms = [(x - y) * (mp.digamma(x) - mp.digamma(total)) for x, y in zip(a, b, strict=True)]
        exact.append(exact_normaliser(b) - exact_normaliser(a) + mp.fsum(terms))
        largest = max(abs((x - y) * mp.digamma(z)) for x, y in zip(a, b, strict=True) for z in (x, total))
        size.append(largest + sum(abs(mp.loggamma(z)) for z in (*a, *b, total, mp.fsum(b))))
    assert min(exact) >= 0
    assert_close_to_exact(dirichlet.kl_divergence(alpha, other), exact, [5 * value for value in size])


def test_inverse_digamma_is_accurate_for_tiny_and_huge_arguments():
    x = torch.logspace(-8, 8, 65, dtype=torch.float64)
    level = torch.tensor([float(mp.digamma(mp.mpf(v))) for v in x.tolist()], dtype=torch.float64)
    # A rounding error of ψ(x) changes x by the error divided by ψ'(x).
    slack = [
        4e-16 * max(abs(y), 1) / float(mp.polygamma(1, v)) / v for v, y in zip(x.tolist(), level.tolist(), strict=True)
    ]
    found = dirichlet.inverse_digamma(level)
    assert bool(((found / x - 1).abs() <= 4 * torch.tensor(slack) + 1e-14).all())

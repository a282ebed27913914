"""What an observation model says of the accuracy of looks and of how well it tells classes apart."""

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy import integrate, stats
from torch.distributions import Dirichlet

from semfov import dirichlet, fusion
from semfov.errors import InputError
from semfov.observation import FovealObservationModel, visibility
from semfov.observation.separation import _log_ratio_moments

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


def make_model(dtype=torch.float64, missed=None, levels=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    alpha = 0.5 + 4 * torch.rand(4, levels, 4, generator=generator, dtype=dtype)
    alpha += 6 * torch.eye(4, dtype=dtype)[:, None] * torch.linspace(1, 0.1, levels, dtype=dtype)[:, None]
    missed = torch.rand(4, levels, generator=generator, dtype=dtype) if missed is None else missed
    return FovealObservationModel(alpha, [0.1 * n for n in range(1, levels)], ["a", "b", "c"], miss_rate=missed)


def test_moments_of_the_log_ratio_equal_integrals_with_scipy():
    """With two components the Dirichlet is a beta distribution."""
    source, target, background = (3.0, 2.0), (4.0, 1.5), (1.2, 2.5)
    density, p, q = (stats.beta(*each) for each in (source, target, background))

    def expect(function):
        return integrate.quad(lambda s: density.pdf(s) * function(s), 0, 1, epsabs=1e-10)[0]

    mean = expect(lambda s: p.logpdf(s) - q.logpdf(s))
    variance = expect(lambda s: (p.logpdf(s) - q.logpdf(s) - mean) ** 2)
    got = _log_ratio_moments(*(torch.tensor(each, dtype=torch.float64) for each in (source, target, background)))
    assert [float(each) for each in got] == pytest.approx([mean, variance], rel=1e-6)


def test_visibility_equals_d_prime_of_random_scores():
    """Scores are drawn from the Dirichlets; their log likelihood ratio is set to 0 where the detector misses."""
    model, count = make_model(), 200_000
    alpha, missed = model.alpha.detach(), model.miss_rate
    rng = np.random.default_rng(0)
    for target, level in ((1, 0), (2, 1), (3, 2)):
        ratio = {}
        for source in (0, target):
            scores = torch.as_tensor(rng.dirichlet(alpha[source, level].numpy(), count))
            log_densities = [Dirichlet(alpha[k, level], validate_args=False).log_prob(scores) for k in (target, 0)]
            seen = rng.random(count) >= float(missed[source, level])
            ratio[source] = np.where(seen, (log_densities[0] - log_densities[1]).numpy(), 0)
        apart = ratio[target].mean() - ratio[0].mean()
        expected = apart / np.sqrt((ratio[target].var() + ratio[0].var()) / 2)
        assert float(visibility(model)[target, level].detach()) == pytest.approx(expected, rel=0.02)


def test_visibility_is_zero_where_nothing_is_ever_detected():
    missed = torch.full((4, 3), 0.3, dtype=torch.float64)
    missed[:, 2] = 1
    seen = visibility(make_model(missed=missed)).detach()
    assert torch.equal(seen[:, 2], torch.zeros(4, dtype=torch.float64))
    assert torch.equal(seen[0], torch.zeros(3, dtype=torch.float64))
    assert bool((seen[1:, :2] > 0).all())
    with pytest.raises(InputError, match="model: expected an observation model with miss rates"):
        visibility(FovealObservationModel.identity(["a"], [0.1]))

"""Densities, moments, entropy and divergence against scipy, torch.distributions, mpmath and closed forms.

Equations are those of Luzio, Bernardino and Moreno (2024), with the labels of the paper's source.
"""

import math

import mpmath
import numpy as np
import pytest
import scipy.integrate
import scipy.stats
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import DirichletBelief, InputError, dirichlet
from semfov.belief.fusion import fuse
from tests.refusals import refused

DTYPES = [torch.float32, torch.float64]


def random_case(dtype, shape=(4, 3), components=6, seed=0):
    generator = torch.Generator().manual_seed(seed)
    alpha = torch.rand(*shape, components, generator=generator, dtype=torch.float64) * 5 + 0.05
    scores = torch.rand(*shape, components, generator=generator, dtype=torch.float64) + 1e-3
    return alpha.to(dtype), (scores / scores.sum(-1, keepdim=True)).log().to(dtype)


parameters = st.lists(st.floats(1e-3, 1e3), min_size=4, max_size=4).map(lambda v: torch.tensor(v, dtype=torch.float64))


@given(parameters, parameters)
def test_divergence_is_not_negative_and_zero_between_equal_distributions(alpha, other):
    scale = float((alpha.sum() + other.sum()) * 10)
    assert float(dirichlet.kl_divergence(alpha, other)) >= -1e-14 * scale
    assert float(dirichlet.kl_divergence(alpha, alpha)) == 0


def test_moments_match_scipy():
    alpha = torch.tensor([0.4, 2.0, 7.5, 1.1], dtype=torch.float64)
    reference = scipy.stats.dirichlet(alpha.numpy())
    np.testing.assert_allclose(dirichlet.mean(alpha), reference.mean(), rtol=1e-14)
    np.testing.assert_allclose(dirichlet.covariance(alpha), reference.cov(), rtol=1e-12)


def test_mean_matches_the_compound_multinomial_of_equation_4():
    """eq:finalsemanticmap, as printed, for one draw of class k: n_k = 1 and all other n_i = 0."""
    beta = [0.5, 2.0, 7.5, 1.1]
    for k, got in enumerate(dirichlet.mean(torch.tensor(beta, dtype=torch.float64)).tolist()):
        drawn = [int(i == k) for i in range(4)]
        n = sum(drawn)
        printed = math.factorial(n) / sum(beta) ** n
        printed *= math.prod(b**m / math.factorial(m) for b, m in zip(beta, drawn, strict=True))
        assert got == pytest.approx(printed, rel=1e-14)


def test_covariance_of_the_class_matches_equation_6():
    """eq:confscores: σ_ij = -p_i p_j off the diagonal, the covariance of one draw of a class."""
    alpha = torch.tensor([[0.4, 2.0, 7.5], [1.0, 1.0, 2.0]], dtype=torch.float64)
    got = dirichlet.categorical_covariance(alpha)
    for row in range(2):
        p = [float(a / alpha[row].sum()) for a in alpha[row]]
        for i in range(3):
            for j in range(3):
                drawn = sum(p[k] * ((k == i) - p[i]) * ((k == j) - p[j]) for k in range(3))
                assert float(got[row, i, j]) == pytest.approx(drawn, rel=1e-13)
                if i != j:
                    assert float(got[row, i, j]) == pytest.approx(-p[i] * p[j], rel=1e-13)
    # The covariance of the probabilities under the Dirichlet is smaller: it shrinks as evidence grows.
    torch.testing.assert_close(dirichlet.covariance(alpha), got / (alpha.sum(-1) + 1)[:, None, None])


def test_all_functions_have_gradients():
    alpha, log_scores = random_case(torch.float64, shape=(2,), components=3)
    other = alpha.flip(0).clone()
    for tensor in (alpha, other, log_scores):
        tensor.requires_grad_()
    check = torch.autograd.gradcheck
    assert check(dirichlet.log_prob, (alpha, log_scores))
    assert check(dirichlet.kl_divergence, (alpha, other))
    for function in (dirichlet.mean, dirichlet.entropy, dirichlet.covariance, dirichlet.categorical_covariance):
        assert check(function, (alpha,))
    assert check(lambda s: dirichlet.floor(s, 1e-3), (torch.tensor([0.2, 0.5, 0.3]).double().requires_grad_(),))


def test_functions_compile_to_one_graph():
    alpha, log_scores = random_case(torch.float64)
    for function, arguments in [
        (dirichlet.log_prob, (alpha, log_scores)),
        (dirichlet.entropy, (alpha,)),
        (dirichlet.kl_divergence, (alpha, alpha + 1)),
    ]:
        compiled = torch.compile(function, fullgraph=True, backend="eager")
        torch.testing.assert_close(compiled(*arguments), function(*arguments))


@pytest.mark.parametrize("dtype", DTYPES)
def test_floor_makes_logarithms_finite_and_keeps_the_simplex(dtype):
    scores = torch.tensor([[0.0, 0.0, 1.0], [1e-9, 0.5, 0.5]], dtype=dtype)
    kept = scores.clone()
    floored = dirichlet.floor(scores, 1e-6)
    assert torch.equal(scores, kept)
    assert floored.dtype == dtype
    torch.testing.assert_close(floored.sum(-1), torch.ones(2, dtype=dtype))
    torch.testing.assert_close(floored[0, :2], torch.full((2,), 1e-6 / (1 + 2e-6), dtype=dtype))
    assert bool(floored.log().isfinite().all())
    assert dirichlet.floor(scores[:0], 1e-6).shape == (0, 3)


def exact_divergence(alpha, other):
    """With 60 digits."""
    with mpmath.workdps(60):
        a, b = [mpmath.mpf(each) for each in alpha], [mpmath.mpf(each) for each in other]
        total, base = mpmath.fsum(a), mpmath.fsum(b)
        parts = [mpmath.loggamma(y) - mpmath.loggamma(x) for x, y in zip(a, b, strict=True)]
        slopes = [(x - y) * (mpmath.digamma(x) - mpmath.digamma(total)) for x, y in zip(a, b, strict=True)]
        return float(mpmath.loggamma(total) - mpmath.loggamma(base) + mpmath.fsum(parts) + mpmath.fsum(slopes))


@pytest.mark.parametrize("size", [1.0, 1e2, 1e4, 1e6])
def test_large_parameters_do_not_cancel(size, dtype):
    draw = np.random.default_rng(0)
    alpha = torch.tensor(draw.random(81) * size + 0.5).to(dtype)
    other = (alpha.double() * 1.001).to(dtype)
    expected = exact_divergence(alpha.tolist(), other.tolist())
    assert float(dirichlet.kl_divergence(alpha, other)) == pytest.approx(expected, rel=1e-4, abs=5e-7)
    exact = scipy.stats.dirichlet(alpha.double().numpy())
    assert float(dirichlet.entropy(alpha)) == pytest.approx(exact.entropy(), rel=1e-6)
    scores = torch.softmax(alpha / size, 0)
    plain = scores.double() / scores.double().sum()
    got = float(dirichlet.log_prob(alpha, plain.log().to(dtype)))
    assert got == pytest.approx(exact.logpdf(plain.numpy()), rel=1e-4 if dtype == torch.float32 else 1e-9)


def test_a_score_of_zero_counts_for_nothing_where_its_parameter_is_one():
    for alpha, scores in (([1.0, 1.0, 1.0], [0.0, 0.4, 0.6]), ([1.0, 2.0, 1.0], [0.0, 0.3, 0.7]), ([1.0, 1.0], [0, 1])):
        got = dirichlet.log_prob(torch.tensor(alpha), torch.tensor(scores, dtype=torch.float32).log())
        assert float(got) == pytest.approx(scipy.stats.dirichlet(alpha).logpdf(scores), rel=1e-6, abs=1e-7)
    zero = torch.tensor([0.0, 1.0]).log()
    assert float(dirichlet.log_prob(torch.tensor([2.0, 1.0]), zero)) == -math.inf
    assert float(dirichlet.log_prob(torch.tensor([0.5, 1.0]), zero)) == math.inf
    alpha = torch.ones(2, requires_grad=True)
    dirichlet.log_prob(alpha, zero).backward()
    assert alpha.grad.isfinite().all()


@pytest.mark.parametrize("bad", [-1.0, 0.0, float("nan"), float("inf")])
def test_parameters_are_positive_and_finite(bad):
    alpha, good = torch.tensor([1.0, bad]), torch.ones(2)
    calls = [
        dirichlet.log_normaliser, dirichlet.mean, dirichlet.covariance, dirichlet.entropy,
        lambda a: dirichlet.log_prob(a, good.log()), lambda a: dirichlet.kl_divergence(a, good),
        lambda a: dirichlet.kl_divergence(good, a), lambda a: dirichlet.kl_from_symmetric(a, 0.5), DirichletBelief,
        lambda a: fuse(a[None, None], torch.ones(1, 1, 2), torch.ones(1, 1, 1)),
    ]  # fmt: skip
    for call in calls:
        refused("expected positive, finite", call, alpha)


def test_bad_arguments_and_weights_of_cells_are_named():
    for call in [
        lambda: dirichlet.log_prob(torch.tensor([1.0, torch.nan]), torch.zeros(2)),
        lambda: dirichlet.log_prob(torch.ones(3), torch.zeros(2)),
        lambda: dirichlet.kl_divergence(torch.ones(3), torch.ones(2)),
        lambda: dirichlet.floor(torch.tensor([0.5, torch.nan]), 1e-6),
        lambda: dirichlet.floor(torch.tensor([1.5, -0.5]), 1e-6),
        lambda: dirichlet.floor(torch.tensor([0.5, 0.5]), 0.0),
    ]:
        refused("expected", call)
    for weight in [math.nan, 2.0, -0.5, math.inf]:
        with pytest.raises(InputError, match="footprint: expected weights from 0 to 1"):
            fuse(torch.ones(1, 2, 2), torch.ones(1, 1, 2), torch.tensor([[[1.0, weight]]]))


def test_parameters_that_are_no_floats_or_too_large_are_refused():
    """Entropies of integers would be integers, and of huge parameters the rounding of far larger terms."""
    exact = float(scipy.stats.dirichlet(np.array([1e9, 2e9, 3e9])).entropy())
    np.testing.assert_allclose(float(dirichlet.entropy(torch.tensor([1e9, 2e9, 3e9]))), exact, atol=1e-3)
    for alpha, said in (
        (torch.tensor([1, 2, 3]), r"alpha: expected floating-point parameters.*; give alpha\.float\(\)"),
        ([1.0, 2.0], r"alpha: expected a tensor, got a list; give torch\.as_tensor\(alpha\)"),
        (torch.tensor([]), "alpha: expected at least one parameter"),
        (torch.tensor([1e12, 2.0]), "alpha: expected parameters up to 1e[+]10"),
    ):
        for call in (dirichlet.entropy, lambda given: dirichlet.kl_divergence(given, torch.ones(2))):
            refused(said if call is dirichlet.entropy else "alpha|other", call, alpha)

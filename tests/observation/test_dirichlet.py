"""Dirichlet distributions: densities, divergences, special functions, maximum likelihood, against SciPy and mpmath."""

import math

import dirichlet as pypi
import mpmath
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import scipy.special
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from semfov import DirichletBelief, InputError, dirichlet
from semfov.belief.fusion import fuse
from semfov.observation.dirichlet import floor, log_prob, mle, shrink, vacuous
from semfov.observation.special import log_gamma_divergence
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


def test_moments_match_scipy_and_the_mean_the_compound_multinomial_of_equation_4():
    """eq:finalsemanticmap, as printed, for one draw of class k: n_k = 1 and all other n_i = 0."""
    beta = [0.5, 2.0, 7.5, 1.1]
    for k, got in enumerate(dirichlet.mean(torch.tensor(beta, dtype=torch.float64)).tolist()):
        drawn = [int(i == k) for i in range(4)]
        n = sum(drawn)
        printed = math.factorial(n) / sum(beta) ** n
        printed *= math.prod(b**m / math.factorial(m) for b, m in zip(beta, drawn, strict=True))
        assert got == pytest.approx(printed, rel=1e-14)
    alpha = torch.tensor([0.4, 2.0, 7.5, 1.1], dtype=torch.float64)
    reference = scipy.stats.dirichlet(alpha.numpy())
    np.testing.assert_allclose(dirichlet.mean(alpha), reference.mean(), rtol=1e-14)
    np.testing.assert_allclose(dirichlet.covariance(alpha), reference.cov(), rtol=1e-12)


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


METHODS = ["newton", "fixed_point", "gradient"]


def expected_logs(alpha):
    """Mean logs of infinitely many samples."""
    return alpha.digamma() - alpha.sum(-1, keepdim=True).digamma()


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("components", "mean", "spread"),
    [(2, 0, 1.5), (2, 0, 3), (3, 0, 1), (10, 3, 2), (81, -1, 2), (81, -6, 1.5), (81, 4, 2)],
)
def test_parameters_are_recovered_from_their_expected_logs(method, components, mean, spread):
    alpha = (normal(5, 4, components) * spread + mean).exp()
    got = mle(expected_logs(alpha), method=method)
    assert got.shape == alpha.shape
    torch.testing.assert_close(got, alpha, rtol=1e-6, atol=0)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 12), st.integers(2, 30), st.floats(-3, 4))
def test_all_methods_find_the_same_maximum(seed, components, samples, level):
    generator = np.random.default_rng(seed)
    truth = np.exp(generator.normal(level, 1.5, components))
    scores = floor(torch.from_numpy(generator.dirichlet(truth, samples)), 1e-6)
    mean_log = scores.log().mean(0)
    found = [mle(mean_log, method=method) for method in METHODS]
    torch.testing.assert_close(found[1], found[0], rtol=1e-6, atol=0)
    torch.testing.assert_close(found[2], found[0], rtol=1e-6, atol=0)
    best = log_prob(found[0], mean_log)
    bounded = float(found[0].sum()) > 0.999e8
    for direction in normal(5, components, seed=seed) * 1e-2:
        near = found[0] * direction.exp()
        near = near * (found[0].sum() / near.sum() if bounded else 1.0)
        assert float(log_prob(near, mean_log)) <= float(best)


def test_fit_matches_the_pypi_package():
    samples = np.random.default_rng(1).dirichlet([3.0, 0.5, 8.0, 1.0], 100)
    mean_log = torch.from_numpy(np.log(samples)).mean(0)
    reference = pypi.mle(samples, tol=1e-12)
    ours = mle(mean_log)
    np.testing.assert_allclose(ours, reference, rtol=1e-5)
    assert float(log_prob(ours, mean_log)) >= pypi.loglikelihood(samples, reference) / 100 - 1e-12


@pytest.mark.parametrize("method", METHODS)
def test_a_batch_equals_its_rows(method):
    alpha = (normal(6, 5) * 2).exp()
    mean_log = expected_logs(alpha)
    kept = mean_log.clone()
    batch = mle(mean_log.reshape(3, 2, 5), method=method)
    assert torch.equal(mean_log, kept)
    rows = torch.stack([mle(row, method=method) for row in mean_log])
    torch.testing.assert_close(batch.reshape(6, 5), rows, rtol=1e-7, atol=0)
    assert mle(mean_log[:0], method=method).shape == (0, 5)


def test_single_precision_input_gives_single_precision_output():
    alpha = (normal(4, 6) * 0.5 + 1).exp()
    got = mle(expected_logs(alpha).float())
    assert got.dtype == torch.float32
    torch.testing.assert_close(got.double(), alpha, rtol=1e-4, atol=0)


@pytest.mark.parametrize("method", METHODS)
def test_identical_samples_get_the_largest_precision(method):
    scores = torch.tensor([0.7, 0.2, 0.1], dtype=torch.float64)
    alpha = mle(torch.stack([scores, scores]).log().mean(0), method=method, max_precision=1e5)
    assert float(alpha.sum()) == pytest.approx(1e5)
    torch.testing.assert_close(alpha / alpha.sum(), scores, rtol=1e-4, atol=0)
    default = mle(scores.log(), method=method)
    assert float(default.sum()) == pytest.approx(1e8)


def test_a_bound_on_the_precision_gives_the_constrained_maximum():
    samples = np.random.default_rng(2).dirichlet([30.0, 5.0, 65.0], 50)
    mean_log = np.log(samples).mean(0)
    bound = 20.0

    def loss(x):
        alpha = bound * np.exp(x) / np.exp(x).sum()
        return (
            -scipy.stats.dirichlet(alpha).logpdf(np.exp(mean_log) / np.exp(mean_log).sum())
            + ((alpha - 1) * (mean_log - np.log(np.exp(mean_log).sum()) - mean_log)).sum()
        )

    best = scipy.optimize.minimize(loss, np.zeros(3), options={"gtol": 1e-10}).x
    expected = bound * np.exp(best) / np.exp(best).sum()
    got = mle(torch.from_numpy(mean_log), max_precision=bound)
    assert float(mle(torch.from_numpy(mean_log)).sum()) > bound
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_zeros_are_refused_unless_they_are_floored():
    scores = torch.tensor([[0.0, 0.4, 0.6], [0.0, 0.7, 0.3]], dtype=torch.float64)
    refused(r"mean_log.*finite", mle, scores.log().mean(0))
    mean_log = floor(scores, 1e-6).log().mean(0)
    alpha = mle(mean_log)
    torch.testing.assert_close(expected_logs(alpha), mean_log, rtol=0, atol=1e-8)


def test_shrinkage_adds_samples_of_the_prior():
    empty = torch.full((2, 4), torch.nan, dtype=torch.float64)
    parent = expected_logs(torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64))
    torch.testing.assert_close(shrink(empty, torch.zeros(2), parent, 1.0), parent.expand(2, 4))
    alpha = mle(shrink(empty, torch.zeros(2), vacuous(4), 1.0))
    torch.testing.assert_close(alpha, torch.ones(2, 4, dtype=torch.float64))
    data = torch.from_numpy(np.random.default_rng(4).dirichlet([2.0, 1.0, 4.0], 7)).log()
    prior = torch.from_numpy(np.random.default_rng(5).dirichlet([1.0, 1.0, 1.0], 3)).log()
    pooled = mle(torch.cat([data, prior]).mean(0))
    shrunk = mle(shrink(data.mean(0), torch.tensor(7), prior.mean(0), 3.0))
    torch.testing.assert_close(shrunk, pooled, rtol=1e-10, atol=0)


def test_gradients_of_the_optimum_are_correct():
    mean_log = expected_logs((normal(3, 4, seed=5)).exp()).requires_grad_()
    assert torch.autograd.gradcheck(mle, (mean_log,), rtol=1e-4)
    bounded = torch.tensor([[0.7, 0.2, 0.1]], dtype=torch.float64).log().requires_grad_()
    assert torch.autograd.gradcheck(lambda g: mle(g - 1e-3, max_precision=50.0), (bounded,), rtol=1e-4)


def test_bad_arguments_are_named():
    refused("expected|did you mean", lambda: mle(torch.tensor([-1.0])))
    refused("expected|did you mean", lambda: mle(torch.tensor(-1.0)))
    refused("expected|did you mean", lambda: mle(torch.tensor([-0.1, -0.1])))
    refused("expected|did you mean", lambda: mle(torch.tensor([-1.0, torch.nan])))
    refused("expected|did you mean", lambda: mle(torch.tensor([-1.0, -1.0]), method="newtons"))
    refused("expected|did you mean", lambda: mle(torch.tensor([-1.0, -1.0]), max_precision=0.0))
    refused("expected|did you mean", lambda: shrink(torch.zeros(2), torch.tensor(1), torch.zeros(2), 0.0))


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_fits_without_gradients(method, mode):
    mean_log = torch.tensor([[-1.0, -2.0, -1.5], [-2.0, -1.2, -1.0]], dtype=torch.float64)
    expected = mle(mean_log, method=method)
    with mode():
        torch.testing.assert_close(mle(mean_log.clone(), method=method), expected)


mp = mpmath.mp.clone()
mp.dps = 40

# From close to the pole at 0 to where the function is linear, and close to c.
POINTS = [*np.logspace(-8, 8, 97).tolist(), 0.5, 1.0, 2.0, 8.0]
NEAR = [1 + step for step in (-0.1, -1e-2, -1e-3, 1e-3, 1e-2, 0.1, 0.5)]


def exact(x, c):
    x, c = mp.mpf(x), mp.mpf(c)
    return float((x - c) * mp.digamma(x) - mp.loggamma(x) + mp.loggamma(c))


@pytest.mark.parametrize("c", [0.25, 0.5, 1.0, 5.0, 100.0])
@pytest.mark.parametrize(("dtype", "digits"), [(torch.float64, 5e-14), (torch.float32, 1e-6)], ids=str)
def test_divergence_of_log_gamma_matches_mpmath(dtype, digits, c):
    """Up to a few rounding errors of the value or of the distance from c, as the value is much smaller near c."""
    x = torch.tensor([*POINTS, *(c * step for step in NEAR)], dtype=dtype)
    got = log_gamma_divergence(x, c)
    assert got.dtype == dtype
    for value, at in zip(got.tolist(), x.tolist(), strict=True):
        assert abs(value - exact(at, c)) <= digits * (exact(at, c) + abs(at - c)), at


def test_divergence_of_log_gamma_of_very_small_and_large_numbers_in_one_graph_and_by_vmap(dtype):
    """(c - x) ψ(x) is c / x near 0, and it is x where x is large."""
    x = torch.tensor([1e-38, 1e-30, 1e30, 1e38], dtype=dtype)
    expected = torch.tensor([5e37, 5e29, 1e30, 1e38], dtype=dtype)
    torch.testing.assert_close(log_gamma_divergence(x, 0.5), expected)
    x = torch.rand(3, 7, dtype=dtype) + 0.1
    whole = log_gamma_divergence(x, 0.5)
    torch.compiler.reset()
    compiled = torch.compile(log_gamma_divergence, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(x, 0.5), whole)
    torch.testing.assert_close(torch.func.vmap(lambda row: log_gamma_divergence(row, 0.5))(x), whole)


def test_derivative_of_the_divergence_of_log_gamma():
    """(x - c) times trigamma."""
    x = torch.logspace(-3, 4, 57, dtype=torch.float64, requires_grad=True)
    for c in (0.5, 2.0):
        assert torch.autograd.gradcheck(lambda y, c=c: log_gamma_divergence(y, c), x[10:40])
        (slope,) = torch.autograd.grad(log_gamma_divergence(x, c).sum(), x)
        trigamma = scipy.special.polygamma(1, x.detach().numpy())
        np.testing.assert_allclose(slope.numpy(), (x.detach().numpy() - c) * trigamma, rtol=1e-8, atol=1e-8)


def beliefs(classes, dtype=torch.float64):
    """Dirichlets with no, little and much evidence."""
    generator = torch.Generator().manual_seed(classes)
    alpha = 0.5 + 3 * torch.rand(40, classes, generator=generator, dtype=torch.float64) ** 4
    alpha[0] = 0.5
    alpha[10:20, 0] += 30
    alpha[20:30] *= 200
    return alpha.to(dtype)


@pytest.mark.parametrize("parameter", [0.1, 0.5, 1.0, 7.0])
@pytest.mark.parametrize("classes", [2, 5, 81])
def test_divergence_matches_torch_distributions(classes, parameter):
    alpha = beliefs(classes)
    one, base = (torch.distributions.Dirichlet(a) for a in (alpha, torch.full_like(alpha, parameter)))
    got = dirichlet.kl_from_symmetric(alpha, parameter)
    torch.testing.assert_close(got, torch.distributions.kl_divergence(one, base), rtol=1e-11, atol=1e-9)
    torch.testing.assert_close(
        got, dirichlet.kl_divergence(alpha, torch.full_like(alpha, parameter)), rtol=1e-11, atol=1e-9
    )


@pytest.mark.parametrize("classes", [2, 5, 81])
def test_divergence_in_single_precision(classes):
    """The error is only that of rounding each term: the term of the sum of all parameters is computed in double."""
    alpha = beliefs(classes, torch.float32)
    got, exact = dirichlet.kl_from_symmetric(alpha, 0.5), dirichlet.kl_from_symmetric(alpha.double(), 0.5)
    assert got.dtype == torch.float32
    terms = (alpha.double() * alpha.double().digamma()).abs().sum(-1) + exact
    assert bool(((got - exact).abs() <= 3e-7 * terms.clamp(min=1)).all())


def test_divergence_from_itself_is_zero_and_the_parameter_positive():
    for dtype in (torch.float32, torch.float64):
        assert dirichlet.kl_from_symmetric(torch.full((81,), 0.5, dtype=dtype), 0.5).abs() < 1e-12
    refused("parameter", dirichlet.kl_from_symmetric, torch.ones(3), 0.0)

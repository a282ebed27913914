"""Maximum likelihood by three methods: against each other, closed forms, scipy and the PyPI package `dirichlet`."""

import dirichlet as pypi
import numpy as np
import pytest
import scipy.optimize
import scipy.special
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from semfov.observation.dirichlet import floor, log_prob, mle, shrink, vacuous
from tests.refusals import refused

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

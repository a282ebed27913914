"""The divergence of ln Γ, and that from a symmetric Dirichlet, against mpmath, scipy and torch.distributions."""

import mpmath
import numpy as np
import pytest
import scipy.special
import torch

from semfov import InputError, dirichlet
from semfov.observation.special import log_gamma_divergence

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


def test_divergence_of_log_gamma_of_very_small_and_very_large_numbers(dtype):
    """(c - x) ψ(x) is c / x near 0, and it is x where x is large."""
    x = torch.tensor([1e-38, 1e-30, 1e30, 1e38], dtype=dtype)
    expected = torch.tensor([5e37, 5e29, 1e30, 1e38], dtype=dtype)
    torch.testing.assert_close(log_gamma_divergence(x, 0.5), expected)


def test_derivative_of_the_divergence_of_log_gamma():
    """(x - c) times trigamma."""
    x = torch.logspace(-3, 4, 57, dtype=torch.float64, requires_grad=True)
    for c in (0.5, 2.0):
        assert torch.autograd.gradcheck(lambda y, c=c: log_gamma_divergence(y, c), x[10:40])
        (slope,) = torch.autograd.grad(log_gamma_divergence(x, c).sum(), x)
        trigamma = scipy.special.polygamma(1, x.detach().numpy())
        np.testing.assert_allclose(slope.numpy(), (x.detach().numpy() - c) * trigamma, rtol=1e-8, atol=1e-8)


def test_divergence_of_log_gamma_compiles_to_one_graph_and_vectorises(dtype):
    x = torch.rand(3, 7, dtype=dtype) + 0.1
    whole = log_gamma_divergence(x, 0.5)
    torch.compiler.reset()
    compiled = torch.compile(log_gamma_divergence, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(x, 0.5), whole)
    torch.testing.assert_close(torch.func.vmap(lambda row: log_gamma_divergence(row, 0.5))(x), whole)


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
    with pytest.raises(InputError, match="parameter"):
        dirichlet.kl_from_symmetric(torch.ones(3), 0.0)

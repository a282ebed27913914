"""Digamma, and the divergence from a symmetric Dirichlet, against mpmath, scipy and torch.distributions."""

import math

import mpmath
import numpy as np
import pytest
import scipy.special
import torch

from semfov import InputError, dirichlet
from semfov.observation.special import digamma

mp = mpmath.mp.clone()
mp.dps = 40

# From next to the pole at 0 to where ψ is the logarithm, and on both sides of its zero at 1.4616.
POINTS = [*np.logspace(-6, 6, 241).tolist(), 0.5, 1.0, 1.4616321449683623, 1.46, 2.0, 8.0]


@pytest.mark.parametrize(("dtype", "digits"), [(torch.float64, 2e-15), (torch.float32, 4e-7)], ids=str)
def test_digamma_is_that_of_mpmath(dtype, digits):
    """To a few roundings of ψ, or of the logarithm of which the sum is taken where ψ is near 0."""
    x = torch.tensor(POINTS, dtype=dtype)
    got = digamma(x)
    assert got.dtype == dtype
    for value, at in zip(got.tolist(), x.tolist(), strict=True):
        exact = float(mp.digamma(mp.mpf(at)))
        assert abs(value - exact) <= digits * max(abs(exact), math.log(at + 8)), at


@pytest.mark.parametrize(("dtype", "digits"), [(torch.float64, 1e-13), (torch.float32, 2e-5)], ids=str)
def test_digamma_is_that_of_scipy(dtype, digits):
    x = torch.tensor(POINTS[:241], dtype=dtype)
    np.testing.assert_allclose(digamma(x).double(), scipy.special.digamma(x.double().numpy()), rtol=digits, atol=digits)


def test_digamma_of_one_is_eulers_constant():
    torch.testing.assert_close(digamma(torch.ones(3)), torch.full((3,), -0.5772156649015329))


def test_digamma_steps_by_the_inverse():
    """ψ(x + 1) = ψ(x) + 1/x."""
    x = torch.logspace(-3, 3, 61, dtype=torch.float64)
    torch.testing.assert_close(digamma(x + 1), digamma(x) + 1 / x, rtol=1e-12, atol=1e-12)


def test_derivative_of_digamma_is_trigamma():
    x = torch.logspace(-3, 4, 57, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(digamma, x[10:40])
    (slope,) = torch.autograd.grad(digamma(x).sum(), x)
    np.testing.assert_allclose(slope, scipy.special.polygamma(1, x.detach().numpy()), rtol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_digamma_compiles_whole(dtype):
    x = torch.rand(3, 7, dtype=dtype) + 0.1
    torch.compiler.reset()
    assert torch.equal(torch.compile(digamma, fullgraph=True, backend="eager")(x), digamma(x))


def beliefs(classes, dtype=torch.float64):
    """Dirichlets that know nothing, a little and much."""
    generator = torch.Generator().manual_seed(classes)
    alpha = 0.5 + 3 * torch.rand(40, classes, generator=generator, dtype=torch.float64) ** 4
    alpha[0] = 0.5
    alpha[10:20, 0] += 30
    alpha[20:30] *= 200
    return alpha.to(dtype)


@pytest.mark.parametrize("parameter", [0.1, 0.5, 1.0, 7.0])
@pytest.mark.parametrize("classes", [2, 5, 81])
def test_divergence_is_that_of_torch_distributions(classes, parameter):
    alpha = beliefs(classes)
    one, base = (torch.distributions.Dirichlet(a) for a in (alpha, torch.full_like(alpha, parameter)))
    got = dirichlet.kl_from_symmetric(alpha, parameter)
    torch.testing.assert_close(got, torch.distributions.kl_divergence(one, base), rtol=1e-11, atol=1e-9)
    torch.testing.assert_close(
        got, dirichlet.kl_divergence(alpha, torch.full_like(alpha, parameter)), rtol=1e-11, atol=1e-9
    )


@pytest.mark.parametrize("classes", [2, 5, 81])
def test_divergence_in_single_precision(classes):
    """Rounding of each term, and no more: that of the sum of the parameters is computed in double."""
    alpha = beliefs(classes, torch.float32)
    got, exact = dirichlet.kl_from_symmetric(alpha, 0.5), dirichlet.kl_from_symmetric(alpha.double(), 0.5)
    assert got.dtype == torch.float32
    terms = (alpha.double() * alpha.double().digamma()).abs().sum(-1) + exact
    assert bool(((got - exact).abs() <= 3e-7 * terms.clamp(min=1)).all())


def test_divergence_from_itself_is_nothing():
    for dtype in (torch.float32, torch.float64):
        assert dirichlet.kl_from_symmetric(torch.full((81,), 0.5, dtype=dtype), 0.5).abs() < 1e-12


def test_divergence_of_two_classes_from_the_uniform_by_hand():
    """Of Dir(2, 1), whose density is 2 p, from Dir(1, 1): ∫ 2 p ln 2 p dp = ln 2 - 1/2."""
    got = dirichlet.kl_from_symmetric(torch.tensor([2.0, 1.0], dtype=torch.float64), 1.0)
    assert float(got) == pytest.approx(math.log(2) - 0.5, rel=1e-14)


def test_divergence_has_gradients():
    alpha = beliefs(5)[1:20:6].requires_grad_()
    assert torch.autograd.gradcheck(lambda a: dirichlet.kl_from_symmetric(a, 0.5), alpha)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_divergence_compiles_whole(dtype):
    alpha = beliefs(5, dtype)
    torch.compiler.reset()
    compiled = torch.compile(dirichlet.kl_from_symmetric, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(alpha, 0.5), dirichlet.kl_from_symmetric(alpha, 0.5))


def test_a_parameter_is_positive():
    with pytest.raises(InputError, match="parameter"):
        dirichlet.kl_from_symmetric(torch.ones(3), 0.0)

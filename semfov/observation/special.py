"""Special functions that torch lacks."""

from functools import lru_cache
from math import prod

import numpy as np
import torch
from numpy.polynomial import Chebyshev, Polynomial
from numpy.typing import NDArray
from torch import Tensor

# B_2k / 2k for k = 1, 2, … The error of these terms is below 1e-15 for arguments from `_SHIFT`.
_STIRLING = (1 / 12, -1 / 120, 1 / 252, -1 / 240, 1 / 132, -691 / 32760, 1 / 12, -3617 / 8160)
_SHIFT = 8


def log_gamma_divergence(x: Tensor, c: float) -> Tensor:
    r"""Bregman divergence of ln Γ: the height of ln Γ at c above its tangent at x, for positive numbers.

    .. math:: h(x) = \ln\Gamma(c) - \ln\Gamma(x) - (c - x) \, \psi(x)

    It is 0 at c and never negative. The recurrences of Γ and ψ shift x to x + n, where Stirling's series is accurate
    (Abramowitz and Stegun, 1964, 6.1.40, 6.3.6 and 6.3.18). In terms of g, which is 0 at c, all terms but two reduce
    to one logarithm and three polynomials, and no large terms cancel:

    .. math::

        h(x) &= \ln\Bigl(\bigl(1 + \tfrac{n}{c} g\bigr) P(g)\Bigr) + g \Bigl(Q(g) - \frac{(1 - g) P'(g)}{P(g)}\Bigr)
        + (x - c) \Bigl(1 - \frac{1}{x}\Bigr) + \Bigl(\frac{1}{2} - c\Bigr) \ln\frac{x + n}{c + n} \\
        g &= \frac{x - c}{x + n}, \qquad P(g) = \prod_{i=1}^{n-1} \Bigl(1 + \frac{n - i}{c + i} \, g\Bigr)

    with n = 8 in double precision, where g Q(g) is Stirling's series minus its value at c, minus (n - 1/2) g. In single
    precision n = 1, thus P = 1, and Q is a polynomial that interpolates the difference of the other terms from h.
    Differentiable in x.
    """
    shift = _SHIFT if x.dtype == torch.float64 else 1
    above = x - c
    lift = above / (x + shift)
    if shift == 1:
        slopes = _evaluate(_interpolated(c), lift)
        whole = lift * (1 / c)
    else:
        rise, slope, series = _polynomials(c)
        rest = _evaluate(rise, lift) * lift
        product = 1 + rest
        whole = torch.addcmul(rest, product, lift, value=shift / c)
        slopes = torch.addcdiv(_evaluate(series, lift), _evaluate(slope, lift), product, value=-1)
    # Near x = 0, where c/x dominates, rounding could make this the logarithm of 0.
    whole = whole.clamp(min=torch.finfo(x.dtype).eps - 1).log1p_()
    value = torch.addcdiv(torch.addcmul(whole, slopes, lift), above, x, value=-1).add_(above)
    return value if c == 0.5 else value.add_((above / (c + shift)).log1p(), alpha=0.5 - c)


def _evaluate(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    """Value of a polynomial, coefficients constant first."""
    *others, value = (x.new_full((), coefficient) for coefficient in coefficients)
    for coefficient in reversed(others):
        value = torch.addcmul(coefficient, value, x)  # a constant that is a tensor saves a pass over x
    return value


def _polynomials(c: float) -> tuple[tuple[float, ...], ...]:
    """Coefficients of (P - 1) / g, (1 - g) P' and Q."""
    return _expand(c)


def _interpolated(c: float) -> tuple[float, ...]:
    """Coefficients of Q for n = 1; the error of g Q is below 3e-8 of h + |x - c|."""
    return _interpolate(c)


# This is all that `torch.compiler.assume_constant_result` does. Calling it would import the compiler, which takes a
# second even for users who compile nothing.
_polynomials._dynamo_marked_constant = True  # type: ignore[attr-defined]
_interpolated._dynamo_marked_constant = True  # type: ignore[attr-defined]


@lru_cache
def _expand(c: float) -> tuple[tuple[float, ...], ...]:
    fall, none = Polynomial([1.0, -1.0]), Polynomial([0.0])
    product = prod((Polynomial([1.0, (_SHIFT - i) / (c + i)]) for i in range(1, _SHIFT)), start=none + 1)
    inverse = fall / (c + _SHIFT)
    series = sum(
        (b * inverse ** (2 * k + 1) * Polynomial([1 / (2 * k + 1), 1.0]) for k, b in enumerate(_STIRLING)), start=none
    )
    rest = -series.coef[1:]
    rest[0] -= _SHIFT - 0.5
    return tuple(product.coef[1:].tolist()), tuple((fall * product.deriv()).coef.tolist()), tuple(rest.tolist())


@lru_cache
def _interpolate(c: float) -> tuple[float, ...]:
    def rest(lift: NDArray[np.float64]) -> NDArray[np.float64]:
        x = (c + lift) / (1 - lift)
        others = (x - c) * (1 - 1 / x) + np.log1p(lift / c) + (0.5 - c) * np.log1p((x - c) / (c + 1))
        return log_gamma_divergence(torch.from_numpy(x), c).numpy() - others

    # g Q(g) is 0 at 0, where the slopes of the other terms sum to 1/2 for every c.
    series = Chebyshev.interpolate(rest, 8, [-c, 1]).convert(kind=Polynomial)
    return (-0.5, *series.coef[2:].tolist())

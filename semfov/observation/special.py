"""Special functions that torch lacks."""

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.sensor.constants import mark_constant

# B_2k / 2k for k = 1, 2, … The error of these terms is below 1e-15 for arguments from `_SHIFT`.
_STIRLING = (1 / 12, -1 / 120, 1 / 252, -1 / 240, 1 / 132, -691 / 32760, 1 / 12, -3617 / 8160)
_SHIFT = 8


def log_gamma_divergence(x: Tensor, c: float) -> Tensor:
    r"""Compute the Bregman divergence of ln Γ: the height of ln Γ at c above its tangent at x, for positive numbers.

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

    Args:
        x: `(...)`, positive.
        c: a positive number.

    Returns:
        h, `(...)`.
    """
    shift = _SHIFT if x.dtype == torch.float64 else 1
    above = x - c
    lift = above / (x + shift)
    if shift == 1:
        slopes = _evaluate(_interpolated(c), lift)
        excess = lift * (1 / c)
    else:
        rise, slope, series = _polynomials(c)
        rest = _evaluate(rise, lift) * lift
        product = 1 + rest
        excess = torch.addcmul(rest, product, lift, value=shift / c)
        slopes = torch.addcdiv(_evaluate(series, lift), _evaluate(slope, lift), product, value=-1)
    # Near x = 0, where c/x dominates, rounding could make this the logarithm of 0.
    logarithm = excess.clamp(min=torch.finfo(x.dtype).eps - 1).log1p_()
    value = torch.addcdiv(torch.addcmul(logarithm, slopes, lift), above, x, value=-1).add_(above)
    return value if c == 0.5 else value.add_((above / (c + shift)).log1p(), alpha=0.5 - c)


def _evaluate(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    """Evaluate a polynomial, coefficients constant first, by Horner's scheme."""
    # A constant that is a tensor saves a pass over x.
    *lower, value = (x.new_full((), coefficient) for coefficient in coefficients)
    for coefficient in reversed(lower):
        value = torch.addcmul(coefficient, value, x)
    return value


def _polynomials(c: float) -> tuple[tuple[float, ...], ...]:
    """Give the coefficients of (P - 1) / g, (1 - g) P' and Q."""
    return _expand(c)


def _interpolated(c: float) -> tuple[float, ...]:
    """Give the coefficients of Q for n = 1; the error of g Q is below 3e-8 of h + |x - c|."""
    return _interpolate(c)


mark_constant(_polynomials)
mark_constant(_interpolated)


@lru_cache
def _expand(c: float) -> tuple[tuple[float, ...], ...]:
    """Expand P, P' and Stirling's series in powers of g (`_polynomials`)."""
    from numpy.polynomial import Polynomial

    fall = Polynomial([1.0, -1.0])  # 1 - g
    product = Polynomial([1.0])  # P
    for i in range(1, _SHIFT):
        product = product * Polynomial([1.0, (_SHIFT - i) / (c + i)])
    inverse = fall / (c + _SHIFT)  # 1 / (x + n)
    series = Polynomial([0.0])
    for k, term in enumerate(_STIRLING):
        series = series + term * inverse ** (2 * k + 1) * Polynomial([1 / (2 * k + 1), 1.0])
    # The first coefficients are the values at c, where g is 0: they cancel in h.
    rise = product.coef[1:]
    slope = (fall * product.deriv()).coef
    rest = -series.coef[1:]
    rest[0] -= _SHIFT - 0.5
    return tuple(rise.tolist()), tuple(slope.tolist()), tuple(rest.tolist())


@lru_cache
def _interpolate(c: float) -> tuple[float, ...]:
    """Interpolate what single precision replaces by a polynomial (`_interpolated`)."""
    from numpy.polynomial import Chebyshev, Polynomial

    def rest(lift: NDArray[np.float64]) -> NDArray[np.float64]:
        """Subtract all other terms of h from h, at values of g."""
        x = (c + lift) / (1 - lift)
        linear = (x - c) * (1 - 1 / x)
        terms = linear + np.log1p(lift / c) + (0.5 - c) * np.log1p((x - c) / (c + 1))
        divergence = log_gamma_divergence(torch.from_numpy(x), c).numpy()
        return divergence - terms

    # g Q(g) is 0 at 0, where the slopes of the other terms sum to 1/2 for every c.
    series = Chebyshev.interpolate(rest, 8, [-c, 1]).convert(kind=Polynomial)
    return (-0.5, *series.coef[2:].tolist())

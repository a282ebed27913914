"""Special functions that torch lacks."""

from functools import lru_cache
from math import prod

import torch
from numpy.polynomial import Polynomial
from torch import Tensor

# B_2k / 2k for k = 1, 2, … The error of three terms is below 3e-8 for arguments from 4, of eight below 1e-15 from 8.
_STIRLING = (1 / 12, -1 / 120, 1 / 252, -1 / 240, 1 / 132, -691 / 32760, 1 / 12, -3617 / 8160)


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

    g Q(g) is Stirling's series minus its value at c, minus (n - 1/2) g. Differentiable in x.
    """
    shift, terms = (8, 8) if x.dtype == torch.float64 else (4, 3)
    rise, slope, series = _polynomials(c, shift, terms)
    above = x - c
    lift = above / (x + shift)
    rest = _evaluate(rise, lift).mul_(lift)
    product = 1 + rest
    # Near x = 0, where c/x dominates, rounding could make this the logarithm of 0.
    whole = torch.addcmul(rest, product, lift, value=shift / c).clamp(min=torch.finfo(x.dtype).eps - 1).log1p()
    slopes = torch.addcdiv(_evaluate(series, lift), _evaluate(slope, lift), product, value=-1)
    value = torch.addcdiv(torch.addcmul(whole, slopes, lift), above, x, value=-1).add_(above)
    return value if c == 0.5 else value.add_((above / (c + shift)).log1p(), alpha=0.5 - c)


def _evaluate(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    """Value of a polynomial, coefficients constant first; in place, because allocation costs more than the sums."""
    value = x * coefficients[-1]
    for coefficient in coefficients[-2:0:-1]:
        value = value.add_(coefficient).mul_(x)
    return value.add_(coefficients[0])


def _polynomials(c: float, shift: int, terms: int) -> tuple[tuple[float, ...], ...]:
    """Coefficients of (P - 1) / g, (1 - g) P' and Q."""
    return _expand(c, shift, terms)


# This is all that `torch.compiler.assume_constant_result` does. Calling it would import the compiler, which takes a
# second even for users who compile nothing.
_polynomials._dynamo_marked_constant = True  # type: ignore[attr-defined]


@lru_cache
def _expand(c: float, shift: int, terms: int) -> tuple[tuple[float, ...], ...]:
    fall, none = Polynomial([1.0, -1.0]), Polynomial([0.0])
    product = prod((Polynomial([1.0, (shift - i) / (c + i)]) for i in range(1, shift)), start=none + 1)
    inverse = fall / (c + shift)
    series = sum(
        (_STIRLING[k] * inverse ** (2 * k + 1) * Polynomial([1 / (2 * k + 1), 1.0]) for k in range(terms)), start=none
    )
    rest = -series.coef[1:]
    rest[0] -= shift - 0.5
    return tuple(product.coef[1:].tolist()), tuple((fall * product.deriv()).coef.tolist()), tuple(rest.tolist())

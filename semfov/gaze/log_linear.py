"""Log-linear choices: maximum likelihood of which of several alternatives was taken."""

import torch
from torch import Tensor

from semfov.errors import DataError, InputError, check, check_shape

_STEPS, _TOLERANCE = 100, 1e-9


def fit_log_linear(features: Tensor, chosen: Tensor, *, ridge: float = 1.0, chunk: int = 2048) -> Tensor:
    r"""Weights under which what was chosen is likeliest, `(F,)`, by Newton's method in double precision.

    .. math:: \max_w \sum_n \ln \frac{e^{w \cdot \phi_n(x_n)}}{\sum_x e^{w \cdot \phi_n(x)}} - \frac{\rho}{2} \|w\|^2

    (Conditional logit, McFadden, 1974.) The sum is concave, so there is one maximum. The ridge settles weights that
    the choices do not tell, such as a constant added to all bins of a table, and keeps weights of what never happened
    finite.

    Args:
        features: `(n, A, F)`, φ of every alternative of every choice.
        chosen: `(n,)`, index of the alternative taken.
        ridge: ρ, positive.
        chunk: choices that are taken at a time.

    Raises:
        DataError: it does not converge.

    >>> features = torch.eye(2).expand(10, 2, 2)
    >>> weights = fit_log_linear(features, torch.tensor([0] * 8 + [1] * 2), ridge=1e-6)
    >>> (weights[0] - weights[1]).exp()
    tensor(4.0000, dtype=torch.float64)
    """
    check_shape(features, "features", None, None, None)
    check_shape(chosen, "chosen", len(features))
    check(len(features) > 0, "features", "at least one choice", 0)
    check(ridge > 0, "ridge", "a positive number", ridge)
    weights = torch.zeros(features.shape[-1], dtype=torch.float64, device=features.device)
    value, slope, curvature = _derivatives(features, chosen, weights, ridge, chunk)
    for _ in range(_STEPS):
        step = torch.linalg.solve(curvature, slope)
        if float(step @ slope) <= _TOLERANCE * (1 + abs(value)):
            return weights + step
        size = 1.0
        # Newton's step may be too long far from the maximum; a part of it always gains.
        while True:
            moved = weights + size * step
            there = _derivatives(features, chosen, moved, ridge, chunk)
            if there[0] >= value or size < 1e-8:
                break
            size /= 2
        weights, (value, slope, curvature) = moved, there
    raise DataError(f"the fit of choices did not converge in {_STEPS} steps; give more choices, or a larger ridge")


def log_probability(features: Tensor, chosen: Tensor, weights: Tensor, *, chunk: int = 2048) -> Tensor:
    """Log probability of each choice under a log-linear model, `(n,)` in nats and double precision.

    Args:
        features: `(n, A, F)`.
        chosen: `(n,)`.
        weights: `(F,)`.
        chunk: choices that are taken at a time.
    """
    if features.shape[-1] != len(weights):
        raise InputError(f"weights: expected {features.shape[-1]} numbers, got {len(weights)}")
    told = []
    for some, taken in zip(features.split(chunk), chosen.split(chunk), strict=True):
        told.append((some.double() @ weights).log_softmax(-1).gather(-1, taken[:, None])[:, 0])
    return torch.cat(told)


def _derivatives(
    features: Tensor, chosen: Tensor, weights: Tensor, ridge: float, chunk: int
) -> tuple[float, Tensor, Tensor]:
    """The penalised log likelihood, its gradient, and its Hessian with the sign turned."""
    value = -0.5 * ridge * float(weights @ weights)
    slope = -ridge * weights
    curvature = ridge * torch.eye(len(weights), dtype=weights.dtype, device=weights.device)
    for some, taken in zip(features.split(chunk), chosen.split(chunk), strict=True):
        phi = some.double()
        log = (phi @ weights).log_softmax(-1)
        value += float(log.gather(-1, taken[:, None]).sum())
        p = log.exp()[..., None]
        mean = (p * phi).sum(1)
        own = phi.take_along_dim(taken[:, None, None], 1)[:, 0]
        slope = slope + (own - mean).sum(0)
        apart = (phi - mean[:, None]) * p.sqrt()
        flat = apart.flatten(0, 1)
        curvature = curvature + flat.t() @ flat
    return value, slope, curvature

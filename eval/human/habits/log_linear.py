"""Log-linear choice models, fitted by maximum likelihood to which of several alternatives was chosen."""

import torch
from torch import Tensor

from semfov.errors import DataError, InputError, check, check_shape

_STEPS, _TOLERANCE = 100, 1e-9


def fit_log_linear(features: Tensor, chosen: Tensor, *, ridge: float = 1.0, chunk: int = 2048) -> Tensor:
    r"""Fit the weights of a log-linear choice model by maximum likelihood (conditional logit; McFadden, 1974).

    .. math:: \max_w \sum_n \ln \frac{e^{w \cdot \phi_n(x_n)}}{\sum_x e^{w \cdot \phi_n(x)}} - \frac{\rho}{2} \|w\|^2

    Newton's method in double precision. The sum is concave, so there is one maximum. The ridge ρ determines weights
    that the data leave open, such as a constant added to all bins of a table. It also keeps weights finite for
    alternatives that were never chosen.

    Args:
        features: `(n, A, F)`, φ, the F features of each of A alternatives in n choices.
        chosen: `(n,)`, index of the alternative chosen.
        ridge: ρ, positive.
        chunk: number of choices to compute at a time.

    Returns:
        `(F,)`, the weights w, float64.

    Raises:
        InputError: there is no choice, the shapes do not fit together, or the ridge is not positive.
        DataError: the fit does not converge.

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
        # Far from the maximum Newton's step may be too long; a short enough part of it always raises the value.
        while True:
            moved = weights + size * step
            there = _derivatives(features, chosen, moved, ridge, chunk)
            if there[0] >= value or size < 1e-8:
                break
            size /= 2
        weights, (value, slope, curvature) = moved, there
    raise DataError(f"the fit did not converge in {_STEPS} steps; give more choices, or a larger `ridge`")


def log_probability(features: Tensor, chosen: Tensor, weights: Tensor, *, chunk: int = 2048) -> Tensor:
    """Log probability of each choice under a log-linear model.

    >>> log_probability(torch.eye(2)[None], torch.tensor([0]), torch.zeros(2).double()).exp()
    tensor([0.5000], dtype=torch.float64)

    Shapes: features `(n, A, F)`, chosen `(n,)`, weights `(F,)` → `(n,)`.
    """
    if features.shape[-1] != len(weights):
        raise InputError(f"weights: expected {features.shape[-1]} numbers, one a feature, got {len(weights)}")
    logs = []
    for some, choice in zip(features.split(chunk), chosen.split(chunk), strict=True):
        logs.append((some.double() @ weights).log_softmax(-1).gather(-1, choice[:, None])[:, 0])
    return torch.cat(logs)


def _derivatives(
    features: Tensor, chosen: Tensor, weights: Tensor, ridge: float, chunk: int
) -> tuple[float, Tensor, Tensor]:
    """The penalised log likelihood, its gradient, and its negative Hessian."""
    value = -0.5 * ridge * float(weights @ weights)
    slope = -ridge * weights
    curvature = ridge * torch.eye(len(weights), dtype=weights.dtype, device=weights.device)
    for some, choice in zip(features.split(chunk), chosen.split(chunk), strict=True):
        phi = some.double()
        log = (phi @ weights).log_softmax(-1)
        value += float(log.gather(-1, choice[:, None]).sum())
        p = log.exp()[..., None]
        mean = (p * phi).sum(1)
        own = phi.take_along_dim(choice[:, None, None], 1)[:, 0]
        slope = slope + (own - mean).sum(0)
        apart = (phi - mean[:, None]) * p.sqrt()
        flat = apart.flatten(0, 1)
        curvature = curvature + flat.t() @ flat
    return value, slope, curvature

"""From maps to a density of the next fixation, with the same few weights for every model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.errors import check

FLAT = 1e-6
"""Maps with a smaller standard deviation hold nothing."""


@dataclass(frozen=True)
class Weights:
    """Of the terms of a density.

    Attributes:
        terms: names of the terms.
        values: `(T,)`.
        blur: of the maps, in bins.
        bits: mean log likelihood of the fitted fixations, above a uniform density.
    """

    terms: tuple[str, ...]
    values: Tensor
    blur: float
    bits: float


def standardised(maps: Tensor) -> Tensor:
    """Maps `(E, H, W)` with mean 0 and standard deviation 1; 0 where a map is the same everywhere."""
    centred = maps - maps.mean((-1, -2), keepdim=True)
    deviation = centred.square().mean((-1, -2), keepdim=True).sqrt()
    return torch.where(deviation > FLAT * maps.abs().amax((-1, -2), keepdim=True), centred / deviation, 0.0)


def log_densities(terms: Sequence[Tensor], weights: Tensor) -> Tensor:
    r"""Log density of the next fixation over the bins, `(E, H, W)`.

    .. math:: \ln p(u) = \sum_t w_t f_t(u) - \ln \sum_v e^{\sum_t w_t f_t(v)}

    Args:
        terms: maps `(E, H, W)` or `(1, H, W)`.
        weights: `(T,)`.
    """
    total = sum((weight * term for weight, term in zip(weights, terms, strict=True)), torch.zeros(()))
    return total - total.logsumexp((-1, -2), keepdim=True)


def fit(names: Sequence[str], terms: Sequence[Tensor], bins: Tensor, blur: float = 0.0) -> Weights:
    """Weights of the largest likelihood: a concave problem, solved by L-BFGS from zero.

    Args:
        names: of the terms.
        terms: maps `(E, H, W)` or `(1, H, W)`.
        bins: `(E, 2)`, column and row of the fixations.
        blur: that the maps were blurred by; it is written down.
    """
    check(len(names) == len(terms) > 0, "terms", f"{len(names)} maps, at least one", len(terms))
    weights = torch.zeros(len(terms), requires_grad=True)
    optimiser = torch.optim.LBFGS([weights], max_iter=30, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        cost = -at(log_densities(terms, weights), bins).mean()
        cost.backward()
        return cost

    optimiser.step(loss)
    with torch.no_grad():
        likelihood = float(at(log_densities(terms, weights), bins).mean())
    size = terms[0].shape[-1] * terms[0].shape[-2]
    return Weights(tuple(names), weights.detach(), blur, (likelihood + math.log(size)) / math.log(2))


def at(maps: Tensor, bins: Tensor) -> Tensor:
    """Values of maps `(E, H, W)` in bins `(E, 2)`, `(E,)`."""
    return maps.expand(len(bins), -1, -1)[torch.arange(len(bins)), bins[:, 1], bins[:, 0]]

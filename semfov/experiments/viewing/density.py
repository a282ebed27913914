"""From maps to a density of the next fixation, with the same few weights for every model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.errors import check
from semfov.gaze.habits import standardised as over_cells
from semfov.gaze.log_linear import fit_log_linear

RIDGE = 1e-3
"""Of the fit: nothing beside thousands of fixations, but it settles the weight of a map that is the same everywhere."""


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
    return over_cells(maps.flatten(-2)).view_as(maps)


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
    """Weights of the largest likelihood (`semfov.gaze.log_linear`).

    Args:
        names: of the terms.
        terms: maps `(E, H, W)` or `(1, H, W)`.
        bins: `(E, 2)`, column and row of the fixations.
        blur: that the maps were blurred by; it is written down.
    """
    check(len(names) == len(terms) > 0, "terms", f"{len(names)} maps, at least one", len(terms))
    height, width = terms[0].shape[-2:]
    features = torch.stack([term.expand(len(bins), -1, -1).flatten(1) for term in terms], -1)
    weights = fit_log_linear(features, bins[:, 1] * width + bins[:, 0], ridge=RIDGE).to(features)
    with torch.no_grad():
        likelihood = float(at(log_densities(terms, weights), bins).mean())
    return Weights(tuple(names), weights, blur, (likelihood + math.log(height * width)) / math.log(2))


def at(maps: Tensor, bins: Tensor) -> Tensor:
    """Values of maps `(E, H, W)` in bins `(E, 2)`, `(E,)`."""
    return maps.expand(len(bins), -1, -1)[torch.arange(len(bins)), bins[:, 1], bins[:, 0]]

"""Turns maps into a density of the next fixation, with the same kinds of weights for every model."""

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
"""Ridge penalty of the fit.

It is negligible against thousands of fixations, but it determines the weight of a map that is constant.
"""


@dataclass(frozen=True)
class DensityWeights:
    """Weights of the terms of a density.

    Attributes:
        terms: names of the terms.
        values: `(T,)`, their weights.
        blur: standard deviation of the maps' blur, in bins.
        bits: mean log likelihood of the fitted fixations in bits, relative to a uniform density.
    """

    terms: tuple[str, ...]
    values: Tensor
    blur: float
    bits: float


def standardised_maps(maps: Tensor) -> Tensor:
    """Standardise maps `(E, H, W)` to mean 0 and standard deviation 1; a constant map becomes 0."""
    return over_cells(maps.flatten(-2)).view_as(maps)


def log_densities(terms: Sequence[Tensor], weights: Tensor) -> Tensor:
    r"""Log density of the next fixation over the bins, `(E, H, W)`.

    .. math:: \ln p(u) = \sum_t w_t f_t(u) - \ln \sum_v e^{\sum_t w_t f_t(v)}

    Args:
        terms: the T terms, maps `(E, H, W)` or `(1, H, W)`.
        weights: `(T,)`, their weights.

    Returns:
        `(E, H, W)`, the log density for each of E fixations.
    """
    total = sum((weight * term for weight, term in zip(weights, terms, strict=True)), torch.zeros(()))
    return total - total.logsumexp((-1, -2), keepdim=True)


def fit_density(names: Sequence[str], terms: Sequence[Tensor], bins: Tensor, blur: float = 0.0) -> DensityWeights:
    """Fit the weights of a density by maximum likelihood (`semfov.gaze.log_linear`).

    Args:
        names: names of the terms.
        terms: maps `(E, H, W)` or `(1, H, W)`.
        bins: `(E, 2)`, column and row of the bin of each fixation.
        blur: standard deviation of the blur that was applied to the maps, for the record.

    Returns:
        The fitted weights.
    """
    check(len(names) == len(terms) > 0, "terms", f"{len(names)} maps, at least one", len(terms))
    height, width = terms[0].shape[-2:]
    features = torch.stack([term.expand(len(bins), -1, -1).flatten(1) for term in terms], -1)
    weights = fit_log_linear(features, bins[:, 1] * width + bins[:, 0], ridge=RIDGE).to(features)
    with torch.no_grad():
        likelihood = float(values_in_bins(log_densities(terms, weights), bins).mean())
    return DensityWeights(tuple(names), weights, blur, (likelihood + math.log(height * width)) / math.log(2))


def values_in_bins(maps: Tensor, bins: Tensor) -> Tensor:
    """Values `(E,)` of maps `(E, H, W)` in the bins `(E, 2)`."""
    return maps.expand(len(bins), -1, -1)[torch.arange(len(bins)), bins[:, 1], bins[:, 0]]

"""How well maps foretell single fixations: each map is given what was fixated before (Kümmerer and Bethge, 2021).

Maps are `(..., H, W)` and fixations `(..., n)`: n fixations to each map. A figure of merit is `(..., n)`, one for each
fixation; average fixations of a person, then people, then pictures, as the study asks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.errors import check

Array = NDArray[np.float64]


def nss(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> Array:
    r"""Normalised scanpath saliency (Peters et al., 2005): standard deviations above its mean that the map has there.

    .. math:: \frac{s(x, y) - \bar s}{\sigma_s}

    0 where the map is the same everywhere, as in pysaliency. (Ruarte et al., 2025, count values below the mean as 0.)

    Args:
        maps: `(..., H, W)`, densities or saliency.
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`.

    >>> nss([[0.0, 0.0], [0.0, 1.0]], [1], [1])
    array([1.73205081])
    """
    values, at = looked_up(maps, x, y)
    flat = values.reshape(*values.shape[:-2], -1)
    # Of equal values the mean may differ from them by rounding, and so may the deviation from 0.
    even = (np.ptp(flat, axis=-1) == 0)[..., None]
    deviation = np.where(even, 1, flat.std(-1)[..., None])
    return np.where(even, 0, (at - flat.mean(-1)[..., None]) / deviation)


def auc(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> Array:
    r"""Area under the curve for single fixations: the share of pixels with a lower value, ties counted half.

    .. math:: P(s(u) < s(x, y)) + \tfrac12 P(s(u) = s(x, y)), \quad u \text{ uniform over the pixels}

    Of Kümmerer and Bethge (2021), with all pixels as negatives, as in pysaliency (`nonfixations="uniform"`).

    Args:
        maps: `(..., H, W)`.
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`.

    >>> auc([[0.0, 1.0], [2.0, 3.0]], [1], [1])
    array([0.875])
    """
    values, at = looked_up(maps, x, y)
    flat = np.sort(values.reshape(-1, values.shape[-1] * values.shape[-2]), axis=-1)
    found = at.reshape(len(flat), -1)
    return np.reshape([share_below(row, each) for row, each in zip(flat, found, strict=True)], at.shape)


def share_below(ordered: Array, values: Array) -> Array:
    """Share of ascending numbers that are lower than each of the values, ties counted half.

    >>> share_below(np.array([1.0, 2.0, 2.0, 3.0]), np.array([2.0]))
    array([0.5])
    """
    twice = np.searchsorted(ordered, values) + np.searchsorted(ordered, values, side="right")
    return np.asarray(twice / (2 * len(ordered)))


def log_density(maps: ArrayLike, floor: float = 0.0) -> Array:
    r"""Natural logarithms of maps made densities over their pixels: each is divided by its sum.

    .. math:: \ln\left( (1 - \epsilon) \frac{s}{\sum s} + \frac{\epsilon}{HW} \right)

    Args:
        maps: `(..., H, W)`, from 0, not all 0.
        floor: ε, share of a uniform density in the mixture; without it, pixels of 0 have no chance (-inf).
    """
    values = np.asarray(maps, dtype=np.float64)
    total = values.sum((-1, -2), keepdims=True)
    usable = bool((values >= 0).all() and np.isfinite(total).all() and (total > 0).all())
    check(usable, "maps", "numbers from 0, not all of them 0", "others")
    with np.errstate(divide="ignore"):
        return np.asarray(np.log((1 - floor) * values / total + floor / (values.shape[-1] * values.shape[-2])))


def log_likelihood(density: ArrayLike, x: ArrayLike, y: ArrayLike) -> Array:
    r"""Log likelihood of fixations in bits, above that of a uniform density (Kümmerer, Wallis and Bethge, 2015).

    .. math:: \log_2 p(x, y) + \log_2 HW

    Args:
        density: `(..., H, W)`, natural logarithms of densities over the pixels (`log_density`).
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`.

    >>> log_likelihood(log_density([[1.0, 1.0], [1.0, 5.0]]), [1], [1]).round(3)
    array([1.322])
    """
    values, at = looked_up(density, x, y)
    return np.asarray((at + np.log(values.shape[-1] * values.shape[-2])) / np.log(2))


def information_gain(density: ArrayLike, baseline: ArrayLike, x: ArrayLike, y: ArrayLike) -> Array:
    r"""Bits by which a density foretells fixations better than a baseline (Kümmerer, Wallis and Bethge, 2015).

    .. math:: \log_2 p(x, y) - \log_2 p_b(x, y)

    Args:
        density: `(..., H, W)`, natural logarithms of densities over the pixels (`log_density`).
        baseline: those of the baseline, usually a centre bias.
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`.
    """
    return log_likelihood(density, x, y) - log_likelihood(baseline, x, y)


def looked_up(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """The maps, and their values `(..., n)` at the pixels that fixations are in."""
    values = np.asarray(maps, dtype=np.float64)
    check(values.ndim >= 2 and values.size > 0, "maps", "(..., H, W)", values.shape)
    column, row = (np.floor(np.asarray(each, dtype=np.float64) + 0.5) for each in (x, y))
    leading = values.shape[:-2]
    fits = column.shape == row.shape and column.shape[:-1] == leading and column.ndim == len(leading) + 1
    check(fits, "x, y", f"fixations {(*leading, 'n')}", (column.shape, row.shape))
    height, width = values.shape[-2:]
    inside = bool(((column >= 0) & (column < width) & (row >= 0) & (row < height)).all())
    check(inside, "x, y", f"points inside a map of {width} × {height} pixels", "others")
    flat = values.reshape(*leading, -1)
    return values, np.take_along_axis(flat, (row * width + column).astype(np.int64), axis=-1)

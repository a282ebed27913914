"""How well maps predict single fixations: each map is given the fixations before (Kümmerer and Bethge, 2021).

Maps are `(..., H, W)` and fixations `(..., n)`: n fixations for each map. A measure is `(..., n)`, one value for each
fixation. Average over the fixations of a person, then over people, then over pictures, as the study requires.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.data.fixations.record import as_array
from semfov.errors import check, check_number

_Array = NDArray[np.float64]


def nss(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> _Array:
    r"""Normalised scanpath saliency (Peters et al., 2005): z-score of the map at each fixation, over its pixels.

    .. math:: \frac{s(x, y) - \bar s}{\sigma_s}

    It is 0 where the map is constant, as in pysaliency. (Ruarte et al., 2025, count values below the mean as 0.)

    Args:
        maps: `(..., H, W)`, densities or saliency.
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`, of the same fixations.

    Returns:
        `(..., n)`, in standard deviations of the map.

    Raises:
        InputError: the shapes do not fit together, or a fixation lies outside its map.

    >>> nss([[0.0, 0.0], [0.0, 1.0]], [1], [1])
    array([1.73205081])
    """
    values, at = looked_up(maps, x, y)
    check(bool(np.isfinite(values).all()), "maps", "finite numbers", "infinity; give densities, not their logarithms")
    flat = values.reshape(*values.shape[:-2], -1)
    # By rounding the mean of equal values may differ from them, and their deviation from 0.
    even = (np.ptp(flat, axis=-1) == 0)[..., None]
    deviation = np.where(even, 1, flat.std(-1)[..., None])
    return np.where(even, 0, (at - flat.mean(-1)[..., None]) / deviation)


def auc(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> _Array:
    r"""Area under the ROC for single fixations: the fraction of pixels with a lower value; ties count half.

    .. math:: P(s(u) < s(x, y)) + \tfrac12 P(s(u) = s(x, y)), \quad u \text{ uniform over the pixels}

    Definition of Kümmerer and Bethge (2021), with all pixels as negatives, as in pysaliency
    (`nonfixations="uniform"`).

    Args:
        maps: `(..., H, W)`, densities or saliency.
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`, of the same fixations.

    Returns:
        `(..., n)`, from 0 to 1.

    Raises:
        InputError: the shapes do not fit together, or a fixation lies outside its map.

    >>> auc([[0.0, 1.0], [2.0, 3.0]], [1], [1])
    array([0.875])
    """
    values, at = looked_up(maps, x, y)
    flat = np.sort(values.reshape(-1, values.shape[-1] * values.shape[-2]), axis=-1)
    scores = at.reshape(len(flat), -1)
    return np.reshape([share_below(row, each) for row, each in zip(flat, scores, strict=True)], at.shape)


def share_below(ordered: _Array, values: _Array) -> _Array:
    """Fraction of ascending numbers that are lower than each of `values`; ties count half; values `(n,)` → `(n,)`.

    >>> share_below(np.array([1.0, 2.0, 2.0, 3.0]), np.array([2.0]))
    array([0.5])
    """
    twice = np.searchsorted(ordered, values) + np.searchsorted(ordered, values, side="right")
    return np.asarray(twice / (2 * len(ordered)))


def log_density(maps: ArrayLike, floor: float = 0.0) -> _Array:
    r"""Natural logarithm of maps that are normalised to densities over their pixels.

    .. math:: \ln\left( (1 - \epsilon) \frac{s}{\sum s} + \frac{\epsilon}{HW} \right)

    Args:
        maps: `(..., H, W)`, not negative; no map is 0 everywhere.
        floor: ε, weight of a uniform density in the mixture. With 0, a pixel of value 0 has probability 0, and its
            logarithm is -inf.

    Returns:
        `(..., H, W)`, log densities in nats.

    Raises:
        InputError: a map has negative or infinite values, or is 0 everywhere.

    >>> log_density([[1.0, 3.0]]).round(3)
    array([[-1.386, -0.288]])
    """
    check_number(floor, "floor", 0, 1)
    values = as_array(maps, "maps")
    check(values.ndim >= 2 and values.size > 0, "maps", "an array of shape (..., H, W), not empty", values.shape)
    total = values.sum((-1, -2), keepdims=True)
    usable = bool((values >= 0).all() and np.isfinite(total).all() and (total > 0).all())
    got = f"values from {values.min():g} to {values.max():g}, with sums from {total.min():g} to {total.max():g}"
    check(usable, "maps", "finite numbers of 0 or more, not all 0 in a map", got)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log((1 - floor) * values / total + floor / (values.shape[-1] * values.shape[-2])))


def log_likelihood(density: ArrayLike, x: ArrayLike, y: ArrayLike) -> _Array:
    r"""Log likelihood of fixations in bits, above that of a uniform density (Kümmerer, Wallis and Bethge, 2015).

    .. math:: \log_2 p(x, y) + \log_2 HW

    Args:
        density: `(..., H, W)`, natural logarithms of densities over the pixels (`log_density`).
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`, of the same fixations.

    Returns:
        `(..., n)`, in bits; 0 for a uniform density.

    Raises:
        InputError: the shapes do not fit together, or a fixation lies outside its map.

    >>> log_likelihood(log_density([[1.0, 1.0], [1.0, 5.0]]), [1], [1]).round(3)
    array([1.322])
    """
    values, at = looked_up(density, x, y)
    return np.asarray((at + np.log(values.shape[-1] * values.shape[-2])) / np.log(2))


def information_gain(density: ArrayLike, baseline: ArrayLike, x: ArrayLike, y: ArrayLike) -> _Array:
    r"""Information gain over a baseline density, in bits for each fixation (Kümmerer, Wallis and Bethge, 2015).

    .. math:: \log_2 p(x, y) - \log_2 p_b(x, y)

    Args:
        density: `(..., H, W)`, natural logarithms of densities over the pixels (`log_density`).
        baseline: `(..., H, W)`, natural logarithms of the baseline's densities, usually a centre bias.
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`, of the same fixations.

    Returns:
        `(..., n)`, in bits; positive where the density predicts the fixation better than the baseline.

    Raises:
        InputError: the shapes do not fit together, or a fixation lies outside its map.

    >>> information_gain(log_density([[1.0, 3.0]]), log_density([[1.0, 1.0]]), [1], [0]).round(3)
    array([0.585])
    """
    density, baseline = as_array(density, "density"), as_array(baseline, "baseline")
    ours, theirs = density.shape[-2:], baseline.shape[-2:]
    check(ours == theirs, "baseline", f"densities over {ours} pixels, as `density`", theirs)
    return log_likelihood(density, x, y) - log_likelihood(baseline, x, y)


def looked_up(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[_Array, _Array]:
    """Read maps at the pixels of fixations; maps `(..., H, W)`, x `(..., n)`, y `(..., n)` → `(..., n)`.

    >>> looked_up([[0.0, 1.0]], [0.6], [0.0])[1]
    array([1.])
    """
    values = as_array(maps, "maps")
    check(values.ndim >= 2 and values.size > 0, "maps", "an array of shape (..., H, W), not empty", values.shape)
    column, row = (np.floor(as_array(each, "x, y") + 0.5) for each in (x, y))
    leading = values.shape[:-2]
    fits = column.shape == row.shape and column.shape[:-1] == leading and column.ndim == len(leading) + 1
    check(fits, "x, y", f"arrays of shape {(*leading, 'n')}, one row for each map", (column.shape, row.shape))
    missing = int(np.isnan(values).sum())
    check(not missing, "maps", "numbers", f"NaN in {missing} of {values.size} pixels; replace them (numpy.nan_to_num)")
    height, width = values.shape[-2:]
    outside = ~((column >= 0) & (column < width) & (row >= 0) & (row < height))
    got = f"{int(outside.sum())} of {outside.size} outside it; remove them, or scale them to pixels of the map"
    check(not bool(outside.any()), "x, y", f"points inside a map of {width} × {height} pixels", got)
    flat = values.reshape(*leading, -1)
    return values, np.take_along_axis(flat, (row * width + column).astype(np.int64), axis=-1)

"""Measures that compare a picture's saliency map or density with people's fixations, or their density."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.data.fixations.record import as_array
from semfov.errors import check, check_number, check_whole

_Array = NDArray[np.float64]

_ROUNDING = 0.01  # what rounding may do to the sum of a density


def auc_judd(saliency: ArrayLike, x: ArrayLike, y: ArrayLike) -> float:
    """Compute the area under the ROC of Judd et al. (2009), as the MIT benchmark does (Bylinskii et al., 2019).

    Thresholds are the values at the fixations. Hits are counted over fixations, and false alarms over the pixels that
    nobody fixated. The corners (0, 0) and (1, 1) are added, and the curve is joined by straight lines. The benchmark's
    random jitter is left out, as in `pysaliency` with `jitter=False`.

    Args:
        saliency: `(H, W)`, the map.
        x: `(n,)`, of all fixations, in pixels of the map.
        y: `(n,)`, of the same fixations.

    Returns:
        The area, from 0 to 1.

    Raises:
        InputError: there is no fixation, none of the pixels is free of fixations, or a fixation lies outside the map.

    >>> auc_judd([[0.0, 0.1], [0.2, 0.9]], [1], [1])
    1.0
    """
    values, fixated = _looked_up(saliency, x, y)
    got = values.shape, fixated.shape
    check(values.ndim == 2 and fixated.size > 0, "saliency", "one map and at least one fixation", got)
    is_free = np.ones(values.shape, dtype=bool)
    row = _pixels(y).astype(int)
    column = _pixels(x).astype(int)
    is_free[row, column] = False
    background = np.sort(values[is_free])
    check(len(background) > 0, "saliency", "at least one pixel that nobody fixated", "none")
    ascending = np.sort(fixated)
    thresholds = ascending[::-1]
    hits = 1 - np.searchsorted(ascending, thresholds) / len(fixated)
    alarms = 1 - np.searchsorted(background, thresholds) / len(background)
    return float(np.trapezoid([0, *hits, 1], [0, *alarms, 1]))


def auc_shuffled(saliency: ArrayLike, x: ArrayLike, y: ArrayLike, other_x: ArrayLike, other_y: ArrayLike) -> float:
    """Compute the shuffled area under the ROC (Tatler, Baddeley and Gilchrist, 2005; Zhang et al., 2008).

    The negatives are fixations of other pictures, so a centre bias gains nothing. Over all pairs, as in pysaliency:

    .. math:: P(s_+ > s_-) + P(s_+ = s_-)/2

    Args:
        saliency: `(H, W)`, the map.
        x: `(n,)`, of all fixations of this picture, in pixels of the map.
        y: `(n,)`, of the same fixations.
        other_x: `(m,)`, of fixations of other pictures, in the same pixels.
        other_y: `(m,)`, of the same fixations.

    Returns:
        The area, from 0 to 1.

    Raises:
        InputError: fixations of this picture or of others are missing, or one lies outside the map.

    >>> auc_shuffled([[0.0, 0.1], [0.2, 0.9]], [1], [1], [0, 1], [1, 1])
    0.75
    """
    hits = _looked_up(saliency, x, y)[1]  # (n,)
    others = np.sort(_looked_up(saliency, other_x, other_y)[1])  # (m,), ascending as `_share_below` needs them
    check(hits.size > 0 and others.size > 0, "x, other_x", "fixations of this picture and of others", "none")
    return float(_share_below(others, hits).mean())


def auc_borji(saliency: ArrayLike, x: ArrayLike, y: ArrayLike, *, draws: int = 100, seed: int = 0) -> float:
    """Compute the area under the ROC against as many pixels drawn uniformly (Borji, Tavakoli, Sihite and Itti, 2013).

    The mean of several draws; its expectation is the mean of `auc`.

    Args:
        saliency: `(H, W)`, the map.
        x: `(n,)`, of all fixations, in pixels of the map.
        y: `(n,)`, of the same fixations.
        draws: number of draws.
        seed: seed of the draws.

    Returns:
        From 0 to 1.

    Raises:
        InputError: the shapes do not fit together, a fixation lies outside, or there is none.

    >>> auc_borji([[0.0, 1.0], [2.0, 3.0]], [1], [1], draws=2000).__round__(1)
    0.9
    """
    values, fixated = _looked_up(saliency, x, y)
    check(fixated.size > 0, "x, y", "at least one fixation", "none")
    check_whole(draws, "draws", 1, 1_000_000)
    check_whole(seed, "seed", 0, 2**63 - 1)
    # With repeats, as the authors draw pixels.
    samples = np.random.default_rng(seed).choice(values.reshape(-1), (draws, fixated.size))
    areas = [_share_below(np.sort(sample), fixated.reshape(-1)).mean() for sample in samples]
    return float(np.mean(areas))


def correlation(first: ArrayLike, second: ArrayLike) -> _Array:
    """Compute the linear correlation of two maps over pixels, CC (Le Meur et al., 2007; Bylinskii et al., 2019).

    Args:
        first: `(..., H, W)`.
        second: of the same shape.

    Returns:
        `(...)`, from -1 to 1; 0 where a map is constant.

    Raises:
        InputError: the shapes differ, or a map has NaN or infinite values.

    >>> correlation([[0.0, 1.0]], [[2.0, 4.0]])
    array(1.)
    """
    one, other = _pair(first, second)
    for values in (one, other):
        missing = int((~np.isfinite(values)).sum())
        got = f"NaN or infinity in {missing} of {values.size} pixels; replace them (numpy.nan_to_num)"
        check(missing == 0, "maps", "finite numbers", got)
    one = one - one.mean(-1, keepdims=True)  # (..., H·W)
    other = other - other.mean(-1, keepdims=True)
    covariance = (one * other).sum(-1)  # times the number of pixels, as the spread is
    spread = np.sqrt((one**2).sum(-1) * (other**2).sum(-1))
    has_spread = spread > 0
    ratio = covariance / np.where(has_spread, spread, 1)
    return np.asarray(np.where(has_spread, ratio, 0.0))


def similarity(first: ArrayLike, second: ArrayLike) -> _Array:
    r"""Compute the intersection of two densities, SIM (Judd, Durand and Torralba, 2012).

    .. math:: \sum_u \min(p(u), q(u))

    Args:
        first: `(..., H, W)`, not negative; it is normalised.
        second: of the same shape.

    Returns:
        `(...)`, from 0 to 1.

    Raises:
        InputError: the shapes differ, or a map has negative values or none above 0.

    >>> similarity([[1.0, 0.0]], [[1.0, 1.0]])
    array(0.5)
    """
    return np.asarray(np.minimum(*_densities(first, second)).sum(-1))


def kullback_leibler(people: ArrayLike, model: ArrayLike) -> _Array:
    r"""Compute the Kullback-Leibler divergence of a model's density from that of people.

    .. math:: \sum_u q(u) \ln (q(u) / p(u))

    Without the small constants that some programs add (Bylinskii et al., 2019, section 3.2).

    Args:
        people: `(..., H, W)`, q, not negative; it is normalised.
        model: p, of the same shape.

    Returns:
        `(...)`, in nats; infinite where the model has 0 and people do not.

    Raises:
        InputError: the shapes differ, or a map has negative values or none above 0.

    >>> float(kullback_leibler([[1.0, 0.0]], [[1.0, 1.0]]).round(3))
    0.693
    """
    q, p = _densities(people, model)
    # Where q is 0 the term is 0, whatever p is, though its logarithms are infinite.
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(q > 0, q * (np.log(q) - np.log(p)), 0.0)
    return np.asarray(terms.sum(-1))


def _pair(first: ArrayLike, second: ArrayLike) -> tuple[_Array, _Array]:
    """Take two maps of one shape, with their pixels along the last axis."""
    one = as_array(first, "maps")
    other = as_array(second, "maps")
    is_pair = one.shape == other.shape and one.ndim >= 2 and one.size > 0
    check(is_pair, "maps", "two of one shape (..., H, W)", (one.shape, other.shape))
    return one.reshape(*one.shape[:-2], -1), other.reshape(*other.shape[:-2], -1)


def _densities(first: ArrayLike, second: ArrayLike) -> tuple[_Array, _Array]:
    """Normalise two maps of one shape to densities, with their pixels along the last axis."""
    one, other = _pair(first, second)
    for values in (one, other):
        is_usable = bool((values >= 0).all() and np.isfinite(values).all() and (values.sum(-1) > 0).all())
        got = f"from {values.min():g} to {values.max():g}"
        check(is_usable, "maps", "finite numbers of 0 or more, not all 0", got)
    return one / one.sum(-1, keepdims=True), other / other.sum(-1, keepdims=True)


def nss(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> _Array:
    r"""Compute the normalised scanpath saliency (Peters et al., 2005): the map's z-score at each fixation.

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
    values, fixated = _looked_up(maps, x, y)
    check(bool(np.isfinite(values).all()), "maps", "finite numbers", "infinity; give densities, not their logarithms")
    flat = values.reshape(*values.shape[:-2], -1)  # (..., H·W)
    mean = flat.mean(-1)[..., None]  # (..., 1)
    # By rounding the mean of equal values may differ from them, and their deviation from 0.
    is_constant = (np.ptp(flat, axis=-1) == 0)[..., None]
    deviation = np.where(is_constant, 1, flat.std(-1)[..., None])
    return np.where(is_constant, 0, (fixated - mean) / deviation)


def auc(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> _Array:
    r"""Compute the area under the ROC for single fixations: the fraction of pixels with a lower value.

    Ties count half:

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
    values, fixated = _looked_up(maps, x, y)
    ascending = np.sort(values.reshape(-1, _pixel_count(values)), axis=-1)  # (maps, H·W)
    by_map = fixated.reshape(len(ascending), -1)  # (maps, n)
    areas = [_share_below(pixels, scores) for pixels, scores in zip(ascending, by_map, strict=True)]
    return np.reshape(areas, fixated.shape)


def _share_below(ordered: _Array, values: _Array) -> _Array:
    """Compute the fraction of ascending numbers that are lower than each of `values` `(n,)`; ties count half."""
    # The number of lower ones, and of lower or equal ones: their mean counts ties half.
    twice = np.searchsorted(ordered, values) + np.searchsorted(ordered, values, side="right")
    return np.asarray(twice / (2 * len(ordered)))


def log_density(maps: ArrayLike, floor: float = 0.0) -> _Array:
    r"""Compute the natural logarithm of maps that are normalised to densities over their pixels.

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
    values = _as_maps(maps)
    total = values.sum((-1, -2), keepdims=True)  # (..., 1, 1)
    is_positive = bool((values >= 0).all() and (total > 0).all())
    is_finite = bool(np.isfinite(total).all())
    got = f"values from {values.min():g} to {values.max():g}, with sums from {total.min():g} to {total.max():g}"
    check(is_positive and is_finite, "maps", "finite numbers of 0 or more, not all 0 in a map", got)
    uniform = floor / _pixel_count(values)
    density = (1 - floor) * values / total + uniform
    with np.errstate(divide="ignore"):  # a probability of 0 is -inf, as documented
        return np.asarray(np.log(density))


def log_likelihood(density: ArrayLike, x: ArrayLike, y: ArrayLike) -> _Array:
    r"""Compute the log likelihood of fixations in bits, above a uniform density's (Kümmerer, Wallis and Bethge, 2015).

    .. math:: \log_2 p(x, y) + \log_2 HW

    Args:
        density: `(..., H, W)`, natural logarithms of densities over the pixels (`log_density`).
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`, of the same fixations.

    Returns:
        `(..., n)`, in bits; 0 for a uniform density.

    Raises:
        InputError: the shapes do not fit together, a fixation lies outside its map, or `density` is no logarithm of a
            density, whose exponentials have sum 1.

    >>> log_likelihood(log_density([[1.0, 1.0], [1.0, 5.0]]), [1], [1]).round(3)
    array([1.322])
    """
    values, fixated = _looked_up(density, x, y)
    with np.errstate(over="ignore", invalid="ignore"):
        totals = np.exp(values).sum((-1, -2))  # (...), 1 for a density
    error = np.abs(totals - 1)
    is_normal = bool((np.isfinite(values.max((-1, -2))) & (error <= _ROUNDING)).all())
    got = f"exponentials with sum {totals.flat[error.argmax()]:g}; log_density makes them of maps"
    check(is_normal, "density", "natural logarithms of densities, whose exponentials have sum 1", got)
    return np.asarray((fixated + np.log(_pixel_count(values))) / np.log(2))


def information_gain(density: ArrayLike, baseline: ArrayLike, x: ArrayLike, y: ArrayLike) -> _Array:
    r"""Compute the information gain over a baseline density, in bits (Kümmerer, Wallis and Bethge, 2015).

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
    density = as_array(density, "density")
    baseline = as_array(baseline, "baseline")
    size = density.shape[-2:]
    check(size == baseline.shape[-2:], "baseline", f"densities over {size} pixels, as `density`", baseline.shape[-2:])
    return log_likelihood(density, x, y) - log_likelihood(baseline, x, y)


def _pixel_count(maps: _Array) -> int:
    """Count the pixels of a map; maps `(..., H, W)`."""
    height, width = maps.shape[-2:]
    return height * width


def _as_maps(maps: ArrayLike) -> _Array:
    """Take maps `(..., H, W)` as an array."""
    values = as_array(maps, "maps")
    check(values.ndim >= 2 and values.size > 0, "maps", "an array of shape (..., H, W), not empty", values.shape)
    return values


def _pixels(coordinate: ArrayLike) -> _Array:
    """Round coordinates of fixations to those of pixels, whose centres are at integers."""
    return np.asarray(np.floor(as_array(coordinate, "x, y") + 0.5))


def _looked_up(maps: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[_Array, _Array]:
    """Read maps at the pixels of fixations, and check both.

    Args:
        maps: `(..., H, W)`.
        x: `(..., n)`, of fixations, in pixels of the map.
        y: `(..., n)`, of the same fixations.

    Returns:
        The maps as an array, and their values at the fixations, `(..., n)`.
    """
    values = _as_maps(maps)
    column = _pixels(x)
    row = _pixels(y)
    leading = values.shape[:-2]
    is_row = column.shape == row.shape and column.shape[:-1] == leading and column.ndim == len(leading) + 1
    check(is_row, "x, y", f"arrays of shape {(*leading, 'n')}, one row for each map", (column.shape, row.shape))
    missing = int(np.isnan(values).sum())
    check(not missing, "maps", "numbers", f"NaN in {missing} of {values.size} pixels; replace them (numpy.nan_to_num)")

    height, width = values.shape[-2:]
    inside_columns = (column >= 0) & (column < width)
    inside_rows = (row >= 0) & (row < height)
    outside = ~(inside_columns & inside_rows)  # also of NaN, which no comparison holds for
    got = f"{int(outside.sum())} of {outside.size} outside it; remove them, or scale them to pixels of the map"
    check(not bool(outside.any()), "x, y", f"points inside a map of {width} × {height} pixels", got)

    flat = values.reshape(*leading, -1)  # (..., H·W), row by row
    pixel = (row * width + column).astype(np.int64)  # (..., n)
    return values, np.take_along_axis(flat, pixel, axis=-1)

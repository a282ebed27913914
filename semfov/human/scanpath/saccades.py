"""Distributions of the lengths and directions of saccades, and how far two of them are apart."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.data.fixations.record import as_array, as_path
from semfov.errors import check

_Array = NDArray[np.float64]


def saccades(paths: Sequence[ArrayLike]) -> tuple[_Array, _Array]:
    """Compute lengths and directions of the saccades of scanpaths.

    Args:
        paths: fixations of each scanpath, `(n, 2)`.

    Returns:
        Lengths `(s,)` in the unit of the points, and directions `(s,)` in radians from -π to π; 0 is to the right, and
        π/2 down, as y grows downwards. Saccades of length 0 have no direction and are left out.

    Raises:
        InputError: fixations are not points.

    >>> lengths, directions = saccades([[[0, 0], [3, 4], [3, 0]]])
    >>> lengths, directions.round(2)
    (array([5., 4.]), array([ 0.93, -1.57]))
    """
    steps = [np.diff(as_path(path, "paths"), axis=0) for path in paths]
    x, y = np.concatenate([np.zeros((0, 2)), *steps]).T
    lengths = np.hypot(x, y)
    moves = lengths > 0
    return lengths[moves], np.arctan2(y, x)[moves]


def length_distance(ours: ArrayLike, theirs: ArrayLike) -> float:
    r"""Compute the Wasserstein distance of two samples of saccade lengths: the area between their distributions.

    .. math:: \int |F(r) - G(r)| \, dr

    Args:
        ours: `(n,)`, lengths.
        theirs: `(m,)`, lengths in the same unit.

    Returns:
        The distance, in the unit of the lengths; NaN where a sample is empty.

    >>> length_distance([1.0, 2.0], [2.0, 3.0])
    1.0
    """
    a = np.sort(_sample(ours, "ours"))
    b = np.sort(_sample(theirs, "theirs"))
    if not (len(a) and len(b)):
        return float("nan")
    lengths = np.sort(np.concatenate([a, b]))  # (n + m,), where a distribution rises
    gap = _distribution(a, lengths) - _distribution(b, lengths)
    return float((np.abs(gap[:-1]) * np.diff(lengths)).sum())


def _sample(values: ArrayLike, argument: str) -> _Array:
    """Take a sample of finite numbers `(n,)`."""
    sample = as_array(values, argument, finite=True)
    check(sample.ndim == 1, argument, "numbers in a row", f"shape {sample.shape}")
    return sample


def _distribution(sample: _Array, values: _Array) -> _Array:
    """Share of a sorted sample that is at most each value; values and result `(n,)`."""
    return np.asarray(np.searchsorted(sample, values, "right") / len(sample))


def direction_distance(ours: ArrayLike, theirs: ArrayLike) -> float:
    r"""Compute the Wasserstein distance of saccade directions on the circle (Rabin, Delon and Gousseau, 2011).

    .. math:: \min_c \int_{-\pi}^{\pi} |F(\theta) - G(\theta) - c| \, d\theta

    Args:
        ours: `(n,)`, directions in radians.
        theirs: `(m,)`, directions in radians.

    Returns:
        The distance, in radians from 0 to π; NaN where a sample is empty.

    >>> direction_distance([3.0], [-3.0]).__round__(3)
    0.283
    """
    f_sample = np.sort((_sample(ours, "ours") + np.pi) % (2 * np.pi))
    g_sample = np.sort((_sample(theirs, "theirs") + np.pi) % (2 * np.pi))
    if not (len(f_sample) and len(g_sample)):
        return float("nan")
    # F - G is constant between one direction and the next.
    directions = np.sort(np.concatenate([f_sample, g_sample]))
    angles = np.concatenate([[0.0], directions, [2 * np.pi]])
    spans = np.diff(angles)  # (n + m + 1,), as all that follow
    starts = angles[:-1]
    gap = _distribution(f_sample, starts) - _distribution(g_sample, starts)
    # The best c is the median of the gap, weighted by the spans, which sum to 2π.
    order = np.argsort(gap)
    middle = np.searchsorted(spans[order].cumsum(), np.pi)
    median = gap[order][middle]
    return float((np.abs(gap - median) * spans).sum())

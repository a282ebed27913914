"""How well a saliency map separates the pixels that people fixated from others, over a whole picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from semfov.errors import check
from semfov.metrics.scanpath.conditional import looked_up, share_below


def auc_judd(saliency: ArrayLike, x: ArrayLike, y: ArrayLike) -> float:
    """Area under the ROC of Judd et al. (2009) as the MIT benchmark computes it (Bylinskii et al., 2019).

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
    values, at = looked_up(saliency, x, y)
    check(values.ndim == 2 and at.size > 0, "saliency", "one map and at least one fixation", (values.shape, at.shape))
    free = np.ones(values.shape, dtype=bool)
    free[np.floor(np.asarray(y) + 0.5).astype(int), np.floor(np.asarray(x) + 0.5).astype(int)] = False
    others = np.sort(values[free])
    check(len(others) > 0, "saliency", "at least one pixel that nobody fixated", "none")
    thresholds = np.sort(at)[::-1]
    hits = 1 - np.searchsorted(np.sort(at), thresholds) / len(at)
    alarms = 1 - np.searchsorted(others, thresholds) / len(others)
    return float(np.trapezoid([0, *hits, 1], [0, *alarms, 1]))


def auc_shuffled(saliency: ArrayLike, x: ArrayLike, y: ArrayLike, other_x: ArrayLike, other_y: ArrayLike) -> float:
    """Shuffled area under the ROC (Tatler, Baddeley and Gilchrist, 2005; Zhang et al., 2008).

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
    hits = looked_up(saliency, x, y)[1]
    others = np.sort(looked_up(saliency, other_x, other_y)[1])
    check(hits.size > 0 and others.size > 0, "x, other_x", "fixations of this picture and of others", "none")
    return float(share_below(others, hits).mean())

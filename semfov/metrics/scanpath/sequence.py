"""Scanpaths as words: what the same places and things, visited in the same order, say about two of them."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.errors import InputError, check

Labels = NDArray[np.int64]


def cell_labels(points: ArrayLike, columns: int, rows: int, size: tuple[float, float]) -> Labels:
    """Which cell of a grid each fixation is in, `(n,)`: the letters of ScanMatch (Cristino et al., 2010).

    Args:
        points: `(n, 2)`, in pixels of a picture, pixel centres at integers.
        columns: cells in a row.
        rows: cells in a column.
        size: `(width, height)` of the picture.

    >>> cell_labels([[0, 0], [99, 0], [99, 99]], 2, 2, (100, 100))
    array([0, 1, 3])
    """
    inside = (np.asarray(points, dtype=np.float64) + 0.5) / np.asarray(size)
    check(bool(((inside >= 0) & (inside <= 1)).all()), "points", f"points of a picture of {size}", "others")
    column, row = np.minimum(inside * (columns, rows), (columns - 1e-9, rows - 1e-9)).astype(np.int64).T
    return np.asarray(row * columns + column)


def cluster_labels(points: ArrayLike, others: ArrayLike, bandwidth: float | None = None) -> Labels:
    """Which cluster of all fixations of a picture each fixation is in, `(n,)`; clusters are by mean shift.

    The letters of Borji and Itti's sequence score (2013) as Yang et al. (2020) compute it: scikit-learn's `MeanShift`
    on the fixations of all people.

    Args:
        points: `(n, 2)`, fixations to label.
        others: `(m, 2)`, fixations that the clusters are made of.
        bandwidth: of the mean shift, in units of the points; None: scikit-learn's estimate.

    Raises:
        InputError: scikit-learn is not installed.
    """
    return labels_by(fitted_clusters(others, bandwidth), points)


def fitted_clusters(others: ArrayLike, bandwidth: float | None = None) -> Any:
    """The clusters of `cluster_labels`, a fitted `sklearn.cluster.MeanShift`, for those who label more than once."""
    try:
        from sklearn.cluster import MeanShift
    except ImportError:
        raise InputError("cluster_labels: expected scikit-learn; pip install semfov[human]") from None
    shift = MeanShift(bandwidth=bandwidth, bin_seeding=True)
    with warnings.catch_warnings():
        # Where each fixation has a bin of its own all of them are seeds, which is as good.
        warnings.filterwarnings("ignore", message="Binning data failed")
        return shift.fit(np.asarray(others, dtype=np.float64))


def labels_by(clusters: Any, points: ArrayLike) -> Labels:
    """Which of the fitted clusters each fixation `(n, 2)` is in, `(n,)`."""
    return np.asarray(clusters.predict(np.asarray(points, dtype=np.float64)), dtype=np.int64)


def sequence_score(ours: Sequence[Hashable], theirs: Sequence[Hashable]) -> float:
    r"""How alike two words are, from 0 to 1: Needleman and Wunsch's alignment without a price of gaps.

    .. math:: S(a, b) = \frac{\mathrm{LCS}(a, b)}{\max(|a|, |b|)}

    With one point for a match and none for gaps the best alignment is the longest common subsequence. Sequence score of
    Borji and Itti (2013) in the form of Yang et al. (2020), where letters are clusters or cells that were fixated; the
    semantic sequence score (Yang et al., 2022) where they are the classes of what was fixated.

    Args:
        ours: letters of one scanpath, in order.
        theirs: letters of the other.

    >>> sequence_score(["cup", "cup", "fork"], ["cup", "fork", "oven", "fork"])
    0.5
    """
    a, b = _word(ours, "ours"), _word(theirs, "theirs")
    return float(_rapidfuzz().LCSseq.normalized_similarity(a, b))


def edit_distance(ours: Sequence[Hashable], theirs: Sequence[Hashable]) -> int:
    """Least number of fixations to insert, delete or replace (Levenshtein) that turn one word into the other.

    Fixation edit distance (Mondal et al., 2023) where letters are clusters or cells; its semantic form where they are
    classes.

    >>> edit_distance([3, 7, 7, 1], [3, 7, 1])
    1
    """
    return int(_rapidfuzz().Levenshtein.distance(_word(ours, "ours"), _word(theirs, "theirs")))


def _word(labels: Sequence[Hashable], argument: str) -> list[Hashable]:
    check(len(labels) > 0, argument, "at least one letter", "none")
    return labels.tolist() if isinstance(labels, np.ndarray) else list(labels)


def _rapidfuzz() -> Any:
    try:
        from rapidfuzz import distance
    except ImportError:
        raise InputError("sequences: expected rapidfuzz; pip install semfov[human]") from None
    return distance

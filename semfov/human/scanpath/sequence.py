"""Scanpaths as sequences of labels, and how similar two sequences are."""

import warnings
from collections.abc import Hashable, Sequence
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.data.fixations.record import as_path, check_sides
from semfov.errors import InputError, check, check_number, check_whole
from semfov.metrics.labels import as_labels

_Labels = NDArray[np.int64]

_MOST_CELLS = 1_000_000  # in a row, and in a column


def cell_labels(points: ArrayLike, columns: int, rows: int, size: tuple[float, float]) -> _Labels:
    """Find the grid cell of each fixation: the letters of ScanMatch (Cristino et al., 2010).

    Args:
        points: `(n, 2)`, in pixels of a picture, pixel centres at integers.
        columns: number of cells in a row.
        rows: number of cells in a column.
        size: `(width, height)` of the picture.

    Returns:
        `(n,)`, cells numbered row by row from 0.

    Raises:
        InputError: a point lies outside the picture.

    >>> cell_labels([[0, 0], [99, 0], [99, 99]], 2, 2, (100, 100))
    array([0, 1, 3])
    """
    check_whole(columns, "columns", 1, _MOST_CELLS)
    check_whole(rows, "rows", 1, _MOST_CELLS)
    check_sides("size", size)
    shares = (as_path(points, "points") + 0.5) / size  # of the picture's width and height
    is_inside = ((shares >= 0) & (shares <= 1)).all(-1)
    outside = int((~is_inside).sum())
    check(outside == 0, "points", f"points inside a picture of {size} pixels", f"{outside} outside it; remove them")
    # A point on the last edge belongs to the last cell.
    last = (columns - 1e-9, rows - 1e-9)
    cells = np.minimum(shares * (columns, rows), last).astype(np.int64)
    column, row = cells.T
    return np.asarray(row * columns + column)


def cluster_labels(points: ArrayLike, others: ArrayLike, bandwidth: float | None = None) -> _Labels:
    """Find the cluster of each fixation, where mean shift has clustered all fixations of a picture.

    These are the letters of Borji and Itti's sequence score (2013) as Yang et al. (2020) compute it: scikit-learn's
    `MeanShift` on the fixations of all people.

    Args:
        points: `(n, 2)`, fixations to label.
        others: `(m, 2)`, fixations to cluster, in the same unit.
        bandwidth: bandwidth of the mean shift, in the unit of the points; None takes scikit-learn's estimate.

    Returns:
        `(n,)`, numbers of clusters from 0.

    Raises:
        InputError: scikit-learn is not installed.

    >>> labels = cluster_labels([[0, 0], [99, 99]], [[0, 0], [1, 1], [98, 99]], bandwidth=5)
    >>> bool(labels[0] == labels[1])
    False
    """
    return np.asarray(fitted_clusters(others, bandwidth).predict(as_path(points, "points")), dtype=np.int64)


class Clusters(Protocol):
    """Clusters of fixations, such as a fitted `MeanShift`."""

    def predict(self, points: NDArray[np.float64]) -> NDArray[np.int64]: ...


def fitted_clusters(others: ArrayLike, bandwidth: float | None = None) -> Clusters:
    """Cluster fixations as `cluster_labels` does, to label others more than once.

    Args:
        others: `(m, 2)`, fixations to cluster.
        bandwidth: bandwidth of the mean shift; None takes scikit-learn's estimate.

    Returns:
        The fitted `MeanShift`.

    Raises:
        InputError: scikit-learn is not installed, or there is no fixation.
    """
    try:
        from sklearn.cluster import MeanShift
    except ImportError:
        raise InputError("cluster_labels needs scikit-learn: pip install semfov[human]") from None
    points = as_path(others, "others", least=1)
    if bandwidth is not None:
        check_number(bandwidth, "bandwidth", 1e-9, 1e9)
    shift = MeanShift(bandwidth=bandwidth, bin_seeding=True)
    with warnings.catch_warnings():
        # The warning says that no two fixations share a bin. All of them are seeds then, which does no harm.
        warnings.filterwarnings("ignore", message="Binning data failed")
        fitted: Clusters = shift.fit(points)
    return fitted


def sequence_score(ours: Sequence[Hashable], theirs: Sequence[Hashable]) -> float:
    r"""Compute the similarity of two sequences of labels: Needleman and Wunsch's alignment without a gap penalty.

    .. math:: S(a, b) = \frac{\mathrm{LCS}(a, b)}{\max(|a|, |b|)}

    With one point for a match and no penalty for a gap, the best alignment is the longest common subsequence (LCS).
    This is the sequence score of Borji and Itti (2013) in the form of Yang et al. (2020), where labels are clusters or
    cells. It is the semantic sequence score (Yang et al., 2022) where labels are the classes of what was fixated.

    Args:
        ours: labels of one scanpath, in order.
        theirs: labels of the other.

    Returns:
        The similarity, from 0 to 1.

    Raises:
        InputError: a sequence is empty, or rapidfuzz is not installed.

    >>> sequence_score(["cup", "cup", "fork"], ["cup", "fork", "oven", "fork"])
    0.5
    """
    a = as_labels(ours, "ours", least=1)
    b = as_labels(theirs, "theirs", least=1)
    return float(_rapidfuzz().LCSseq.normalized_similarity(a, b))


def edit_distance(ours: Sequence[Hashable], theirs: Sequence[Hashable]) -> int:
    """Compute the edit distance of two sequences of labels (Levenshtein).

    It is the least number of labels to insert, delete or replace that turns one sequence into the other. This is the
    fixation edit distance (Mondal et al., 2023) where labels are clusters or cells, and its semantic form where they
    are classes.

    Args:
        ours: labels of one scanpath, in order.
        theirs: labels of the other.

    Returns:
        The number of edits, 0 or more.

    Raises:
        InputError: a sequence is empty, or rapidfuzz is not installed.

    >>> edit_distance([3, 7, 7, 1], [3, 7, 1])
    1
    """
    a = as_labels(ours, "ours", least=1)
    b = as_labels(theirs, "theirs", least=1)
    return int(_rapidfuzz().Levenshtein.distance(a, b))


def _rapidfuzz() -> ModuleType:
    """Import the distances of rapidfuzz, which has no types."""
    try:
        from rapidfuzz import distance
    except ImportError:
        raise InputError("comparing sequences needs rapidfuzz: pip install semfov[human]") from None
    return distance


def merge_close(points: ArrayLike, size: tuple[float, float]) -> NDArray[np.float64]:
    """Merge successive fixations that are closer than half a window.

    Ruarte et al. (2025) and the benchmark before it (Travi et al., 2022) do so to compare people's scanpaths with those
    of models that fixate a cell only once. Beginning at the start, a fixation and the next are replaced by their mean
    as long as both differences, in x and in y, are smaller than half the window.

    Args:
        points: `(n, 2)`, fixations in order.
        size: `(width, height)` of the window, in the unit of the points.

    Returns:
        `(m, 2)`, the merged fixations, m ≤ n.

    >>> merge_close([[0, 0], [2, 0], [9, 9]], (10, 10))
    array([[1., 0.],
           [9., 9.]])
    """
    path = list(as_path(points, "points"))
    check_sides("size", size)
    half = np.array(size) / 2
    # A merged fixation may be close to the next one, too, so that it is compared again.
    index = 0
    while index < len(path) - 1:
        if (np.abs(path[index] - path[index + 1]) < half).all():
            path[index : index + 2] = [(path[index] + path[index + 1]) / 2]
        else:
            index += 1
    return np.array(path)

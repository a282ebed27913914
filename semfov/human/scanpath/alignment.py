"""Scanpaths aligned by distance: MultiMatch, ScanMatch, dynamic time warping, time delay embedding."""

from collections.abc import Iterable
from reprlib import repr as short_repr
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.data.fixations.record import as_array, as_path, check_sides
from semfov.errors import InputError, check, check_number, check_whole
from semfov.human.scanpath.sequence import cell_labels

_Array = NDArray[np.float64]
_Item = TypeVar("_Item")

_MOST_SCREENS = 10  # diagonals of a screen over which fixations may spread; more are of another unit
_MOST_LETTERS = 10_000  # of a scanpath: the table of an alignment has their product


class MultiMatch(NamedTuple):
    """Similarities of two scanpaths, each from 0 to 1; `multimatch` gives the formulas.

    All are NaN where a scanpath has fewer than three fixations.

    Attributes:
        shape: of the saccade vectors.
        direction: of the angles of the saccades.
        length: of the lengths of the saccades.
        position: of the fixated points.
        duration: of the fixations' durations; NaN where no durations are given.

    >>> MultiMatch(0.5, 1.0, 1.0, 0.5, float("nan")).mean
    0.75
    """

    shape: float
    direction: float
    length: float
    position: float
    duration: float

    @property
    def mean(self) -> float:
        """Mean of the four dimensions that need no durations, as Ruarte et al. (2025) report it."""
        return float(np.mean(self[:4]))


def multimatch(
    ours: ArrayLike,
    theirs: ArrayLike,
    size: tuple[float, float],
    durations: tuple[ArrayLike, ArrayLike] | None = None,
) -> MultiMatch:
    r"""Compute MultiMatch (Jarodzka, Holmqvist and Nyström, 2010; Dewhurst et al., 2012), without simplification.

    Saccades :math:`u_i` and :math:`v_j` are aligned along the cheapest path through the matrix
    :math:`M_{ij} = \|u_i - v_j\|` from its first to its last corner (steps right, down and diagonal). With D the
    diagonal of the screen, and medians over the aligned pairs,

    - shape :math:`1 - \mathrm{med} \|u - v\| / 2D`
    - direction :math:`1 - \mathrm{med} |\angle(u, v)| / \pi`
    - length :math:`1 - \mathrm{med} |\|u\| - \|v\|| / D`
    - position :math:`1 - \mathrm{med} \|p - q\| / D`, with the points p and q where the saccades start
    - duration :math:`1 - \mathrm{med} |s - t| / \max(s, t)`, with the durations s and t of the fixations there

    Where fixations outside the screen are farther apart than its diagonal, similarities end at 0.

    The result equals that of `multimatch_gaze.docomparison` without grouping where one path is the cheapest. Of equally
    cheap paths, as between fixations at the centres of cells, the reference may take another one.

    Args:
        ours: `(n, 2)`, fixations of one scanpath.
        theirs: `(m, 2)`, fixations of the other, in the same unit.
        size: `(width, height)` of the screen, in the same unit.
        durations: durations `(n,)` and `(m,)` of the fixations, in any one unit.

    Returns:
        The five similarities.

    Raises:
        InputError: fixations are not points, or spread over more than ten screens, as those in another unit do; or
            durations are not as many as fixations.

    >>> path = [[0, 0], [30, 0], [30, 40]]
    >>> multimatch(path, path, (300, 400)).mean
    1.0
    """
    p = as_path(ours, "ours")
    q = as_path(theirs, "theirs")
    check_sides("size", size)
    if len(p) < 3 or len(q) < 3:
        return MultiMatch(*[float("nan")] * 5)
    diagonal = float(np.hypot(*size))
    _check_spread(np.concatenate([p, q]), diagonal)

    u = np.diff(p, axis=0)  # saccades, (n - 1, 2)
    v = np.diff(q, axis=0)  # (m - 1, 2)
    i, j = _aligned(_distances(u, v))
    u = u[i]  # aligned, (k, 2) like v
    v = v[j]
    duration = float("nan")
    if durations is not None:
        s, t = _checked_durations(durations, len(p), len(q))
        duration = _duration_similarity(s[i], t[j])

    difference = np.linalg.norm(u - v, axis=1)  # (k,), as all that follow
    turn = np.abs(_directions(u) - _directions(v))
    angle = np.minimum(turn, 2 * np.pi - turn)  # the shorter way around
    stretch = np.abs(np.linalg.norm(u, axis=1) - np.linalg.norm(v, axis=1))
    distance = np.linalg.norm(p[i] - q[j], axis=1)
    return MultiMatch(
        shape=max(0.0, 1 - float(np.median(difference)) / (2 * diagonal)),
        direction=1 - float(np.median(angle)) / np.pi,
        length=max(0.0, 1 - float(np.median(stretch)) / diagonal),
        position=max(0.0, 1 - float(np.median(distance)) / diagonal),
        duration=duration,
    )


def _check_spread(points: _Array, diagonal: float) -> None:
    """Raise `InputError` for points `(n, 2)` that spread over many diagonals of a screen: they are in another unit."""
    extent = np.ptp(points, axis=0)
    spread = float(np.hypot(*extent))
    got = f"fixations over {spread:g}, {spread / diagonal:.0f} of its diagonals"
    check(spread <= _MOST_SCREENS * diagonal, "size", "the screen in the unit of the fixations", got)


def _directions(vectors: _Array) -> _Array:
    """Compute the directions `(n,)` of vectors `(n, 2)` in radians."""
    return np.asarray(np.arctan2(vectors[:, 1], vectors[:, 0]))


def _distances(first: NDArray[np.number], second: NDArray[np.number]) -> _Array:
    """Compute the distances of all pairs of vectors; first `(n, d)`, second `(m, d)` → `(n, m)`."""
    return np.asarray(np.linalg.norm(first[:, None] - second[None], axis=-1))


def _checked_durations(durations: tuple[ArrayLike, ArrayLike], first: int, second: int) -> tuple[_Array, _Array]:
    """Take the durations of two scanpaths of some numbers of fixations, and check them."""
    ours, theirs = _pair(durations, "durations", "those of both scanpaths")
    s = as_array(ours, "durations")
    t = as_array(theirs, "durations")
    expected = f"{first} and {second} numbers, one for each fixation"
    check(s.shape == (first,) and t.shape == (second,), "durations", expected, (s.shape, t.shape))
    are_positive = bool((s >= 0).all() and (t >= 0).all())
    are_finite = bool(np.isfinite([s.sum(), t.sum()]).all())
    check(are_positive and are_finite, "durations", "finite numbers of 0 or more", "others")
    return s, t


def _pair(values: Iterable[_Item], argument: str, expected: str) -> tuple[_Item, _Item]:
    """Take two values; raise `InputError` where there are not two."""
    try:
        first, second = values
    except (TypeError, ValueError):
        raise InputError(f"{argument}: expected {expected}, got {short_repr(values)}") from None
    return first, second


def _duration_similarity(s: _Array, t: _Array) -> float:
    """Compare the durations `(n,)` of aligned fixations; two of 0 are equal."""
    longer = np.maximum(s, t)
    return 1 - float(np.median(np.abs(s - t) / np.where(longer > 0, longer, 1)))


def _aligned(cost: _Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the cheapest path through a matrix from its first to its last corner, by dynamic programming.

    Args:
        cost: `(n, m)`, what each pair on the path costs.

    Returns:
        Rows and columns of the pairs, from the last corner to the first.
    """
    rows, columns = cost.shape
    # total[i, j] is the least sum of a path through the first i rows and j columns; a border of infinity spares checks.
    total = np.full((rows + 1, columns + 1), np.inf)
    total[0, 0] = 0
    for i in range(rows):
        for j in range(columns):
            cheapest = min(total[i, j], total[i, j + 1], total[i + 1, j])
            total[i + 1, j + 1] = cost[i, j] + cheapest

    place = (rows, columns)  # in `total`
    path = [place]
    while place != (1, 1):
        i, j = place
        place = min([(i - 1, j - 1), (i - 1, j), (i, j - 1)], key=total.__getitem__)
        path.append(place)
    # `total` has one more row and column in front: its entry (i, j) belongs to the pair (i - 1, j - 1).
    first, second = np.array(path).T - 1
    return first, second


def scanmatch(
    ours: ArrayLike,
    theirs: ArrayLike,
    size: tuple[float, float],
    *,
    cells: tuple[int, int] = (12, 8),
    threshold: float = 3.5,
    gap: float = 0.0,
    durations: tuple[ArrayLike, ArrayLike] | None = None,
    bin_ms: float = 50.0,
) -> float:
    r"""Compute ScanMatch (Cristino, Mathôt, Theeuwes and Gilchrist, 2010), with a substitution matrix by distance.

    Fixations become letters, the cells of a grid. Needleman and Wunsch's alignment of the two words has the largest
    sum S, of :math:`\theta - \|c - c'\|` for every pair of letters whose cells c and c' are aligned, in widths of a
    cell, and of the gap penalty for every other letter.

    .. math:: \frac{S}{\theta \max(n, m)}

    With durations a letter is repeated for every `bin_ms` that the fixation lasts. The defaults are those of the
    authors' toolbox, which sets θ to twice the standard deviation of people's saccade lengths, in widths of a cell.

    Args:
        ours: `(n, 2)`, fixations of one scanpath.
        theirs: `(m, 2)`, fixations of the other, in the same unit.
        size: `(width, height)` of the picture, in the same unit.
        cells: columns and rows of the grid.
        threshold: θ, distance from which on an aligned pair counts against the similarity.
        gap: what a letter without a partner adds, 0 or less.
        durations: durations `(n,)` and `(m,)` of the fixations in milliseconds; None takes every fixation once.
        bin_ms: milliseconds of a letter.

    Returns:
        The similarity; 1 for equal scanpaths, and at least 0 where `gap` is 0.

    Raises:
        InputError: a scanpath is empty or leaves the picture, or an argument is out of range.

    >>> scanmatch([[10, 10], [70, 50]], [[10, 10], [70, 50]], (80, 60))
    1.0
    """
    check_number(threshold, "threshold", 1e-6, 1e6)
    check_number(gap, "gap", -1e6, 0)
    check_number(bin_ms, "bin_ms", 1e-6, 1e6)
    columns, rows = _pair(cells, "cells", "(columns, rows)")
    for count in (columns, rows):
        check_whole(count, "cells", 1, 1000)
    path = as_path(ours, "ours", least=1)
    other_path = as_path(theirs, "theirs", least=1)
    word = cell_labels(path, columns, rows, size)  # (n,), cells as letters
    other_word = cell_labels(other_path, columns, rows, size)  # (m,)
    if durations is not None:
        milliseconds, other_milliseconds = _pair(durations, "durations", "those of both scanpaths")
        word = _repeated(word, milliseconds, bin_ms)
        other_word = _repeated(other_word, other_milliseconds, bin_ms)
    # The substitution matrix of the paper falls with the distance of cells, and is 0 at the threshold.
    gain = threshold - _distances(_cells_of(word, columns), _cells_of(other_word, columns))  # (n, m)
    longer = max(len(word), len(other_word))
    return float(_best_alignment(gain, gap) / (threshold * longer))


def _cells_of(word: NDArray[np.int64], columns: int) -> NDArray[np.int64]:
    """Find column and row `(n, 2)` of each letter `(n,)` in a grid that is numbered row by row."""
    return np.stack([word % columns, word // columns], 1)


def _repeated(word: NDArray[np.int64], durations: ArrayLike, bin_ms: float) -> NDArray[np.int64]:
    """Repeat each letter `(n,)` for every `bin_ms` of its fixation, at least once."""
    milliseconds = as_array(durations, "durations")
    check(milliseconds.shape == word.shape, "durations", f"{len(word)} numbers", milliseconds.shape)
    is_usable = bool((milliseconds >= 0).all()) and milliseconds.sum() <= _MOST_LETTERS * bin_ms
    expected = f"numbers from 0, of at most {_MOST_LETTERS:,} letters in all"
    check(is_usable, "durations", expected, milliseconds.tolist())
    return word.repeat(np.maximum(1, np.round(milliseconds / bin_ms)).astype(np.int64))


def _best_alignment(gain: _Array, gap: float) -> float:
    """Find the largest sum of an alignment of two words (Needleman and Wunsch, 1970).

    Args:
        gain: `(n, m)`, what a pair of aligned letters adds.
        gap: what a letter without a partner adds.

    Returns:
        The sum.
    """
    rows, columns = gain.shape
    # best[i, j] is the largest sum of the first i letters of one word and the first j of the other.
    best = np.zeros((rows + 1, columns + 1))
    best[:, 0] = gap * np.arange(rows + 1)
    best[0] = gap * np.arange(columns + 1)
    for i in range(rows):
        for j in range(columns):
            pair = best[i, j] + gain[i, j]
            first_alone = best[i, j + 1] + gap
            second_alone = best[i + 1, j] + gap
            best[i + 1, j + 1] = max(pair, first_alone, second_alone)
    return float(best[-1, -1])


def dynamic_time_warping(ours: ArrayLike, theirs: ArrayLike) -> float:
    r"""Compute dynamic time warping of scanpaths (Berndt and Clifford, 1994): the sum along the cheapest alignment.

    .. math:: \min_{A} \sum_{(i, j) \in A} \|p_i - q_j\|

    An alignment leads from the pair of first fixations to that of the last ones, by steps to the next fixation of one
    scanpath or of both.

    Args:
        ours: `(n, 2)`, fixations of one scanpath.
        theirs: `(m, 2)`, fixations of the other, in the same unit.

    Returns:
        The sum of distances, in the unit of the points; 0 for equal scanpaths.

    Raises:
        InputError: a scanpath is empty, or fixations are not points.

    >>> dynamic_time_warping([[0, 0], [3, 0]], [[0, 0], [0, 0], [3, 4]])
    4.0
    """
    cost = _distances(as_path(ours, "ours", least=1), as_path(theirs, "theirs", least=1))
    return float(cost[_aligned(cost)].sum())


def time_delay_embedding(ours: ArrayLike, theirs: ArrayLike, *, length: int = 3) -> float:
    r"""Compute the distance of scanpaths by time delay embedding (Wang, Chen, Wang, Jiang, Fang and Yao, 2011).

    Every run of k successive fixations of ours is compared with the run of theirs that is closest to it.

    .. math:: \frac1{n - k + 1} \sum_i \min_j \frac1k \big\| (p_i, \ldots, p_{i+k-1}) - (q_j, \ldots, q_{j+k-1}) \big\|

    Args:
        ours: `(n, 2)`, fixations of one scanpath, such as a model's.
        theirs: `(m, 2)`, fixations of the other, such as a person's, in the same unit.
        length: k, number of fixations of a run.

    Returns:
        The mean distance, in the unit of the points; NaN where a scanpath has fewer than k fixations.

    Raises:
        InputError: a scanpath is empty, fixations are not points, or k is below 1.

    >>> time_delay_embedding([[0, 0], [1, 0]], [[9, 9], [0, 0], [1, 2]], length=2)
    1.0
    """
    check_whole(length, "length", 1, 1000)
    a = as_path(ours, "ours", least=1)
    b = as_path(theirs, "theirs", least=1)
    if min(len(a), len(b)) < length:
        return float("nan")
    distances = _distances(_runs(a, length), _runs(b, length))
    return float((distances.min(1) / length).mean())


def _runs(path: _Array, length: int) -> _Array:
    """List every run of successive fixations as one vector, `(n - length + 1, 2 length)`."""
    return np.stack([path[start : start + length].ravel() for start in range(len(path) - length + 1)])

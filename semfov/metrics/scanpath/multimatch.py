"""MultiMatch: similarity of two scanpaths in five dimensions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.data.fixations.record import as_array, as_path
from semfov.errors import check

_Array = NDArray[np.float64]


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
    r"""MultiMatch (Jarodzka, Holmqvist and Nyström, 2010; Dewhurst et al., 2012), without simplification.

    Saccades :math:`u_i` and :math:`v_j` are aligned along the cheapest path through the matrix
    :math:`M_{ij} = \|u_i - v_j\|` from its first to its last corner (steps right, down and diagonal). With D the
    diagonal of the screen, and medians over the aligned pairs,

    - shape :math:`1 - \mathrm{med} \|u - v\| / 2D`
    - direction :math:`1 - \mathrm{med} |\angle(u, v)| / \pi`
    - length :math:`1 - \mathrm{med} |\|u\| - \|v\|| / D`
    - position :math:`1 - \mathrm{med} \|p - q\| / D`, with the points p and q where the saccades start
    - duration :math:`1 - \mathrm{med} |s - t| / \max(s, t)`, with the durations s and t of the fixations there

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
        InputError: fixations are not points, or durations are not as many as fixations.

    >>> path = [[0, 0], [30, 0], [30, 40]]
    >>> multimatch(path, path, (300, 400)).mean
    1.0
    """
    a, b = as_path(ours, "ours"), as_path(theirs, "theirs")
    check(all(np.isfinite(side) and side > 0 for side in size), "size", "(width, height), positive numbers", size)
    if len(a) < 3 or len(b) < 3:
        return MultiMatch(*[float("nan")] * 5)
    u, v = np.diff(a, axis=0), np.diff(b, axis=0)
    i, j = aligned(np.linalg.norm(u[:, None] - v[None], axis=-1))
    u, v = u[i], v[j]
    diagonal = float(np.hypot(*size))
    turn = np.abs(np.arctan2(u[:, 1], u[:, 0]) - np.arctan2(v[:, 1], v[:, 0]))
    lengths = np.abs(np.linalg.norm(u, axis=1) - np.linalg.norm(v, axis=1))
    duration = float("nan")
    if durations is not None:
        s, t = (as_array(each, "durations") for each in durations)
        expected = f"{len(a)} and {len(b)} numbers, one for each fixation"
        check(len(s) == len(a) and len(t) == len(b), "durations", expected, (len(s), len(t)))
        lasting = bool((s >= 0).all() and (t >= 0).all() and np.isfinite([s.sum(), t.sum()]).all())
        check(lasting, "durations", "finite numbers of 0 or more", "others")
        longer = np.maximum(s[i], t[j])
        duration = 1 - float(np.median(np.abs(s[i] - t[j]) / np.where(longer > 0, longer, 1)))
    return MultiMatch(
        shape=1 - float(np.median(np.linalg.norm(u - v, axis=1))) / (2 * diagonal),
        direction=1 - float(np.median(np.minimum(turn, 2 * np.pi - turn))) / np.pi,
        length=1 - float(np.median(lengths)) / diagonal,
        position=1 - float(np.median(np.linalg.norm(a[i] - b[j], axis=1))) / diagonal,
        duration=duration,
    )


def aligned(cost: _Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the cheapest path through a matrix, from its end to its start."""
    rows, columns = cost.shape
    total = np.full((rows + 1, columns + 1), np.inf)
    total[0, 0] = 0
    for i in range(rows):
        for j in range(columns):
            total[i + 1, j + 1] = cost[i, j] + min(total[i, j], total[i, j + 1], total[i + 1, j])
    path = [(rows - 1, columns - 1)]
    while path[-1] != (0, 0):
        i, j = path[-1]
        # `total` has one more row and column in front: its entry (i, j) belongs to the pair (i - 1, j - 1).
        steps = {(i - 1, j - 1): total[i, j], (i - 1, j): total[i, j + 1], (i, j - 1): total[i + 1, j]}
        path.append(min(steps, key=lambda step: steps[step]))
    first, second = np.array(path).T
    return first, second

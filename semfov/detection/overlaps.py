"""Pairs of boxes that overlap, found among neighbours, and suppression by them.

Comparing all boxes with each other takes time that grows with the square of their number. Boxes that overlap lie near
each other, so they are sorted along x, and only neighbours are compared.
"""

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float32]
Index = NDArray[np.intp]


def neighbours(start: NDArray[np.floating], end: NDArray[np.floating]) -> tuple[Index, Index]:
    """Pairs of intervals of which the second starts within the first.

    Args:
        start: `(N,)`, in ascending order.
        end: `(N,)`, none before its start.

    Returns:
        Indices `(P,)` of the first interval of each pair, and of the second.

    >>> neighbours(np.array([0.0, 1.0, 5.0]), np.array([2.0, 3.0, 6.0]))
    (array([0]), array([1]))
    """
    stop = start.searchsorted(end, side="right")
    count = stop - np.arange(1, len(start) + 1)
    first = np.arange(len(start)).repeat(count)
    # The pairs of an interval stand together, and the last of them is with interval `stop - 1`.
    second = np.arange(len(first)) + (stop - count.cumsum()).repeat(count)
    return first, second


def intersection(x1: Column, y1: Column, x2: Column, y2: Column, first: Index, second: Index) -> Column:
    """Compute the area that the two boxes of each pair share.

    Args:
        x1: `(N,)`, left edges of the boxes.
        y1: upper edges.
        x2: right edges.
        y2: lower edges.
        first: `(P,)`, index of one box of each pair.
        second: `(P,)`, index of the other one.

    Returns:
        `(P,)`, areas.
    """
    wide = np.minimum(x2[first], x2[second]) - np.maximum(x1[first], x1[second])
    high = np.minimum(y2[first], y2[second]) - np.maximum(y1[first], y1[second])
    shared: Column = np.maximum(wide, 0) * np.maximum(high, 0)
    return shared


def survivors(count: int, better: Index, worse: Index) -> Index:
    """Greedy suppression: the boxes that stay when each of them removes the worse boxes that it is paired with.

    Args:
        count: number of boxes, the best first.
        better: `(P,)`, index of the better box of each pair.
        worse: `(P,)`, index of the worse one, which is higher.

    Returns:
        Indices of the boxes that stay, in ascending order.

    >>> survivors(4, np.array([0, 1, 2]), np.array([1, 2, 3]))
    array([0, 2])
    """
    doubtful, gone = np.zeros((2, count), np.bool_)
    doubtful[worse] = True
    # A box that is never the worse one stays. Only the pairs that this leaves open depend on each other.
    gone[worse[~doubtful[better]]] = True
    left = np.flatnonzero(~(gone[better] | gone[worse]))
    pairs = np.sort(better[left] * count + worse[left])
    removed = bytearray(gone)
    for one, other in zip((pairs // count).tolist(), (pairs % count).tolist(), strict=True):
        if not removed[one]:
            removed[other] = True
    return np.flatnonzero(np.frombuffer(removed, np.bool_) == 0)

"""Non-maximum suppression at a high threshold, where only boxes that are nearly the same suppress each other."""

import numpy as np
from numpy.typing import NDArray

LEAST = 0.9
"""Intersection over union from which on comparing neighbours alone is faster than comparing all boxes."""


def distinct(boxes: NDArray[np.float32], iou: float) -> NDArray[np.intp]:
    r"""Indices of the boxes that survive non-maximum suppression; those of `torchvision.ops.nms`.

    Two boxes of widths w and w' can only overlap by more than t if their centres are near each other:

    .. math:: |c_x - c_x'| \le \frac{\min(w, w')}{2} \left(\frac{1}{t} - 1\right)

    and likewise for their heights. So boxes are sorted by the x of their centre, and only neighbours are compared.

    Args:
        boxes: `(N, 4)`, each with a positive area, most confident first.
        iou: t, of two boxes that overlap by more than this, the later one is suppressed.

    >>> boxes = np.array([[0, 0, 100, 100], [1, 1, 101, 101], [50, 0, 150, 100]], np.float32)
    >>> distinct(boxes, 0.95)
    array([0, 2])
    """
    count = len(boxes)
    if not count:
        return np.zeros(0, np.intp)
    order = (boxes[:, 0] + boxes[:, 2]).argsort(kind="stable")
    x1, y1, x2, y2 = np.ascontiguousarray(boxes[order].T)
    wide, high = x2 - x1, y2 - y1
    area, x, y = wide * high, x1 + x2, y1 + y2
    # Doubled coordinates of centres. Rounding moves none by as much as a millionth of the largest.
    slack = 1e-6 * float(np.abs(boxes).max())
    reach_x, reach_y = wide * (1 / iou - 1) + slack, high * (1 / iou - 1) + slack
    neighbours = x.searchsorted(x + reach_x, side="right") - np.arange(1, count + 1)
    ends = neighbours.cumsum()
    first = np.arange(count).repeat(neighbours)
    second = np.arange(int(ends[-1])) + (np.arange(1, count + 1) - ends + neighbours).repeat(neighbours)
    apart = np.abs(y.repeat(neighbours) - y[second])
    near = np.flatnonzero(apart <= reach_y.repeat(neighbours))
    first, second = first[near], second[near]
    shared_x = np.minimum(x2[first], x2[second]) - np.maximum(x1[first], x1[second])
    shared_y = np.minimum(y2[first], y2[second]) - np.maximum(y1[first], y1[second])
    shared = np.maximum(shared_x, 0) * np.maximum(shared_y, 0)
    # As torchvision does: the quotient in single precision, the comparison in double precision.
    same = shared / (area[first] + area[second] - shared) > np.float64(iou)
    one, other = order[first[same]], order[second[same]]
    pairs = np.sort(np.minimum(one, other) * count + np.maximum(one, other))
    alive = [True] * count
    for confident, like in zip((pairs // count).tolist(), (pairs % count).tolist(), strict=True):
        if alive[confident]:
            alive[like] = False
    return np.flatnonzero(alive)

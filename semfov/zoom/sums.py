"""Smallest boxes of cells, and arrays of sums over windows."""

import numpy as np
from numpy.typing import NDArray

Cells = NDArray[np.float32]

Box = tuple[int, int, int, int]
"""Cells `(x1, y1, x2, y2)` of a lattice."""

Place = tuple[slice, slice]
"""Rows and columns of an array."""


def union(box: Box, other: Box | None) -> Box:
    """The smallest box that contains both boxes; the first one if there is no other."""
    if other is None:
        return box
    return min(box[0], other[0]), min(box[1], other[1]), max(box[2], other[2]), max(box[3], other[3])


def extent(marked: NDArray[np.bool_]) -> Box:
    """Find the smallest box that contains all marked cells; marked `(rows, columns)`."""
    rows, columns = np.flatnonzero(marked.any(1)), np.flatnonzero(marked.any(0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1

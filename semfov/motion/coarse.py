"""Whether what is coarse in two frames moves as their fine detail does.

Edges of blocks of a broken film, and combs of two half frames, stay where they are and can be followed, while the scene
behind them moves.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from semfov.motion.frames import GreyFrame

_COARSE = 4  # reduced pixels for one of the coarse frame
_AROUND = 15  # side of the square whose mean is taken off, in coarse pixels
_BORDER = 5  # side of the square within which all pixels are to be in view
_LEAST_SHARE = 0.1  # least share of a quarter in view
_LEAST_SLOPE = 1e-3  # least sum of squared slopes in the direction with the fewest


def coarse_shift(cv2: Any, first: GreyFrame, second: GreyFrame, similarity: NDArray[np.float64]) -> float:
    r"""Estimate how far the coarse picture is off after a motion, in the quarter of the frame where that is least.

    The shift δ of each quarter is that of least squares (Lucas and Kanade, 1981) between the first frame A, moved, and
    the second one B, with slopes g of their mean:

    .. math:: \delta = -\Bigl(\sum g g^\top\Bigr)^{-1} \sum g \, (B - A)

    Things that move on their own spoil some quarters, a wrong motion all of them.

    Args:
        cv2: OpenCV.
        first: the frame that is moved.
        second: the other one.
        similarity: `(2, 3)`, maps pixels of the first frame to those of the second.

    Returns:
        The least shift in reduced pixels; infinite where no quarter tells, as in a frame too narrow for slopes.
    """
    height, width = second.grey.shape
    size = max(1, width // _COARSE), max(1, height // _COARSE)
    if min(size) < 2:
        return np.inf
    moved = cv2.warpAffine(first.grey, similarity, (width, height), flags=cv2.INTER_LINEAR)
    shown = cv2.warpAffine(np.full_like(first.grey, 255), similarity, (width, height), flags=cv2.INTER_NEAREST)
    shown = cv2.erode(cv2.resize(shown, size, interpolation=cv2.INTER_AREA), np.ones((_BORDER, _BORDER))) == 255
    a, b = (_coarse(cv2, grey, size) for grey in (moved, second.grey))
    down, across = np.gradient((a + b) / 2)
    slopes = np.stack([across, down]) * shown
    difference = b - a
    rows = slice(0, size[1] // 2), slice(size[1] // 2, None)
    columns = slice(0, size[0] // 2), slice(size[0] // 2, None)
    least = np.inf
    for row in rows:
        for column in columns:
            slope = slopes[:, row, column].reshape(2, -1)
            squares = slope @ slope.T
            if shown[row, column].mean() < _LEAST_SHARE or np.linalg.eigvalsh(squares)[0] < _LEAST_SLOPE:
                continue
            shift = np.linalg.solve(squares, slope @ difference[row, column].ravel())
            least = min(least, _COARSE * float(np.linalg.norm(shift)))
    return least


def _coarse(cv2: Any, grey: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float32]:
    """Reduce a frame to a size `(width, height)`, without the mean of the surroundings of each pixel."""
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(small - cv2.blur(small, (_AROUND, _AROUND)), (0, 0), 1.0), np.float32)

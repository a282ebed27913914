"""How far parts of a frame are off after a motion: a look at all of its texture, where flow follows single corners.

Edges of blocks of a broken film, and combs of two half frames, stay where they are and can be followed, while the scene
behind them moves. A lorry before a scene has more corners than what is left of the scene beside it.
"""

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semfov.motion.frames import GreyFrame

_COARSE = 4  # reduced pixels for one of the coarse frame
_FINE = 2  # the same of the frame in which blocks are compared
_QUARTERS = (2, 2)  # rows and columns of parts of the coarse frame
_BLOCKS = (8, 10)  # the same of the fine one
_AROUND = 15  # side of the square whose mean is taken off, in coarse or fine pixels
_BORDER = 5  # side of the square within which all pixels are to be in view
_LEAST_SHARE = 0.1  # least share of a quarter in view
_LEAST_SLOPE = 1e-3  # least sum of squared slopes in the direction with the fewest

_LEAST_IN_VIEW = 0.5  # least share of a block in view
_LEAST_MEAN_SLOPE = 0.1  # least mean of the squared slopes of a block in the direction with the fewest
_LEAST_DIRECTION = 0.01  # least sum of squared slopes in a direction that tells, as a share of that with the most
_OFF = 0.8  # reduced pixels from which on a block is off
_EXPLAINED = 0.6  # least share of the squared differences of a block that its shift explains


def coarse_shift(cv2: ModuleType, first: GreyFrame, second: GreyFrame, similarity: NDArray[np.float64]) -> float:
    r"""Estimate how far the coarse picture is off after a motion, in the quarter of the frame where that is least.

    Things that move on their own spoil some quarters, a wrong motion all of them.

    Args:
        cv2: OpenCV.
        first: the frame that is moved.
        second: the other one.
        similarity: `(2, 3)`, maps pixels of the first frame to those of the second.

    Returns:
        The least shift in reduced pixels; infinite where no quarter tells, as in a frame too narrow for slopes.
    """
    parts = _Parts.of(cv2, first, second, similarity, _COARSE, _QUARTERS)
    if parts is None:
        return np.inf
    tells = (parts.seen >= _LEAST_SHARE * parts.pixels) & (parts.slope >= _LEAST_SLOPE)
    return float(np.min(parts.shift[tells], initial=np.inf))


def share_off(cv2: ModuleType, first: GreyFrame, second: GreyFrame, similarity: NDArray[np.float64]) -> float:
    """Compute the share of the blocks of a frame that are off by a pixel or so after a motion, each as a whole.

    Args:
        cv2: OpenCV.
        first: the frame that is moved.
        second: the other one.
        similarity: `(2, 3)`, maps pixels of the first frame to those of the second.

    Returns:
        From 0 to 1, of the blocks that tell; 0 where none does.
    """
    parts = _Parts.of(cv2, first, second, similarity, _FINE, _BLOCKS)
    if parts is None:
        return 0.0
    tells = (parts.seen >= _LEAST_IN_VIEW * parts.pixels) & (parts.slope >= _LEAST_MEAN_SLOPE * parts.seen)
    is_off = tells & (parts.shift >= _OFF) & (parts.explained >= _EXPLAINED)
    return float(is_off.sum() / max(tells.sum(), 1))


def whole_shift(cv2: ModuleType, first: GreyFrame, second: GreyFrame) -> float:
    """Estimate how far a frame has moved as a whole, by far less than a pixel: noise of single blocks averages out.

    Args:
        cv2: OpenCV.
        first: the frame before.
        second: the frame after it, of the same size.

    Returns:
        The shift in reduced pixels along the directions in which the frames have slopes, as stripes have in one alone;
        0 where they have none.
    """
    height, width = second.grey.shape
    size = max(1, width // _FINE), max(1, height // _FINE)
    if min(size) < 2:
        return 0.0
    a, b = (_flattened(cv2, frame.grey, size) for frame in (first, second))
    down, across = np.gradient((a + b) / 2)
    slopes = np.stack([across.ravel(), down.ravel()]).astype(np.float64)
    along, directions = np.linalg.eigh(slopes @ slopes.T)
    tells = along >= _LEAST_DIRECTION * along[-1]
    if along[-1] <= 0:
        return 0.0
    shifts = directions.T @ slopes @ (a - b).ravel() / along.clip(min=np.finfo(np.float64).tiny)
    return _FINE * float(np.linalg.norm(shifts[tells]))


class _Parts(NamedTuple):
    r"""Parts of a frame after a motion, `(rows, columns)` each.

    Their shift δ is that of least squares (Lucas and Kanade, 1981) between the first frame A, moved, and the second one
    B, with slopes g of their mean:

    .. math:: \delta = -\Bigl(\sum g g^\top\Bigr)^{-1} \sum g \, (B - A)

    Attributes:
        shift: how far each is off, in reduced pixels.
        explained: share of the squared differences that the shift explains.
        slope: sum of the squared slopes in the direction with the fewest.
        seen: number of pixels in view.
        pixels: number of pixels.
    """

    shift: NDArray[np.float64]
    explained: NDArray[np.float64]
    slope: NDArray[np.float64]
    seen: NDArray[np.float64]
    pixels: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        cv2: ModuleType,
        first: GreyFrame,
        second: GreyFrame,
        similarity: NDArray[np.float64],
        ratio: int,
        counts: tuple[int, int],
    ) -> "_Parts | None":
        """Compare frames at a ratio of reduced pixels for one; None for a frame too narrow for slopes."""
        height, width = second.grey.shape
        size = max(1, width // ratio), max(1, height // ratio)
        if min(size) < 2:
            return None
        moved = cv2.warpAffine(first.grey, similarity, (width, height), flags=cv2.INTER_LINEAR)
        shown = cv2.warpAffine(np.full_like(first.grey, 255), similarity, (width, height), flags=cv2.INTER_NEAREST)
        # A frame that was moved ends in black, and its border there would be a slope of its own.
        shown = cv2.erode(cv2.resize(shown, size, interpolation=cv2.INTER_AREA), np.ones((_BORDER, _BORDER))) == 255
        a, b = (_flattened(cv2, grey, size) for grey in (moved, second.grey))
        down, across = np.gradient((a + b) / 2)
        x = across * shown
        y = down * shown
        difference = (b - a) * shown
        # Σ g gᵀ, Σ g (B − A) and Σ (B − A)² of each part, whose 2 × 2 systems are solved in closed form.
        slopes_xx = _sums(x * x, counts)
        slopes_xy = _sums(x * y, counts)
        slopes_yy = _sums(y * y, counts)
        right_side_x = _sums(x * difference, counts)
        right_side_y = _sums(y * difference, counts)
        squared_difference = _sums(difference**2, counts)
        determinant = slopes_xx * slopes_yy - slopes_xy**2
        with np.errstate(divide="ignore", invalid="ignore"):
            shift_x = -(slopes_yy * right_side_x - slopes_xy * right_side_y) / determinant
            shift_y = -(slopes_xx * right_side_y - slopes_xy * right_side_x) / determinant
            explained = -(shift_x * right_side_x + shift_y * right_side_y) / squared_difference
        # The smaller eigenvalue of Σ g gᵀ.
        slope = (slopes_xx + slopes_yy) / 2 - np.sqrt(((slopes_xx - slopes_yy) / 2) ** 2 + slopes_xy**2)
        seen = _sums(shown, counts)
        pixels = _sums(np.ones_like(shown), counts)
        return cls(ratio * np.hypot(shift_x, shift_y), explained, slope, seen, pixels)


def _flattened(cv2: ModuleType, grey: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float32]:
    """Reduce a frame to a size `(width, height)`, without the mean of the surroundings of each pixel."""
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(small - cv2.blur(small, (_AROUND, _AROUND)), (0, 0), 1.0), np.float32)


def _sums(values: NDArray[Any], counts: tuple[int, int]) -> NDArray[np.float64]:
    """Sum over parts of a frame, as many rows and columns as counted."""
    rows, columns = (
        np.linspace(0, length, count + 1).astype(np.intp)[:-1]
        for length, count in zip(values.shape, counts, strict=True)
    )
    return np.add.reduceat(np.add.reduceat(values.astype(np.float64), rows, 0), columns, 1)

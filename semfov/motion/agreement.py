"""Whether two reduced frames show the same, block by block."""

from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_BLOCKS = (10, 8)  # columns and rows of blocks in which two frames are compared
_TEXTURE = 3.0  # least standard deviation of the contrast of a block that can be compared
_ALIKE = 0.6  # correlation from which on a block agrees
_LEAST_BLOCKS = 12  # fewer blocks that can be compared are no evidence
_NEARLY_ALL = 0.95  # share of the compared blocks from which on the others are not looked into
_LEAST_AGREEING = 0.6  # least share of the compared blocks that agree


class Agreement(NamedTuple):
    """How a frame that is moved agrees with another one.

    Attributes:
        blocks: number of blocks with texture that both show.
        agreeing: number of those that look alike.
        median: median of their correlations; −1 for none.
        elsewhere: `(h, w)` bytes, 255 in blocks that do not look alike.

    >>> Agreement(blocks=20, agreeing=18, median=0.9, elsewhere=np.zeros((9, 16), np.uint8)).is_enough
    True
    """

    blocks: int
    agreeing: int
    median: float
    elsewhere: NDArray[np.uint8]

    @property
    def is_enough(self) -> bool:
        """Whether most blocks look alike, and there are enough of them."""
        return self.blocks >= _LEAST_BLOCKS and self.agreeing >= _LEAST_AGREEING * self.blocks

    @property
    def is_partial(self) -> bool:
        """Whether a part of the frame is left that may have moved otherwise."""
        return self.agreeing < _NEARLY_ALL * self.blocks

    @property
    def is_whole(self) -> bool:
        """Whether all blocks look alike, and there is one."""
        return self.agreeing == self.blocks > 0


def agreement(
    cv2: ModuleType, first: NDArray[np.uint8], second: NDArray[np.uint8], similarity: NDArray[np.float64] | None = None
) -> Agreement:
    """Compare a frame, moved, with another one.

    Args:
        cv2: OpenCV.
        first: contrast of the frame that is moved, `(h, w)` bytes.
        second: likewise of the other one.
        similarity: `(2, 3)`, maps pixels of the first frame to those of the second; None for no motion.

    Returns:
        How well they agree where both show the scene.
    """
    is_compared, correlation = _compared(cv2, first, second, similarity)
    compared = correlation[is_compared]
    median = float(np.median(compared)) if len(compared) else -1.0
    elsewhere = _Blocks.of(*second.shape).spread(is_compared & (correlation < _ALIKE))
    return Agreement(len(compared), int((compared >= _ALIKE).sum()), median, elsewhere)


def blocks_of_rival(
    cv2: ModuleType,
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    similarity: NDArray[np.float64],
    rival: NDArray[np.float64],
) -> int:
    """Count the blocks that look alike after another motion, and not after the one of a frame.

    Args:
        cv2: OpenCV.
        first: contrast of the frame that is moved, `(h, w)` bytes.
        second: likewise of the other one.
        similarity: `(2, 3)`, maps pixels of the first frame to those of the second.
        rival: likewise, the other motion.

    Returns:
        Their number.
    """
    is_compared, correlation = _compared(cv2, first, second, similarity)
    is_compared_too, otherwise = _compared(cv2, first, second, rival)
    return int((is_compared & (correlation < _ALIKE) & is_compared_too & (otherwise >= _ALIKE)).sum())


def largest_change(cv2: ModuleType, first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Find the largest mean difference of a block of two frames of one size, in grey values."""
    blocks = _Blocks.of(*first.shape)
    (sums,) = blocks.sums(cv2.integral(cv2.absdiff(first, second)))
    return float((sums / blocks.pixels.clip(1)).max())


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks of a frame `(height, width)`, by the edges between them.

    Attributes:
        down: edges between rows of blocks, `(rows + 1,)`.
        across: edges between columns of blocks, `(columns + 1,)`.
        pixels: number of pixels of each, `(rows, columns)`.
        corners: the pixels in the corners of each, homogeneous, `(3, 4 · rows · columns)`.
    """

    down: NDArray[np.intp]
    across: NDArray[np.intp]
    pixels: NDArray[np.intp]
    corners: NDArray[np.float64]

    @staticmethod
    @lru_cache(4)
    def of(height: int, width: int) -> "_Blocks":
        """Divide a frame into blocks of nearly the same size. They are kept, as all frames of a stream have them."""
        columns, rows = _BLOCKS
        down = np.linspace(0, height, rows + 1).astype(np.intp)
        across = np.linspace(0, width, columns + 1).astype(np.intp)
        y = np.stack([down[:-1], down[1:] - 1])[:, None, :, None]
        x = np.stack([across[:-1], across[1:] - 1])[None, :, None, :]
        places = np.broadcast_arrays(x, y, 1)
        corners = np.stack([place.ravel() for place in places]).astype(np.float64)
        return _Blocks(down, across, np.outer(np.diff(down), np.diff(across)), corners)

    def sums(self, *tables: NDArray[np.float64] | NDArray[np.int32]) -> NDArray[np.float64]:
        """Sum over each by tables of sums over all rectangles from the corner, `(height + 1, width + 1)` each.

        Args:
            *tables: n tables.

        Returns:
            `(n, rows, columns)`.
        """
        edges = np.array([table[self.down[:, None], self.across] for table in tables], dtype=np.float64)
        above, below = edges[:, :-1], edges[:, 1:]
        return np.asarray(below[..., 1:] - below[..., :-1] - above[..., 1:] + above[..., :-1])

    def spread(self, chosen: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Mark the pixels of some of them `(rows, columns)` with 255."""
        rows = np.repeat(chosen, np.diff(self.down), axis=0)
        return np.repeat(rows, np.diff(self.across), axis=1).astype(np.uint8) * 255

    def shown_by(self, cv2: ModuleType, similarity: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which of them another frame of this size shows as a whole, if a similarity `(2, 3)` moves it here."""
        back = cv2.invertAffineTransform(similarity)
        # A block is convex, so its corner pixels tell. They are taken from the nearest pixel of the other frame.
        x, y = np.rint(back @ self.corners)
        is_inside = (x >= 0) & (x < self.across[-1]) & (y >= 0) & (y < self.down[-1])
        return np.asarray(is_inside.reshape(4, *self.pixels.shape).all(0))


def _compared(
    cv2: ModuleType, first: NDArray[np.uint8], second: NDArray[np.uint8], similarity: NDArray[np.float64] | None
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Tell which blocks of a frame, moved, can be compared with another one, and their correlations."""
    height, width = second.shape
    blocks = _Blocks.of(height, width)
    moved = first
    is_shown = blocks.pixels > 0
    if similarity is not None:
        moved = cv2.warpAffine(first, similarity, (width, height), flags=cv2.INTER_LINEAR)
        is_shown &= blocks.shown_by(cv2, similarity)
    textured, correlation = _correlations(cv2, moved, second, blocks)
    return textured & is_shown, correlation


def _correlations(
    cv2: ModuleType, first: NDArray[np.uint8], second: NDArray[np.uint8], blocks: _Blocks
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Compute Pearson's correlation of each block of two frames.

    Args:
        cv2: OpenCV.
        first: grey values `(h, w)`.
        second: likewise.
        blocks: the blocks.

    Returns:
        Whether either frame has texture in a block, and the correlation, 0 where one has none at all; both
        `(rows, columns)`.
    """
    products = cv2.multiply(first, second, dtype=cv2.CV_32F)
    a, aa, b, bb, ab = blocks.sums(*cv2.integral2(first), *cv2.integral2(second), cv2.integral(products))
    # n² times variances and covariance: whole numbers below 2⁵³, so that a block of one grey value has exactly 0.
    count = blocks.pixels.astype(np.float64)
    variance_a = count * aa - a**2
    variance_b = count * bb - b**2
    covariance = count * ab - a * b
    spread = np.sqrt(variance_a) * np.sqrt(variance_b)
    correlation = np.divide(covariance, spread, out=np.zeros_like(spread), where=spread > 0)
    # Both sides are n times a standard deviation.
    has_texture = np.sqrt(np.maximum(variance_a, variance_b)) >= _TEXTURE * count
    return has_texture, correlation

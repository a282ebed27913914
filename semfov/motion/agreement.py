"""Whether two reduced frames show the same, block by block."""

from typing import Any, NamedTuple

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
    cv2: Any, first: NDArray[np.uint8], second: NDArray[np.uint8], similarity: NDArray[np.float64]
) -> Agreement:
    """Compare a frame, moved, with another one.

    Args:
        cv2: OpenCV.
        first: contrast of the frame that is moved, `(h, w)` bytes.
        second: likewise of the other one.
        similarity: `(2, 3)`, maps pixels of the first frame to those of the second.

    Returns:
        How well they agree where both show the scene.
    """
    height, width = second.shape
    moved = cv2.warpAffine(first, similarity, (width, height), flags=cv2.INTER_LINEAR)
    blocks = _Blocks.of(height, width)
    textured, correlation = _correlations(cv2, moved, second, blocks)
    is_compared = textured & blocks.shown_by(similarity)
    compared = correlation[is_compared]
    median = float(np.median(compared)) if len(compared) else -1.0
    elsewhere = blocks.spread(is_compared & (correlation < _ALIKE))
    return Agreement(len(compared), int((compared >= _ALIKE).sum()), median, elsewhere)


def largest_change(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Find the largest mean difference of a block of two frames of one size, in grey values."""
    difference = np.abs(first.astype(np.int16) - second)
    rows = np.array_split(difference, min(_BLOCKS[1], len(difference)))
    means = []
    for row in rows:
        blocks = np.array_split(row, min(_BLOCKS[0], row.shape[1]), axis=1)
        means += [float(block.mean()) for block in blocks]
    return max(means)


class _Blocks(NamedTuple):
    """Blocks of a frame `(height, width)`, by the edges between them."""

    down: NDArray[np.intp]
    across: NDArray[np.intp]

    @classmethod
    def of(cls, height: int, width: int) -> "_Blocks":
        """Divide a frame into blocks of nearly the same size."""
        columns, rows = _BLOCKS
        return cls(np.linspace(0, height, rows + 1).astype(np.intp), np.linspace(0, width, columns + 1).astype(np.intp))

    @property
    def pixels(self) -> NDArray[np.intp]:
        """Number of pixels of each, `(rows, columns)`."""
        return np.outer(np.diff(self.down), np.diff(self.across))

    def sums(self, table: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum over each by a table of sums over all rectangles from the corner, `(height + 1, width + 1)`."""
        corners = table[np.ix_(self.down, self.across)]
        return np.diff(np.diff(corners, axis=0), axis=1)

    def spread(self, chosen: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Mark the pixels of some of them `(rows, columns)` with 255."""
        rows = np.repeat(chosen, np.diff(self.down), axis=0)
        return np.repeat(rows, np.diff(self.across), axis=1).astype(np.uint8) * 255

    def shown_by(self, similarity: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which of them another frame of this size shows as a whole, if a similarity `(2, 3)` moves it here."""
        back = np.linalg.inv(np.vstack([similarity, (0.0, 0.0, 1.0)]))
        sizes = self.across[-1], self.down[-1]
        # A block is convex, so its corner pixels tell. They are taken from the nearest pixel of the other frame.
        inside = []
        for y in (self.down[:-1], self.down[1:] - 1):
            for x in (self.across[:-1], self.across[1:] - 1):
                columns, rows = np.meshgrid(x, y)
                places = np.stack([columns, rows, np.ones_like(rows)])
                origin = np.rint(np.einsum("ij,jkl->ikl", back[:2], places))
                inside.append(((origin >= 0) & (origin < np.reshape(sizes, (2, 1, 1)))).all(0))
        return np.logical_and.reduce(inside) & (self.pixels > 0)


def _correlations(
    cv2: Any, first: NDArray[np.uint8], second: NDArray[np.uint8], blocks: _Blocks
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
    (a, aa), (b, bb) = (map(blocks.sums, cv2.integral2(frame)) for frame in (first, second))
    ab = blocks.sums(cv2.integral(products))
    # n² times variances and covariance: whole numbers below 2⁵³, so that a block of one grey value has exactly 0.
    count = blocks.pixels.astype(np.float64)
    variance_a = count * aa - a.astype(np.float64) ** 2
    variance_b = count * bb - b.astype(np.float64) ** 2
    covariance = count * ab - a.astype(np.float64) * b
    spread = np.sqrt(variance_a) * np.sqrt(variance_b)
    correlation = np.divide(covariance, spread, out=np.zeros_like(spread), where=spread > 0)
    has_texture = np.sqrt(np.maximum(variance_a, variance_b)) >= _TEXTURE * count
    return has_texture, correlation

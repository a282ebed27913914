"""The motion of a camera from frame to frame, estimated from the frames by sparse optical flow.

    key frame ────── `_key_to_last` ──────► last frame ── the step ──► present frame
    `_key`    ──────────────── estimated, from `_key_to_last` on ────►

The step is the motion from the key frame to the present frame, with the motion to the last frame taken off. Where the
present frame fits neither the key frame nor the last one, it becomes the key frame. The last frame before is then kept
as `_lost` for some frames, and each of them is compared with it, too: `CameraStep.recovered` says where it was found.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.errors import needing
from semfov.motion.motion import Motion

_LONGER = 480  # longer side in pixels of the reduced frames that are compared
_CORNERS = 150  # most corners that are followed
_QUALITY = 0.01  # least quality of a corner, as a share of the best one's
_APART = 8  # least distance between two corners, in reduced pixels
_WINDOW = (15, 15)  # window of the flow around a corner, in reduced pixels
_PYRAMID = 3  # further levels of the flow's pyramid: it follows shifts of about 15 · 2³ reduced pixels
_RESIDUAL = 1.5  # reduced pixels within which a corner agrees with a motion

_STILL = np.eye(3)
_STILL_SHIFT = 0.3  # pixels of the frame: a camera that moves less stands still
_LEAST_IN_VIEW = 0.6  # share of a key frame in view below which there is a new one

_LEAST_CORNERS = 12  # fewer that agree are no evidence
_LEAST_SHARE = 0.4  # least share of the followed corners that agree
_MOST_SCALE = 1.3  # largest change of scale between two frames
_MOST_TURN = 25.0  # largest turn between two frames, in degrees

_SAME = 6.0  # largest mean change of a block, in grey values, of a frame without texture that has not changed
_BLOCKS = (8, 5)  # columns and rows of blocks in which two frames are compared
_TEXTURE = 3.0  # least standard deviation of the grey values of a block that can be compared
_ALIKE = 0.6  # correlation from which on a block agrees
_LEAST_BLOCKS = 6  # fewer blocks that can be compared are no evidence
_LEAST_AGREEING = 0.6  # least share of the compared blocks that agree


class CameraStep(NamedTuple):
    """How the camera moved from the last frame to the present one.

    Attributes:
        motion: maps pixels of the last frame to those of this one; None where the two do not fit together.
        recovered: maps pixels of the last frame before a disturbance to those of this one, once the two fit.
        waits: whether frames before a disturbance may still be found again.

    >>> first, second = CameraStep(Motion.similarity(shift=(3, 0))), CameraStep(Motion.similarity(shift=(0, 4)))
    >>> first.then(second).motion.matrix[:2, 2].tolist()
    [3.0, 4.0]
    """

    motion: Motion | None
    recovered: Motion | None = None
    waits: bool = False

    @property
    def is_still(self) -> bool:
        """Whether nothing has moved, and nothing was lost."""
        return self.motion is not None and self.recovered is None and self.motion.is_still

    def then(self, later: "CameraStep") -> "CameraStep":
        """Compose the steps of two successive frames.

        Args:
            later: the step after this one.

        Returns:
            The step from the frame before this one to the frame of the later one.
        """
        motion = None if self.motion is None or later.motion is None else self.motion.then(later.motion)
        recovered = later.recovered
        if recovered is None and self.recovered is not None and later.motion is not None:
            recovered = self.recovered.then(later.motion)
        return CameraStep(motion, recovered, later.waits)


class KnownPoses:
    """How the camera moved by poses that are known: of a gimbal, a head, or a robot's odometry.

    >>> camera = KnownPoses()
    >>> camera.step([[1, 0, 0], [0, 1, 0]]).motion is None
    True
    >>> camera.step([[1, 0, 8], [0, 1, -2]]).motion.matrix[:2, 2].tolist()
    [8.0, -2.0]
    """

    def __init__(self) -> None:
        self._last: Motion | None = None

    def step(self, pose: Motion | ArrayLike) -> CameraStep:
        """Take the pose of the next frame.

        Args:
            pose: maps pixels of a frame that is the same for all poses, such as the first one, to pixels of this frame;
                a `Motion`, or its `(3, 3)` or `(2, 3)` matrix.

        Returns:
            The motion since the last frame; none for the first frame.
        """
        last = self._last
        self._last = Motion.of(pose)
        return CameraStep(None if last is None else last.inverse().then(self._last))


class _GreyFrame:
    """A frame reduced in size and to grey.

    Attributes:
        grey: `(h, w)` bytes.
        ratio: `(x, y)`, pixels of the frame for one of the reduced one.
    """

    def __init__(self, cv2: Any, frame: NDArray[np.uint8]) -> None:
        self._cv2 = cv2
        height, width = frame.shape[:2]
        factor = max(1.0, max(width, height) / _LONGER)
        size = max(1, round(width / factor)), max(1, round(height / factor))
        self.ratio = width / size[0], height / size[1]
        # A third of the values is left to average where the frame is grey first.
        self.grey = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)

    @cached_property
    def corners(self) -> NDArray[np.float32]:
        """Corners that can be followed, `(n, 1, 2)`."""
        corners = self._cv2.goodFeaturesToTrack(self.grey, _CORNERS, _QUALITY, _APART)
        return np.zeros((0, 1, 2), np.float32) if corners is None else corners


class CameraMotion:
    r"""Estimates how the picture of a scene moved since the last frame, or finds that two frames do not fit together.

    Corners of a key frame (Shi and Tomasi, 1994) are followed into the present one by pyramidal Lucas–Kanade flow
    (Bouguet, 2001), and a similarity is fitted to them by RANSAC (Fischler and Bolles, 1981); all three are OpenCV's.
    Errors add up from key frame to key frame alone; a frame becomes one when too few corners are left in view.

    A motion is believed if enough corners agree with it, if it is no leap of scale or turn, and if the key frame, moved
    by it, correlates with the present one in most blocks that have texture. Otherwise there is none: after a cut, in
    the dark, or behind something that fills the view. The next frames are then compared with the last one before it,
    too, for `patience` frames, so that a short disturbance loses nothing.

    A similarity describes a scene that is flat or far away. Parallax of near objects counts as their own motion.

    Args:
        patience: number of frames for which the last frame before a disturbance is kept.

    Raises:
        InputError: OpenCV is not installed.

    Example::

        camera = CameraMotion()
        for frame in frames:
            motion = camera.step(frame).motion  # None for the first frame, and where frames do not fit together
    """

    def __init__(self, patience: int = 12) -> None:
        with needing("OpenCV", "motion of the camera", "opencv-python-headless"):
            import cv2
        self._cv2: Any = cv2
        self.patience = patience
        self._key: _GreyFrame | None = None  # None before the first frame
        self._key_to_last = _STILL  # `(3, 3)`, motion from the key frame to the last frame, in reduced pixels
        self._last: _GreyFrame | None = None
        self._lost: _GreyFrame | None = None  # the last frame before a disturbance, while it may still be found
        self._waited = 0  # frames since that one

    def step(self, frame: NDArray[np.uint8]) -> CameraStep:
        """Take the next frame, and estimate its motion.

        Args:
            frame: `(h, w, 3)` bytes.

        Returns:
            The motion since the last frame; none for the first frame, and where the two do not fit together.
        """
        present = _GreyFrame(self._cv2, frame)
        last = self._last
        self._last = present
        if last is None or self._key is None:
            self._key = present
            return CameraStep(None)
        motion = self._since_last(self._key, last, present)
        if motion is None and self._lost is None:
            self._lost = last
            self._waited = 0
        if self._lost is None:
            return CameraStep(motion)
        recovered = self._recover(self._lost, present)
        return CameraStep(motion, recovered, waits=self._lost is not None)

    def _recover(self, lost: _GreyFrame, present: _GreyFrame) -> Motion | None:
        """Compare the present frame with the last one before a disturbance, which is given up after a while."""
        self._waited += 1
        similarity = self._between(lost, present, _STILL)
        if similarity is not None or self._waited >= self.patience:
            self._lost = None
        return None if similarity is None else _at_full_size(similarity, present.ratio)

    def _since_last(self, key: _GreyFrame, last: _GreyFrame, present: _GreyFrame) -> Motion | None:
        """Estimate the motion since the last frame, by the key frame or else by the last one, and renew the key."""
        key_to_present = self._between(key, present, self._key_to_last)
        if key_to_present is None and last is not key:
            key = last
            self._key_to_last = _STILL
            key_to_present = self._between(last, present, _STILL)
        if key_to_present is None:
            self._begin_at(present)
            # Nothing can be followed where there is no texture, and nothing moves where two frames are the same.
            return Motion.still() if _largest_change(last.grey, present.grey) < _SAME else None
        last_to_present = key_to_present @ np.linalg.inv(self._key_to_last)
        if _largest_shift(last_to_present, present.grey.shape) * max(present.ratio) < _STILL_SHIFT:
            return Motion.still()
        if _share_in_view(key_to_present, present.grey.shape) < _LEAST_IN_VIEW:
            self._begin_at(present)
        else:
            self._key = key
            self._key_to_last = key_to_present
        return _at_full_size(last_to_present, present.ratio)

    def _begin_at(self, frame: _GreyFrame) -> None:
        """Make a frame the key frame, from which nothing has moved."""
        self._key = frame
        self._key_to_last = _STILL

    def _between(
        self, first: _GreyFrame, present: _GreyFrame, guess: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Estimate the similarity `(3, 3)` between two reduced frames; None where they do not fit together."""
        if first.grey.shape != present.grey.shape or len(first.corners) < _LEAST_CORNERS:
            return None
        cv2 = self._cv2
        expected = cv2.transform(first.corners, guess[:2]).astype(np.float32)
        corners, status, _ = cv2.calcOpticalFlowPyrLK(
            first.grey,
            present.grey,
            first.corners,
            expected,
            winSize=_WINDOW,
            maxLevel=_PYRAMID,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        followed = status[:, 0] == 1
        if followed.sum() < _LEAST_CORNERS:
            return None
        similarity, agree = cv2.estimateAffinePartial2D(
            first.corners[followed], corners[followed], ransacReprojThreshold=_RESIDUAL
        )
        if similarity is None or not _is_plausible(similarity, int(agree.sum()), int(followed.sum())):
            return None
        if not self._correlates(first.grey, present.grey, similarity):
            return None
        return np.vstack([similarity, _STILL[2]])

    def _correlates(
        self, first: NDArray[np.uint8], present: NDArray[np.uint8], similarity: NDArray[np.float64]
    ) -> bool:
        """Tell whether a frame, moved, looks like the present one in most blocks with texture that both show."""
        cv2 = self._cv2
        height, width = present.shape
        moved = cv2.warpAffine(first, similarity, (width, height), flags=cv2.INTER_LINEAR)
        blocks = _Blocks.of(height, width)
        textured, correlation = _correlations(cv2, moved, present, blocks)
        compared = textured & blocks.shown_by(similarity)
        count = int(compared.sum())
        agreeing = int((correlation[compared] >= _ALIKE).sum())
        return count >= _LEAST_BLOCKS and agreeing >= _LEAST_AGREEING * count


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

    def shown_by(self, similarity: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which of them another frame of this size shows as a whole, if a similarity `(2, 3)` moves it here."""
        back = np.linalg.inv(np.vstack([similarity, _STILL[2]]))
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


def _is_plausible(similarity: NDArray[np.float64], agreeing: int, followed: int) -> bool:
    """Tell whether enough corners agree with a similarity `(2, 3)`, and it is no leap of scale or turn."""
    scale = float(np.hypot(similarity[0, 0], similarity[1, 0]))
    turn = float(np.degrees(np.arctan2(similarity[1, 0], similarity[0, 0])))
    has_support = agreeing >= max(_LEAST_CORNERS, _LEAST_SHARE * followed)
    return has_support and 1 / _MOST_SCALE <= scale <= _MOST_SCALE and abs(turn) <= _MOST_TURN


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


def _at_full_size(similarity: NDArray[np.float64], ratio: tuple[float, float]) -> Motion:
    """Convert the motion of a reduced copy to that of the frame; pixel 0 of the copy is the mean of its first ones."""
    x_ratio, y_ratio = ratio
    enlarge = np.array([[x_ratio, 0, (x_ratio - 1) / 2], [0, y_ratio, (y_ratio - 1) / 2], [0, 0, 1]])
    return Motion(enlarge @ similarity @ np.linalg.inv(enlarge))


def _largest_change(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Find the largest mean difference of a block of two frames, in grey values; infinite for other sizes."""
    if first.shape != second.shape:
        return float("inf")
    difference = np.abs(first.astype(np.int16) - second)
    rows = np.array_split(difference, min(_BLOCKS[1], len(difference)))
    means = []
    for row in rows:
        blocks = np.array_split(row, min(_BLOCKS[0], row.shape[1]), axis=1)
        means += [float(block.mean()) for block in blocks]
    return max(means)


def _corners_of(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """List the corners of a frame `(h, w)`, homogeneous, `(3, 4)`."""
    height, width = shape
    return np.array([[0, width, 0, width], [0, 0, height, height], [1, 1, 1, 1]], dtype=np.float64)


def _largest_shift(similarity: NDArray[np.float64], shape: tuple[int, ...]) -> float:
    """Compute how far a similarity moves a corner of the frame at most, in pixels."""
    corners = _corners_of(shape)
    return float(np.linalg.norm((similarity @ corners - corners)[:2], axis=0).max())


def _share_in_view(similarity: NDArray[np.float64], shape: tuple[int, ...]) -> float:
    """Estimate the share of a frame that is still in view after a motion, by the upright box around it."""
    height, width = shape
    x, y, _ = similarity @ _corners_of(shape)
    width_share = max(min(x.max(), width) - max(x.min(), 0), 0) / width
    height_share = max(min(y.max(), height) - max(y.min(), 0), 0) / height
    return float(width_share * height_share)

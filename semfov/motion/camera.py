"""The motion of a camera from frame to frame, estimated from the frames by sparse optical flow.

    key frame ─────── `key_to_last` ──────► last frame ── the step ──► present frame
    `key`     ───────────────── estimated, from `key_to_last` on ────►

The step is the motion from the key frame to the present frame, with the motion to the last frame taken off. Where the
present frame fits neither the key frame nor the last one, it becomes the key frame. The key frame before is then kept
as `_lost` for some frames, and each of them is compared with it, too: `CameraStep.recovered` says where it was found.
Where only the last frame fits, that one becomes the key frame. The anchor stays the first key frame of the scene: it
tells whether the scene has been exchanged little by little. Invariant: the key frame is not before the anchor.
"""

from itertools import product
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.errors import needing
from semfov.motion.agreement import agreement, blocks_of_rival, largest_change
from semfov.motion.flow import LEAST_CORNERS, corners_stay, flow_between, rival_between
from semfov.motion.frames import GreyFrame, in_grey
from semfov.motion.motion import Motion
from semfov.motion.patches import PatchFlow
from semfov.motion.residual import coarse_shift, share_off, whole_shift

_STILL = np.eye(3)
_STILL_SHIFT = 0.3  # pixels of the frame: a camera that has moved less since its last reported motion stands still
_LEAST_IN_VIEW = 0.6  # share of a key frame in view below which there is a new one

_NO_SHIFT = 0.03  # reduced pixels by which a whole frame moves at most where a camera begins to stand before a pattern
_SAME = 6.0  # largest mean change of a block, in grey values, of a frame that has not changed
_EQUAL = 2  # largest change of a pixel, in grey values, of a frame that has not changed though it has no texture
_CLEAR = 0.93  # correlation of the blocks from which on the fine detail alone is enough
_COARSE_SHIFT = 0.4  # reduced pixels by which what is coarse may move otherwise than the fine detail
_AS_GOOD = 0.02  # by so much they correlate less, at most, where the camera may have stood still as well
_AHEAD = 0.1  # by so much the blocks correlate better than after a shift by which the frame repeats itself
_STEADY = 4.0  # reduced pixels by which a motion that goes on differs from the last one at most: a hand is unsteady
_MOST_OFF = 1 / 8  # share of the blocks, a row of them, that are off where a motion is one of two
_GOING_ON = 2  # number of blocks that move as before from which on another motion is not that of the camera


class CameraStep(NamedTuple):
    """How the camera moved from the last frame to the present one.

    Attributes:
        motion: maps pixels of the last frame to those of this one; None where the two do not fit together.
        recovered: maps pixels of the last frame before a disturbance to those of this one, once the two fit.
        waits: whether frames before a disturbance may still be found again.
        gives_up: whether they are no longer looked for, as none of the frames up to this one fits them.

    >>> CameraStep(Motion.similarity(shift=(3, 0))).is_still
    False
    """

    motion: Motion | None
    recovered: Motion | None = None
    waits: bool = False
    gives_up: bool = False

    @property
    def is_still(self) -> bool:
        """Whether the camera stood still, and no scene was lost, found again or given up."""
        if self.recovered is not None or self.gives_up:
            return False
        return self.motion is not None and self.motion.is_still


class KnownPoses:
    """Motion of a camera from known poses: of a gimbal, a head, or a robot's odometry.

    With known poses no scene is ever lost: from the second frame on each step has a motion, and none waits, recovers or
    gives up. A stream with poses is thus never `lost`, also where the frames show something else.

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


class _Fit(NamedTuple):
    """The motion between two reduced frames, `(3, 3)`, and the one that another part of them has in common, if any.

    `median` is that of the blocks' correlations, and `is_repeated` tells whether it is nearly as high a period away.
    """

    similarity: NDArray[np.float64]
    rival: NDArray[np.float64] | None
    median: float
    is_repeated: bool = False


class _Scene(NamedTuple):
    """What is in view: its frames, and the motions `(3, 3)` from two of them to the last one, in reduced pixels.

    Attributes:
        key: the key frame.
        anchor: the first key frame of what has been in view since then.
        last: the last frame.
        key_to_last: motion from the key frame.
        anchor_to_last: motion from the anchor.
    """

    key: GreyFrame
    anchor: GreyFrame
    last: GreyFrame
    key_to_last: NDArray[np.float64] = _STILL
    anchor_to_last: NDArray[np.float64] = _STILL

    @classmethod
    def of(cls, frame: GreyFrame) -> "_Scene":
        """Begin with a frame, from which nothing has moved."""
        return cls(frame, frame, frame)

    @property
    def has_moved(self) -> bool:
        """Whether the camera has moved since the key frame."""
        return not np.array_equal(self.key_to_last, _STILL)


class _LostScene:
    """The scene before a disturbance, and the number of frames since then, `waited`."""

    def __init__(self, scene: _Scene) -> None:
        self.scene = scene
        self.waited = 0


class CameraMotion:
    r"""Estimates the motion from frame to frame, or finds that a frame matches no earlier one.

    Corners of a key frame (Shi and Tomasi, 1994) are followed into the present one by pyramidal Lucas–Kanade flow
    (Bouguet, 2001), and a similarity is fitted to them by RANSAC (Fischler and Bolles, 1981); all three are OpenCV's.
    Errors add up from key frame to key frame alone; a frame becomes one when too few corners are left in view.

    A motion is believed if enough corners agree with it, if it is no leap of scale or turn, and if the key frame, moved
    by it, correlates with the present one in most blocks that have texture. It is doubted

    - if the key frame correlates nearly as well a period away, as bricks and rows of windows do, unless all of it is
      where it was to some hundredths of a pixel, or the camera has stood before it;
    - if a part of the frame moves otherwise, until the motion goes on nearly as before: that may be a lorry before the
      camera, or all that is left of the scene behind one. A part is a motion that corners have in common, blocks
      that move as the frames before did, or a row of blocks that are off;
    - if what is coarse moves otherwise than its edges, as in a film that was compressed too much;
    - if the picture of the key frame has gone little by little, as in a dissolve;
    - if there is nothing to follow, unless the frame is the same: in the dark, before a clear sky, or before blinds.

    Before a pattern that repeats itself, a camera that moved by whole periods from frame to frame would seem to stand.

    A doubted motion is none. The next frames are then compared with the key frame before it, too, for `patience`
    frames, so that a short disturbance loses nothing.

    A motion of less than 0.3 px of the frame (`_STILL_SHIFT`) is none. A slow drift is not lost by that: the key frame
    stays as it is, so that against it the drift adds up, and it is reported in steps of about 0.3 px.

    A similarity describes a scene that is flat or far away. Parallax of near objects counts as their own motion: the
    first frames behind them are doubted.

    Args:
        patience: number of frames, from the first disturbed one on, for which what was seen before is kept.

    Attributes:
        flow: follows parts of the last frame into the present one that move on their own.

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
        self._cv2: ModuleType = cv2
        self.patience = patience
        self.flow = PatchFlow()
        self._scene: _Scene | None = None  # None before the first frame
        self._stands_still = False  # whether the camera stood still between the last two frames
        self._course: NDArray[np.float64] | None = None  # the last motion between two frames, in reduced pixels
        self._lost: _LostScene | None = None  # what was seen before a disturbance, while it may still be found

    def step(self, frame: NDArray[np.uint8]) -> CameraStep:
        """Take the next frame, and estimate its motion.

        Args:
            frame: `(h, w, 3)` bytes.

        Returns:
            The motion since the last frame; none for the first frame, and where the two do not fit together.
        """
        grey = in_grey(self._cv2, frame)
        self.flow.step(grey)
        present = GreyFrame(self._cv2, grey)
        scene = self._scene
        if scene is None:
            self._scene = _Scene.of(present)
            return CameraStep(None)
        motion = self._since_last(scene, present)
        if motion is None and self._lost is None:
            self._lost = _LostScene(scene)
        if self._lost is None:
            return CameraStep(motion)
        recovered = self._recover(self._lost, present)
        waits = self._lost is not None
        return CameraStep(motion, recovered, waits=waits, gives_up=recovered is None and not waits)

    def _recover(self, lost: _LostScene, present: GreyFrame) -> Motion | None:
        """Compare the present frame with what was seen before a disturbance, which is given up after a while."""
        lost.waited += 1
        key = lost.scene.key
        key_to_last = lost.scene.key_to_last
        fit = self._between(key, present, key_to_last)
        if fit is not None and self._is_found(key, present, fit):
            self._lost = None
            return _at_full_size(fit.similarity @ np.linalg.inv(key_to_last), present.ratio)
        if lost.waited >= self.patience:
            self._lost = None
            self._course = None
        return None

    def _is_found(self, key: GreyFrame, present: GreyFrame, fit: _Fit) -> bool:
        """Tell whether a motion since before a disturbance is the camera's: it has no rival, and few blocks are off."""
        if fit.is_repeated or fit.rival is not None:
            return False
        return share_off(self._cv2, key, present, fit.similarity[:2]) < _MOST_OFF

    def _since_last(self, scene: _Scene, present: GreyFrame) -> Motion | None:
        """Estimate the motion since the last frame, by the key frame or else by the last one, and renew the scene."""
        self._scene = scene._replace(last=present)  # stays so where the camera stands still
        has_stood = self._stands_still
        if has_stood and not scene.has_moved and self._stays(scene, present):
            # A camera that stood, and nearly all corners are where the key frame has them: told without a fit.
            return Motion.still()
        scene_of_fit, fit = self._fit_to_key_or_last(scene, present)
        self._stands_still = not scene.has_moved and self._shows_no_drift(scene.key, present, fit, has_stood=has_stood)
        if self._stands_still:
            # No motion or several fit, as before stripes, but all texture is where the key frame has it.
            return Motion.still()
        if fit is None:
            self._scene = _Scene.of(present)
            # Nothing can be followed, as in the dark, but the frame is the same; a slow drift is not seen here.
            return Motion.still() if self._is_same(scene.last, present) else None
        return self._by_fit(scene_of_fit, present, fit, has_stood=has_stood)

    def _by_fit(self, scene: _Scene, present: GreyFrame, fit: _Fit, *, has_stood: bool) -> Motion | None:
        """Judge a fitted motion, and keep it, or doubt it and begin anew at the present frame.

        Args:
            scene: what was in view, with the frame from which the motion was fitted as its key frame.
            present: the present frame.
            fit: the motion from the key frame to the present one.
            has_stood: whether the camera stood still in the last frame.

        Returns:
            The motion since the last frame; None for one that is doubted.
        """
        to_last = np.linalg.inv(scene.key_to_last)
        rival = None if fit.rival is None else fit.rival @ to_last
        since_last = _Fit(fit.similarity @ to_last, rival, fit.median)
        is_still = _largest_shift(since_last.similarity, present.grey.shape) * max(present.ratio) < _STILL_SHIFT
        is_believed = self._is_believed(since_last, scene, present, fit.similarity)
        if fit.is_repeated:
            is_believed = is_believed and is_still and self._repeats_in_place(scene.last, present, has_stood=has_stood)
        if not is_believed:
            self._scene = _Scene.of(present)
            # A doubted motion may be believed once it goes on, which is told by this one.
            if self._course is None:
                self._course = since_last.similarity
            return None
        self._course = since_last.similarity
        if is_still:
            # A motion was fitted but is too small. With `key_to_last` as it was, noise of a still camera does not
            # add up, but a slow drift does, until it is large enough.
            self._scene = scene._replace(last=present)
            self._stands_still = True
            return Motion.still()
        self._scene = _move(scene, fit.similarity, since_last.similarity, present)
        return _at_full_size(since_last.similarity, present.ratio)

    def _shows_no_drift(self, unmoved: GreyFrame, present: GreyFrame, fit: _Fit | None, *, has_stood: bool) -> bool:
        """Tell whether the camera stands before a scene in which no motion can be fitted, or several fit.

        Stripes have no corners, or any motion along them fits. The key frame tells, so that a slow drift is seen.

        Args:
            unmoved: the key frame, from which the camera has not moved.
            present: the present frame.
            fit: the motion that was fitted; None: none fits.
            has_stood: whether the camera stood still in the last frame.
        """
        if fit is not None and not fit.is_repeated:
            return False
        least = _CLEAR if fit is None else max(_CLEAR, fit.median - _AS_GOOD)
        if not self._is_unchanged(unmoved, present, least):
            return False
        return has_stood or self._is_exactly_there(unmoved, present)

    def _repeats_in_place(self, last: GreyFrame, present: GreyFrame, *, has_stood: bool) -> bool:
        """Tell whether a pattern, which fits several motions, is where it was in the last frame.

        Args:
            last: the last frame.
            present: the present one.
            has_stood: whether the camera stood before the pattern in the last frame.
        """
        # Edges of the blocks of a broken film stay, too, but the blocks change.
        if largest_change(self._cv2, last.grey, present.grey) >= _SAME:
            return False
        return has_stood or self._is_exactly_there(last, present)

    def _is_exactly_there(self, first: GreyFrame, present: GreyFrame) -> bool:
        """Tell whether a pattern is where it was to a few hundredths of a pixel, as after a motion by a period rarely.

        A camera that has stood before the pattern may sway by more.
        """
        return whole_shift(self._cv2, first, present) < _NO_SHIFT

    def _is_believed(
        self, since_last: _Fit, scene: _Scene, present: GreyFrame, key_to_present: NDArray[np.float64]
    ) -> bool:
        """Tell whether a motion is the camera's: it goes on, or there is no other, and it explains all of the frame."""
        course = self._course
        if course is None:
            return since_last.rival is None and not self._is_divided(scene, present, key_to_present)
        shape = present.grey.shape
        change = _difference(since_last.similarity, course, shape)
        if since_last.rival is not None:
            return change < min(_STEADY, _difference(since_last.rival, course, shape))
        return change < _STEADY or not self._is_divided(scene, present, key_to_present)

    def _fit_to_key_or_last(self, scene: _Scene, present: GreyFrame) -> tuple[_Scene, _Fit | None]:
        """Fit the present frame to the key frame, or where it fits none to the last frame, which is the key then.

        A frame that fits the last one, but no longer the anchor, shows another scene that has come little by little.
        """
        expected = scene.key_to_last if self._course is None else self._course @ scene.key_to_last
        fit = self._between(scene.key, present, expected)
        if fit is not None or scene.last is scene.key:
            return scene, fit
        fit = self._between(scene.last, present, _STILL)
        is_replaced = fit is not None and self._is_replaced(scene, present, fit)
        return scene._replace(key=scene.last, key_to_last=_STILL), None if is_replaced else fit

    def _stays(self, scene: _Scene, present: GreyFrame) -> bool:
        """Tell whether a camera that stood still stands still, in a third of the time that another motion takes."""
        key = scene.key
        if key.grey.shape != present.grey.shape:
            return False
        found = agreement(self._cv2, key.contrast, present.contrast)
        if not found.is_enough or found.is_partial or found.median < _CLEAR:
            return False
        if key.repeats and largest_change(self._cv2, scene.last.grey, present.grey) >= _SAME:
            return False
        return corners_stay(self._cv2, key, present, _STILL_SHIFT / max(present.ratio))

    def _is_divided(self, scene: _Scene, present: GreyFrame, similarity: NDArray[np.float64]) -> bool:
        """Tell whether the motion from the key frame is one of two: blocks are off, or some move as before."""
        if share_off(self._cv2, scene.key, present, similarity[:2]) >= _MOST_OFF:
            return True
        if self._course is None:
            return False
        as_before = self._course @ scene.key_to_last
        count = blocks_of_rival(self._cv2, scene.key.contrast, present.contrast, similarity[:2], as_before[:2])
        return count >= _GOING_ON

    def _is_same(self, last: GreyFrame, present: GreyFrame) -> bool:
        """Tell whether nothing has changed between two frames, of which too few corners can be followed."""
        if last.grey.shape != present.grey.shape or largest_change(self._cv2, last.grey, present.grey) >= _SAME:
            return False
        # Noise hides a slow motion where there is no texture: a sky, or the dark.
        if int(self._cv2.absdiff(last.grey, present.grey).max()) <= _EQUAL:
            return True
        return len(last.corners) < LEAST_CORNERS and self._is_unchanged(last, present)

    def _is_unchanged(self, first: GreyFrame, present: GreyFrame, least: float = 0.0) -> bool:
        """Tell whether all texture of two frames is where it was, by a least correlation, and nothing else is new."""
        if first.grey.shape != present.grey.shape or largest_change(self._cv2, first.grey, present.grey) >= _SAME:
            return False
        found = agreement(self._cv2, first.contrast, present.contrast)
        return found.is_whole and found.median >= least

    def _is_replaced(self, scene: _Scene, present: GreyFrame, fit: _Fit) -> bool:
        """Tell whether another scene has come little by little, as in a dissolve; `fit` is that of the last frame."""
        anchor_to_present = fit.similarity @ scene.anchor_to_last
        return not agreement(self._cv2, scene.anchor.coarse, present.coarse, anchor_to_present[:2]).is_enough

    def _between(self, first: GreyFrame, present: GreyFrame, guess: NDArray[np.float64]) -> _Fit | None:
        """Estimate the motion between two reduced frames; None where they do not fit together."""
        cv2 = self._cv2
        similarity = flow_between(cv2, first, present, guess)
        if similarity is None:
            return None
        found = agreement(cv2, first.contrast, present.contrast, similarity[:2])
        if not found.is_enough:
            return None
        if found.median < _CLEAR and coarse_shift(cv2, first, present, similarity[:2]) > _COARSE_SHIFT:
            return None
        rival = rival_between(cv2, first, present, similarity, found.elsewhere) if found.is_partial else None
        is_repeated = self._fits_as_well(first, present, similarity, found.median - _AHEAD)
        return _Fit(similarity, rival, found.median, is_repeated)

    def _fits_as_well(
        self, first: GreyFrame, present: GreyFrame, similarity: NDArray[np.float64], least: float
    ) -> bool:
        """Tell whether two frames correlate by more than a least number a period of their pattern away, too."""
        for shift, sign in product(first.repeats, (-1, 1)):
            repeated = similarity.copy()
            repeated[:2, 2] += sign * similarity[:2, :2] @ shift
            if agreement(self._cv2, first.contrast, present.contrast, repeated[:2]).median > least:
                return True
        return False


def _move(
    scene: _Scene, key_to_present: NDArray[np.float64], last_to_present: NDArray[np.float64], present: GreyFrame
) -> _Scene:
    """Move on by a believed motion; a frame that shows little of the anchor begins anew.

    The motions of a camera that stands do not come here: their noise would add up.
    """
    anchor_to_present = last_to_present @ scene.anchor_to_last
    if _share_in_view(anchor_to_present, present.grey.shape) < _LEAST_IN_VIEW:
        return _Scene.of(present)
    return scene._replace(last=present, key_to_last=key_to_present, anchor_to_last=anchor_to_present)


def _difference(first: NDArray[np.float64], second: NDArray[np.float64], shape: tuple[int, ...]) -> float:
    """Compute how far apart two motions take the corners of a frame, in the mean."""
    return float(np.linalg.norm(((first - second) @ _corners_of(shape))[:2], axis=0).mean())


def _at_full_size(similarity: NDArray[np.float64], ratio: tuple[float, float]) -> Motion:
    """Convert the motion of a reduced copy to that of the frame; pixel 0 of the copy is the mean of its first ones."""
    x_ratio, y_ratio = ratio
    enlarge = np.array([[x_ratio, 0, (x_ratio - 1) / 2], [0, y_ratio, (y_ratio - 1) / 2], [0, 0, 1]])
    return Motion(enlarge @ similarity @ np.linalg.inv(enlarge))


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

"""The camera of a stream: how it moves between frames, by poses or by the frames themselves."""

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semfov.data.large import ArrayPicture
from semfov.errors import InputError, check
from semfov.motion import CameraMotion, CameraStep, KnownPoses, Motion
from semfov.motion.patches import PatchFlow
from semfov.zoom.eye import WindowView


class StreamCamera:
    """The motion of the camera between frames, from given poses, or estimated from the frames.

    The first frame decides: with a pose there is one of each frame (`_has_poses`), and without one `_estimate` is made,
    where the camera is followed. Either way `flow` follows objects. It reads all of a frame, so that with poses it is
    made only where the first frame is in memory.

    Args:
        follows: whether its motion is estimated from the frames, where no poses are given.

    Attributes:
        flow: follows objects that move on their own, from the first frame on; None where the camera's motion is not
            known, and without OpenCV.
    """

    def __init__(self, *, follows: bool) -> None:
        self._follows = follows
        self._estimate: CameraMotion | None = None
        self._has_poses = False
        self._poses = KnownPoses()
        self.flow: PatchFlow | None = None
        self._is_first = True  # whether no frame was seen

    @property
    def is_followed(self) -> bool:
        """Whether the motion of the camera is given or estimated at all."""
        return self._estimate is not None or self._has_poses

    def step(self, view: WindowView, pose: Motion | ArrayLike | None) -> CameraStep | None:
        """Take the next frame, with its pose if known, and return the motion since the last frame, if known."""
        if self._is_first:
            self._begin(view, is_pose_known=pose is not None)
        self._is_first = False
        check(self._has_poses == (pose is not None), "pose", "a pose of each frame, or of none", pose)
        if self._estimate is not None:
            return self._estimate.step(_pixels(view))
        if pose is None:
            return None
        step = self._poses.step(pose)  # first, as a pose may be refused
        if self.flow is not None:
            self.flow.step(_pixels(view))
        return step

    def _begin(self, view: WindowView, *, is_pose_known: bool) -> None:
        """Make what tells the motion of the camera, and what follows objects."""
        self._has_poses = is_pose_known
        if is_pose_known:
            self.flow = _patch_flow() if isinstance(view.picture, ArrayPicture) else None
        elif self._follows:
            self._estimate = _camera_motion()
            self.flow = None if self._estimate is None else self._estimate.flow


def _pixels(view: WindowView) -> NDArray[np.uint8]:
    """Read all of a frame, `(h, w, 3)` bytes."""
    width, height = view.picture.size
    return view.picture.pixels((0, 0, width, height))


def _patch_flow() -> PatchFlow | None:
    """Make what follows objects; without OpenCV nothing does, and no warning, as known poses need none."""
    try:
        return PatchFlow()
    except InputError:
        return None


def _camera_motion() -> CameraMotion | None:
    """Make what follows a camera that moves; without OpenCV a warning, and the camera is taken to stand still."""
    try:
        return CameraMotion()
    except InputError as error:
        warnings.warn(f"the camera is taken to stand still, unless poses are given: {error}", stacklevel=2)
        return None

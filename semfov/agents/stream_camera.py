"""The camera of a stream: how it moves between frames, by poses or by the frames themselves."""

import warnings

from numpy.typing import ArrayLike

from semfov.errors import InputError, check
from semfov.motion import CameraMotion, CameraStep, KnownPoses, Motion
from semfov.motion.patches import PatchFlow
from semfov.zoom.eye import WindowView


class StreamCamera:
    """How the camera moves between frames: by the poses that are given, or estimated from the frames.

    The first frame decides: with a pose `_poses` is made, and without one `_estimate`, where the camera is followed.

    Args:
        follows: whether its motion is estimated from the frames, where no poses are given.
    """

    def __init__(self, *, follows: bool) -> None:
        self._follows = follows
        self._estimate: CameraMotion | None = None
        self._poses: KnownPoses | None = None
        self._is_first = True  # whether no frame was seen

    @property
    def is_followed(self) -> bool:
        """Whether its motion is known at all, from the first frame on."""
        return self._estimate is not None or self._poses is not None

    @property
    def flow(self) -> PatchFlow | None:
        """What follows objects that move on their own; None where the camera's motion is not estimated."""
        return None if self._estimate is None else self._estimate.flow

    def step(self, view: WindowView, pose: Motion | ArrayLike | None) -> CameraStep | None:
        """Take the next frame, with its pose if that is known; returns the motion since the frame before, if it is."""
        is_pose_expected = self._is_first or (self._poses is None) == (pose is None)
        check(is_pose_expected, "pose", "a pose of each frame, or of none", pose)
        # Without OpenCV a warning is given, which does not concern a camera whose poses are known.
        if self._is_first and pose is None and self._follows:
            self._estimate = _camera_motion()
        self._is_first = False
        if pose is not None:
            self._poses = self._poses or KnownPoses()
            return self._poses.step(pose)
        if self._estimate is None:
            return None
        width, height = view.picture.size
        return self._estimate.step(view.picture.pixels((0, 0, width, height)))


def _camera_motion() -> CameraMotion | None:
    """Make what follows a camera that moves; without OpenCV a warning, and the camera is taken to stand still."""
    try:
        return CameraMotion()
    except InputError as error:
        warnings.warn(f"the camera is taken to stand still, unless poses are given: {error}", stacklevel=2)
        return None

"""The motion of a camera between the frames of a stream: where a place of the scene was, and where it is now."""

from semfov.motion.camera import CameraMotion, CameraStep, KnownPoses
from semfov.motion.lost_scene import LostScene
from semfov.motion.motion import Motion, moved_boxes

__all__ = ["CameraMotion", "CameraStep", "KnownPoses", "LostScene", "Motion", "moved_boxes"]

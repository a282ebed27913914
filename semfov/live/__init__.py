"""Active perception of a camera or a video: one look at every frame, and evidence that fades between frames."""

from semfov.live.base import FramePerception
from semfov.live.fovea import RATE, FovealPerception
from semfov.live.perception import LivePerception
from semfov.live.windows import WINDOW_RATE, WindowPerception

__all__ = [
    "RATE",
    "WINDOW_RATE",
    "FovealPerception",
    "FramePerception",
    "LivePerception",
    "WindowPerception",
]

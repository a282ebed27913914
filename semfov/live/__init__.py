"""Active perception of a camera or a video: one look at every frame, and evidence that fades between frames."""

from semfov.live.base import FramePerception
from semfov.live.fovea import RATE, FovealPerception
from semfov.live.perception import LivePerception
from semfov.live.rate import WARM_UP, FrameRate
from semfov.live.windows import WINDOW_RATE, WindowPerception

__all__ = [
    "RATE",
    "WARM_UP",
    "WINDOW_RATE",
    "FovealPerception",
    "FramePerception",
    "FrameRate",
    "LivePerception",
    "WindowPerception",
]

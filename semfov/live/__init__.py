"""Active perception of a camera or a video: one look at every frame, and evidence that fades between frames."""

from semfov.live.perception import LivePerception
from semfov.live.rate import WARM_UP, FrameRate

__all__ = ["WARM_UP", "FrameRate", "LivePerception"]

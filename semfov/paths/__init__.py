"""Records of what happened: looks, detections, beliefs and decisions of searches and explorations."""

from semfov.paths.base import Moment, Record
from semfov.paths.drafts import Drafts
from semfov.paths.files import Ending
from semfov.paths.gaze import GazePrediction
from semfov.paths.head import HeadPath
from semfov.paths.look import RecordedLook
from semfov.paths.scanpath import FoveaMoment, Scanpath
from semfov.paths.windows import WindowMoment, ZoomPath
from semfov.paths.words import Words

__all__ = [
    "Drafts",
    "Ending",
    "FoveaMoment",
    "GazePrediction",
    "HeadPath",
    "RecordedLook",
    "Moment",
    "Record",
    "Scanpath",
    "WindowMoment",
    "Words",
    "ZoomPath",
]

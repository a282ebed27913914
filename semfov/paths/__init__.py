"""Records of what happened: looks, detections, beliefs and decisions of searches and explorations."""

from semfov.paths.base import Record
from semfov.paths.endings import Ending
from semfov.paths.gaze import GazePrediction
from semfov.paths.head import HeadPath
from semfov.paths.look import RecordedLook
from semfov.paths.moment import FoveaMoment, Moment, WindowMoment
from semfov.paths.scanpath import Scanpath
from semfov.paths.windows import ZoomPath

__all__ = [
    "Ending",
    "FoveaMoment",
    "GazePrediction",
    "HeadPath",
    "RecordedLook",
    "Moment",
    "Record",
    "Scanpath",
    "WindowMoment",
    "ZoomPath",
]

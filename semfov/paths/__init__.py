"""Records of what happened: looks, detections, beliefs and decisions of searches and explorations."""

from semfov.paths.base import GazeRecord, Record
from semfov.paths.endings import Ending
from semfov.paths.gaze import GazePrediction
from semfov.paths.head import HeadPath
from semfov.paths.look import RecordedLook, detections_in_words
from semfov.paths.moment import FoveaMoment, Moment, WindowMoment
from semfov.paths.scanpath import Scanpath, Trace, trace
from semfov.paths.stimulus import Stimulus, reduced_copy, sensor_in_words
from semfov.paths.windows import ZoomPath

__all__ = [
    "Ending",
    "FoveaMoment",
    "GazePrediction",
    "GazeRecord",
    "HeadPath",
    "RecordedLook",
    "Moment",
    "Record",
    "Scanpath",
    "Stimulus",
    "Trace",
    "WindowMoment",
    "ZoomPath",
    "detections_in_words",
    "sensor_in_words",
    "reduced_copy",
    "trace",
]

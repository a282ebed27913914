"""Records of what happened: looks, detections, beliefs and decisions of searches and explorations."""

from semfov.paths.base import GazeRecord, Look, Record, detections_in_words
from semfov.paths.endings import Ending
from semfov.paths.head import HeadPath
from semfov.paths.moment import Moment
from semfov.paths.scanpath import Scanpath
from semfov.paths.stimulus import Stimulus, sensor_in_words, thumbnail
from semfov.paths.trace import trace
from semfov.paths.windows import ZoomPath

__all__ = [
    "Ending",
    "GazeRecord",
    "HeadPath",
    "Look",
    "Moment",
    "Record",
    "Scanpath",
    "Stimulus",
    "ZoomPath",
    "detections_in_words",
    "sensor_in_words",
    "thumbnail",
    "trace",
]

"""semfov: semantic active perception with foveal sensors."""

from semfov.agent import ActivePerception
from semfov.belief import Evidence, Grid, SemanticMap, fusion, weigh
from semfov.detection import Detections, Detector, Selection
from semfov.detection.load import load_detector
from semfov.errors import DataError, InputError, SemfovError
from semfov.gaze import acquisition, search_policy
from semfov.scanpath import Scanpath
from semfov.sensor import Foveation, foveate

__version__ = "0.1.0"

__all__ = [
    "ActivePerception",
    "DataError",
    "Detections",
    "Detector",
    "Evidence",
    "Foveation",
    "Grid",
    "InputError",
    "Scanpath",
    "Selection",
    "SemanticMap",
    "SemfovError",
    "acquisition",
    "foveate",
    "fusion",
    "load_detector",
    "search_policy",
    "weigh",
]

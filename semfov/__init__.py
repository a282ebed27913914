"""semfov: semantic active perception with foveal sensors."""

from semfov.belief import Evidence, Grid, SemanticMap, fusion, weigh
from semfov.detection import Detections, Detector, Selection
from semfov.errors import DataError, InputError, SemfovError
from semfov.gaze import acquisition, search_policy
from semfov.scanpath import Scanpath

__version__ = "0.1.0"

__all__ = [
    "DataError",
    "Detections",
    "Detector",
    "Evidence",
    "Grid",
    "InputError",
    "Scanpath",
    "Selection",
    "SemanticMap",
    "SemfovError",
    "acquisition",
    "fusion",
    "search_policy",
    "weigh",
]

"""semfov: semantic active perception with foveal sensors."""

from typing import TYPE_CHECKING, Any

from semfov.agent import ActivePerception
from semfov.belief import DirichletBelief, Evidence, Grid, SemanticMap, TargetEvidence, fusion, weigh
from semfov.data import EmbeddedScenes, read_image
from semfov.detection import Detections, Detector, Selection
from semfov.detection.load import load_detector
from semfov.errors import DataError, InputError, SemfovError
from semfov.eye import Eye
from semfov.gaze import acquisition, exploration_policy, saliency, search_policy
from semfov.observation import DirichletStatistics, FovealObservationModel, dirichlet
from semfov.scanpath import Scanpath
from semfov.sensor import Foveation, foveate

if TYPE_CHECKING:
    from semfov.data import CocoScenes

__version__ = "0.1.0"

__all__ = [
    "ActivePerception",
    "CocoScenes",
    "DataError",
    "Detections",
    "Detector",
    "DirichletBelief",
    "DirichletStatistics",
    "EmbeddedScenes",
    "Evidence",
    "Eye",
    "FovealObservationModel",
    "Foveation",
    "Grid",
    "InputError",
    "Scanpath",
    "Selection",
    "SemanticMap",
    "SemfovError",
    "TargetEvidence",
    "acquisition",
    "dirichlet",
    "exploration_policy",
    "foveate",
    "fusion",
    "load_detector",
    "read_image",
    "saliency",
    "search_policy",
    "weigh",
]


def __getattr__(name: str) -> Any:
    if name == "CocoScenes":
        # `semfov.data.coco` is also a program: Python warns when it has been imported before it is run.
        from semfov.data.coco import CocoScenes

        return CocoScenes
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""semfov looks at pictures as eyes do: piece by piece, where it pays.

One agent takes a photograph, a picture of any size, a panorama or a camera, and chooses how to look at it::

    agent = semfov.ActivePerception.recommended()
    agent.search("kitchen.jpg", "cup").decision  # is there a cup, and where?
    agent.find_all("harbour.jpg", "person", passes=16).objects  # all people of a large picture
    agent.explore("kitchen.jpg").plot()  # what is where
    agent.search(semfov.Panorama("street.jpg"), "bicycle")  # turns its head
    agent.live("cup").step(frame)  # a look at each frame of a camera

Its records print, draw, save and convert themselves. The command `semfov` does the same from a shell, and `semfov fit`
fits the agent to a detector of your own. Each part is also a function or a differentiable module: `semfov.foveate`,
`semfov.fusion`, `semfov.acquisition`, `semfov.rollout`.
"""

from typing import TYPE_CHECKING, Any

import semfov.cli.start  # noqa: F401 (before what takes long to import)
from semfov.agent import ActivePerception
from semfov.agents import HeadAgent, ZoomAgent
from semfov.belief import Belief, DirichletBelief, Grid, MapEvidence, TargetEvidence, fusion, observers
from semfov.data import EmbeddedScenes, as_image, read_image
from semfov.detection import Detections, Detector, Objects, Selection, merge_boxes
from semfov.detection.load import load_detector
from semfov.episode import rollout
from semfov.errors import DataError, InputError, SemfovError
from semfov.eye import Eye
from semfov.gaze import acquisition, policies, saliency
from semfov.head import Flat, Panorama
from semfov.observation import DirichletStatistics, FovealObservationModel, dirichlet
from semfov.paths import Scanpath
from semfov.report import notebook as _notebook  # noqa: F401 (scanpaths are drawn there)
from semfov.sensor import Foveation, foveate
from semfov.version import __version__
from semfov.zoom import WindowEye

if TYPE_CHECKING:
    from semfov.data import CocoScenes
    from semfov.fit.detector import fit_detector

__all__ = [
    "ActivePerception",
    "Belief",
    "CocoScenes",
    "DataError",
    "Detections",
    "Detector",
    "DirichletBelief",
    "DirichletStatistics",
    "EmbeddedScenes",
    "Eye",
    "FovealObservationModel",
    "Flat",
    "Foveation",
    "Grid",
    "HeadAgent",
    "InputError",
    "MapEvidence",
    "Objects",
    "Panorama",
    "Scanpath",
    "Selection",
    "SemfovError",
    "TargetEvidence",
    "ZoomAgent",
    "WindowEye",
    "__version__",
    "acquisition",
    "as_image",
    "dirichlet",
    "fit_detector",
    "foveate",
    "fusion",
    "load_detector",
    "merge_boxes",
    "observers",
    "policies",
    "read_image",
    "rollout",
    "saliency",
]


def __getattr__(name: str) -> Any:
    if name == "CocoScenes":
        # `semfov.data.coco` is also a program: Python warns if it is imported before it is run.
        from semfov.data.coco import CocoScenes

        return CocoScenes
    if name == "fit_detector":
        # Training needs imports that would make the import of the package slow.
        from semfov.fit.detector import fit_detector

        return fit_detector
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

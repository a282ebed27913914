"""A head that turns: scenes larger than the eye's field of view, seen through one window at a time."""

from semfov.head.belief import SceneBelief, SceneObserver
from semfov.head.camera import CameraFrame, CameraScene, PanTiltCamera, is_scene, open_scene
from semfov.head.gain import ExploreGain, PerSecond, Scan, SearchGain
from semfov.head.panoramas import Panoramas
from semfov.head.scenes import Boxes, Flat, Panorama
from semfov.head.speeds import Speeds
from semfov.head.sphere import Sphere
from semfov.head.views import Views
from semfov.head.world import World

__all__ = [
    "Boxes",
    "CameraFrame",
    "CameraScene",
    "ExploreGain",
    "Flat",
    "PanTiltCamera",
    "Panorama",
    "Panoramas",
    "PerSecond",
    "Scan",
    "SceneBelief",
    "SceneObserver",
    "SearchGain",
    "Speeds",
    "Sphere",
    "Views",
    "World",
    "is_scene",
    "open_scene",
]

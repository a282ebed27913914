"""A head that turns: scenes larger than the eye's field of view, seen through one window at a time."""

from semfov.head.belief import SceneBelief, SceneObserver
from semfov.head.gain import ExploreGain, PerPrice, Scan, SearchGain
from semfov.head.panoramas import Panoramas
from semfov.head.speeds import Speeds
from semfov.head.views import Views
from semfov.head.world import Boxes, Flat, Panorama, World

__all__ = [
    "Boxes",
    "ExploreGain",
    "Flat",
    "Panorama",
    "Panoramas",
    "PerPrice",
    "Scan",
    "SceneBelief",
    "SceneObserver",
    "SearchGain",
    "Speeds",
    "Views",
    "World",
]

"""A head that turns: scenes larger than the eye's field of view, seen through one window at a time."""

from semfov.head.camera import CameraFrame, PanTiltCamera, open_scene
from semfov.head.gain import ExploreGain, PerSecond, SearchGain
from semfov.head.onvif import OnvifCamera, OnvifClient
from semfov.head.panoramas import Panoramas
from semfov.head.scenes import Flat, Panorama
from semfov.head.speeds import Speeds

__all__ = [
    "CameraFrame",
    "ExploreGain",
    "Flat",
    "OnvifCamera",
    "OnvifClient",
    "PanTiltCamera",
    "Panorama",
    "Panoramas",
    "PerSecond",
    "SearchGain",
    "Speeds",
    "open_scene",
]

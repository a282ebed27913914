"""Foveal sensors: the view of an image when it is fixated at a point."""

from typing import TYPE_CHECKING, Any

from semfov.sensor.base import Sensor
from semfov.sensor.foveation import Foveation, foveate
from semfov.sensor.glimpse import glimpse
from semfov.sensor.log_polar import LogPolar, from_log_polar, log_polar
from semfov.sensor.multi_scale import MultiScaleFovea
from semfov.sensor.named import SENSORS, named_sensor
from semfov.sensor.perspective import perspective
from semfov.sensor.pyramid import gaussian_pyramid, laplacian_pyramid, pyrdown, pyrup

if TYPE_CHECKING:
    from semfov.sensor.augmentation import RandomFoveation

__all__ = [
    "SENSORS",
    "Foveation",
    "LogPolar",
    "MultiScaleFovea",
    "RandomFoveation",
    "Sensor",
    "foveate",
    "from_log_polar",
    "gaussian_pyramid",
    "glimpse",
    "laplacian_pyramid",
    "log_polar",
    "named_sensor",
    "perspective",
    "pyrdown",
    "pyrup",
]


def __getattr__(name: str) -> Any:
    if name == "RandomFoveation":
        # Kornia takes a quarter of a second to import.
        from semfov.sensor.augmentation import RandomFoveation

        return RandomFoveation
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

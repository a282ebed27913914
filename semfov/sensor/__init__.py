"""The foveal sensor."""

from typing import TYPE_CHECKING, Any

from semfov.sensor.foveation import Foveation, foveate
from semfov.sensor.glimpse import Glimpse, glimpse
from semfov.sensor.named import SENSORS, named_sensor
from semfov.sensor.pyramid import Bands, laplacian_pyramid, pyrdown, pyrup

if TYPE_CHECKING:
    from semfov.sensor.augmentation import RandomFoveation

__all__ = [
    "SENSORS",
    "Bands",
    "Foveation",
    "Glimpse",
    "RandomFoveation",
    "foveate",
    "glimpse",
    "laplacian_pyramid",
    "named_sensor",
    "pyrdown",
    "pyrup",
]


def __getattr__(name: str) -> Any:
    if name == "RandomFoveation":
        # Kornia takes a quarter of a second to import.
        from semfov.sensor.augmentation import RandomFoveation

        return RandomFoveation
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

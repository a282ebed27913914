"""The foveal sensor."""

from semfov.sensor.foveation import Foveation, foveate
from semfov.sensor.named import SENSORS, named_sensor
from semfov.sensor.pyramid import Bands, laplacian_pyramid, pyrdown, pyrup

__all__ = ["SENSORS", "Bands", "Foveation", "foveate", "laplacian_pyramid", "named_sensor", "pyrdown", "pyrup"]

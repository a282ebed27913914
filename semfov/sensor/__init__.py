"""The foveal sensor."""

from semfov.sensor.foveation import Foveation, foveate
from semfov.sensor.pyramid import Bands, laplacian_pyramid, pyrdown, pyrup

__all__ = ["Bands", "Foveation", "foveate", "laplacian_pyramid", "pyrdown", "pyrup"]

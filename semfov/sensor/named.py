"""Foveal sensors by name: the published ones, and the agent's own."""

from collections.abc import Mapping
from typing import Any, Literal

from semfov.errors import InputError, lookup
from semfov.sensor.base import Sensor
from semfov.sensor.foveation import Foveation
from semfov.sensor.log_polar import LogPolar

SensorName = Literal["published", "published-narrow", "gradual"]

SENSORS: dict[SensorName, dict[str, float]] = {
    "published": {"sigma": 100.0, "growth": 1.0},
    "published-narrow": {"sigma": 50.0, "growth": 1.0},
    "gradual": {"sigma": 100.0, "growth": 2.0},
}
"""Settings of the named sensors; σ is in pixels of an image whose longer side is 640.

- `published`: the wide fovea of Luzio, Bernardino and Moreno (2024). They print neither σ nor growth nor levels. The
  width is our choice; one window for all bands, growth 1, is what the code of the foveal system they cite computes.
- `published-narrow`: their narrow fovea, half as wide.
- `gradual`: every coarser band's window is twice as wide, so that acuity falls off slowly. The recommended agent's.
"""


def named_sensor(name: str, **settings: Any) -> Foveation:
    """The foveal sensor of that name.

    Args:
        name: of `SENSORS`.
        settings: other settings of `Foveation`, or other values for those that the name stands for.

    Raises:
        InputError: no sensor has this name (the nearest is suggested).

    >>> named_sensor("published-narrow", convention="opencv")
    Foveation(sigma=50, levels=5, growth=1, convention='opencv')
    """
    return Foveation(**{**SENSORS[lookup(name, SENSORS, "sensor")], **settings})


def sensor_of(settings: Mapping[str, Any]) -> Sensor:
    """The sensor with these settings (`Sensor.settings()`), one of the library's.

    Raises:
        InputError: they are those of another sensor.

    >>> sensor_of(Foveation(20.0, growth=1.0).settings())
    Foveation(sigma=20, levels=5, growth=1, convention='kornia')
    """
    if settings.get("kind") == "log-polar":
        return LogPolar(settings["fovea"], settings["spacing"], settings["pooling"])
    names = "sigma", "levels", "growth", "convention"
    if not all(name in settings for name in names):
        raise InputError(f"sensor: expected settings of a Foveation or of a LogPolar, got {dict(settings)}")
    return Foveation(**{name: settings[name] for name in names})

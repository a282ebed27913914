"""Foveal sensors by name: the published ones, and the one of the recommended agent."""

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
  width is our choice. Growth 1, one window for all bands, follows the code of the foveal system that they cite.
- `published-narrow`: their narrow fovea, half as wide.
- `gradual`: the window of each coarser band is twice as wide, so that acuity falls off slowly. The recommended agent
  has this sensor.
"""


def named_sensor(name: str, **settings: Any) -> Foveation:
    """Make a foveal sensor by its name.

    Args:
        name: a name in `SENSORS`.
        settings: further settings of `Foveation`; they replace the settings of the name.

    Returns:
        The sensor.

    Raises:
        InputError: no sensor has this name (the message suggests the nearest names).

    >>> named_sensor("published-narrow", convention="opencv")
    Foveation(sigma=50, levels=5, growth=1, convention='opencv')
    """
    return Foveation(**{**SENSORS[lookup(name, SENSORS, "sensor")], **settings})


def sensor_of(settings: Mapping[str, Any]) -> Sensor:
    """Make one of the library's sensors from its settings.

    Args:
        settings: settings as `Sensor.settings()` lists them.

    Returns:
        The sensor.

    Raises:
        InputError: they are the settings of another kind of sensor.

    >>> sensor_of(Foveation(20.0, growth=1.0).settings())
    Foveation(sigma=20, levels=5, growth=1, convention='kornia')
    """
    if settings.get("kind") == "log-polar":
        return LogPolar(settings["fovea"], settings["spacing"], settings["pooling"])
    names = "sigma", "levels", "growth", "convention"
    if not all(name in settings for name in names):
        raise InputError(f"sensor: expected the settings of a Foveation or a LogPolar, got {dict(settings)}")
    return Foveation(**{name: settings[name] for name in names})

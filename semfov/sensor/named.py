"""Sensors by name, which commands and model folders can select."""

from dataclasses import dataclass
from typing import Any, Literal

from semfov.errors import InputError, check, lookup
from semfov.io.compatibility import Settings
from semfov.sensor.base import Sensor
from semfov.sensor.foveation import Foveation
from semfov.sensor.log_polar import LogPolar
from semfov.sensor.multi_scale import MultiScaleFovea

SensorName = Literal["published", "published-narrow", "gradual", "log-polar", "multi-scale"]


@dataclass(frozen=True)
class _NamedSensor:
    """How a named sensor is made; for those of the paper observation models of maximum likelihood are shipped."""

    make: type[Sensor]
    settings: Settings
    published: bool = False

    def changed(self, changes: Settings) -> dict[str, Any]:
        """List the settings with some of them replaced."""
        for name in changes:
            names = ", ".join(self.make.names)
            check(name in self.make.names, "sensor", f"settings of a {self.make.__name__} ({names})", name)
        return {**self.settings, **changes}


_PYRAMID = {"levels": 5, "convention": "kornia"}

SENSORS: dict[SensorName, _NamedSensor] = {
    "published": _NamedSensor(Foveation, {"sigma": 100.0, "growth": 1.0, **_PYRAMID}, published=True),
    "published-narrow": _NamedSensor(Foveation, {"sigma": 50.0, "growth": 1.0, **_PYRAMID}, published=True),
    "gradual": _NamedSensor(Foveation, {"sigma": 100.0, "growth": 2.0, **_PYRAMID}),
    "log-polar": _NamedSensor(LogPolar, {"fovea": 60.0, "spacing": 1.0, "pooling": 1.0}),
    "multi-scale": _NamedSensor(MultiScaleFovea, {"side": 160, "scales": 4}),
}
"""The named sensors; lengths are in pixels of an image whose longer side is 640.

- `published`: the wide fovea of Luzio, Bernardino and Moreno (2024). They print neither σ nor growth nor levels. The
  width is our choice. Growth 1, one window for all bands, follows the code of the foveal system that they cite.
- `published-narrow`: their narrow fovea, half as wide.
- `gradual`: the window of each coarser band is twice as wide, so that acuity falls off slowly. The recommended agent
  has this sensor.
- `log-polar`: receptors on rings, further apart with eccentricity. No models are shipped for it.
- `multi-scale`: four square crops of 160, 320, 640 and 1280 px, each of which the detector sees at 160 × 160 px, as in
  SemBA. No models are shipped for it.
"""


def named_sensor(name: str, **settings: Any) -> Sensor:
    """Make a sensor by its name.

    Args:
        name: a name in `SENSORS`.
        settings: further settings of the sensor's class; they replace the settings of the name.

    Returns:
        The sensor.

    Raises:
        InputError: no sensor has this name (the message suggests the nearest names), or it has no such setting.

    >>> named_sensor("published-narrow", convention="opencv")
    Foveation(sigma=50, levels=5, growth=1, convention='opencv')
    """
    named = SENSORS[lookup(name, SENSORS, "sensor")]
    return named.make.from_settings(named.changed(settings))


def sensor_of(settings: Settings) -> Sensor:
    """Make one of the library's sensors from its settings (`Sensor.settings`)."""
    name_of_kind = settings.get("kind", Foveation.kind)
    kinds = dict.fromkeys(named.make for named in SENSORS.values())
    for kind in kinds:
        if name_of_kind == kind.kind and settings.keys() >= set(kind.names):
            return kind.from_settings(settings)
    expected = " or a ".join(kind.__name__ for kind in kinds)
    raise InputError(f"sensor: expected the settings of a {expected}, got {dict(settings)}")

"""Foveal sensors by name: the published ones, and the agent's own."""

from typing import Any, Literal

from semfov.errors import lookup
from semfov.sensor.foveation import Foveation

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

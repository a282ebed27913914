"""What an episode looked at, small enough to be kept with it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from torch import Tensor

from semfov.detection.placement import Placement, resize
from semfov.errors import check, check_shape
from semfov.eye import Eye
from semfov.sensor import Sensor, sensor_of

LONGEST = 1280
"""Longer side of a photograph that is kept, in pixels; larger ones are reduced to it."""


@dataclass(frozen=True)
class Stimulus:
    """A photograph as pictures of an episode need it, and what the eye's views of it are made of, both as bytes.

    A view is made when it is asked for: from the canvas, which is the photograph as the detector takes it in, by the
    eye's sensor. One that comes from a file has no sensor: it is made anew from its settings (`sensor_of`).

    Attributes:
        photograph: `(3, h, w)` bytes, RGB, at most `LONGEST` pixels long.
        canvas: `(3, H, W)` bytes, RGB.
        placement: where the photograph lies on the canvas.
        settings: of sensor and detector, `Eye.settings()`.
        sensor: the eye's; None makes one of the settings.
    """

    photograph: Tensor
    canvas: Tensor
    placement: Placement
    settings: Mapping[str, Any]
    sensor: Sensor | None = field(default=None, compare=False, repr=False)

    @classmethod
    def of(cls, eye: Eye, image: Tensor) -> Self:
        """What an eye is shown.

        Args:
            eye: sensor and detector.
            image: `(3, H, W)` or `(1, 3, H, W)`, RGB in [0, 1].
        """
        image = image[None] if image.ndim == 3 else image
        check_shape(image, "image", 1, 3, None, None)
        with torch.no_grad():
            canvas, placement = eye.detector.fit(image)
            return cls(in_bytes(reduced(image[0])), in_bytes(canvas[0]), placement, eye.settings(), eye.sensor)

    @property
    def image(self) -> Tensor:
        """The photograph, `(3, h, w)` in [0, 1]."""
        return self.photograph.float() / 255

    def views(self, fixations: Tensor) -> list[Tensor]:
        """What the detector was shown from each of the fixations `(n, 2)`, without the canvas around it: `(3, h, w)`.

        Equal to what `Eye.foveated` gives up to the rounding of bytes.

        Raises:
            InputError: the scanpath comes from a file, and its sensor is none of the library's.
        """
        check_shape(fixations, "fixations", None, 2)
        return list(self._views(fixations))

    def _views(self, fixations: Tensor) -> Iterator[Tensor]:
        settings = self.settings["sensor"]
        sensor = sensor_of(settings) if self.sensor is None else self.sensor
        left, top = self.placement.offset
        width, height = (round(n * s) for n, s in zip(self.placement.size, self.placement.scale, strict=True))
        larger = max(self.placement.size) / settings["reference"]
        with torch.no_grad():
            canvas = (self.canvas[None].double() / 255).to(sensor.like)
            state = sensor.open(canvas, canvas.new_tensor(self.placement.scale) * larger)
            # One at a time: all views of a large canvas at once take gigabytes.
            for point in self.placement.points_to_canvas(fixations.to(canvas)):
                view = sensor.look(state, point[None])[0]
                yield view[:, top : top + height, left : left + width].float().cpu().clone()


def sensor_in_words(sensor: Mapping[str, Any]) -> str:
    """What a sensor is like, from its part of `Eye.settings()`.

    >>> sensor_in_words({"sigma": 100.0, "reference": 640.0, "growth": 2.0})
    'fovea of 100 px in 640, growth 2'
    >>> sensor_in_words({"kind": "log-polar", "fovea": 40.0, "reference": 640.0})
    'log-polar, fovea 40, reference 640'
    """
    if "sigma" not in sensor or "growth" not in sensor:
        told = (f"{name} {value:g}" for name, value in sensor.items() if isinstance(value, int | float))
        return ", ".join([str(sensor.get("kind", "sensor")), *told])
    return f"fovea of {sensor['sigma']:.0f} px in {sensor['reference']:.0f}, growth {sensor['growth']:g}"


def reduced(image: Tensor, longest: int = LONGEST) -> Tensor:
    """An image `(3, h, w)` whose longer side is at most `longest` pixels."""
    check(longest >= 1, "longest", "at least 1 pixel", longest)
    scale = longest / max(image.shape[-2:])
    if scale >= 1:
        return image
    width, height = (max(1, round(n * scale)) for n in (image.shape[-1], image.shape[-2]))
    return resize(image[None], (width, height))[0]


def in_bytes(image: Tensor) -> Tensor:
    """Pixels in [0, 1] as bytes, on the CPU.

    >>> in_bytes(torch.tensor([0.0, 0.5, 1.0])).tolist()
    [0, 128, 255]
    """
    return (image.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8)

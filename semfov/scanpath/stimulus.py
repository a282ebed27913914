"""What an episode looked at, small enough to be kept with it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from semfov.detection.placement import Placement, resize
from semfov.errors import check, check_shape
from semfov.eye import Eye
from semfov.sensor.foveation import foveate
from semfov.sensor.pyramid import laplacian_pyramid

LONGEST = 1280
"""Longer side of a photograph that is kept, in pixels; larger ones are reduced to it."""


@dataclass(frozen=True)
class Stimulus:
    """A photograph as pictures of an episode need it, and what the eye's views of it are made of, both as bytes.

    A view is made when it is asked for: from the canvas, which is the photograph as the detector takes it in, by the
    sensor that the eye has.

    Attributes:
        photograph: `(3, h, w)` bytes, RGB, at most `LONGEST` pixels long.
        canvas: `(3, H, W)` bytes, RGB.
        placement: where the photograph lies on the canvas.
        sigma: width of the fovea in canvas pixels along x and y, `(2,)`.
        settings: of sensor and detector, `Eye.settings()`.
    """

    photograph: Tensor
    canvas: Tensor
    placement: Placement
    sigma: Tensor
    settings: Mapping[str, Any]

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
            sigma = eye.width(placement, canvas)[0].cpu()
            return cls(in_bytes(reduced(image[0])), in_bytes(canvas[0]), placement, sigma, eye.settings())

    @property
    def image(self) -> Tensor:
        """The photograph, `(3, h, w)` in [0, 1]."""
        return self.photograph.float() / 255

    def views(self, fixations: Tensor) -> list[Tensor]:
        """What the detector was shown from each of the fixations `(n, 2)`, without the canvas around it: `(3, h, w)`.

        Equal to what `Eye.foveated` gives up to the rounding of bytes.
        """
        check_shape(fixations, "fixations", None, 2)
        return list(self._views(fixations))

    def _views(self, fixations: Tensor) -> Iterator[Tensor]:
        sensor = self.settings["sensor"]
        left, top = self.placement.offset
        width, height = (round(n * s) for n, s in zip(self.placement.size, self.placement.scale, strict=True))
        with torch.no_grad():
            bands = laplacian_pyramid(self.canvas[None].float() / 255, sensor["levels"], sensor["convention"])
            gaze = self.placement.points_to_canvas(fixations.cpu().float())
            sigma = self.sigma[None].float()
            # One at a time: all views of a large canvas at once take gigabytes.
            for point in gaze:
                canvas = foveate(bands, point[None], sigma=sigma, growth=sensor["growth"])[0]
                yield canvas[:, top : top + height, left : left + width].clone()


def sensor_in_words(sensor: Mapping[str, Any]) -> str:
    """What a foveal sensor is like, from its part of `Eye.settings()`.

    >>> sensor_in_words({"sigma": 100.0, "reference": 640.0, "growth": 2.0})
    'fovea of 100 px in 640, growth 2'
    """
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

"""Sensor and detector as one eye: what is detected when an image is fixated at a point."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from semfov.detection.detections import Detections
from semfov.detection.detector import Detector
from semfov.detection.placement import Placement
from semfov.errors import check, check_shape
from semfov.sensor.foveation import Foveation, foveate
from semfov.sensor.pyramid import Bands


@dataclass(frozen=True)
class View:
    """An image as the eye holds it: everything that does not depend on where it looks.

    Attributes:
        bands: Laplacian pyramid of the canvas, computed once.
        placement: where the image lies on the canvas.
        sigma: width of the fovea in canvas pixels along x and y, `(1, 2)`.
    """

    bands: Bands
    placement: Placement
    sigma: Tensor


class Eye(nn.Module):
    r"""Foveates at the detector's resolution and detects.

    The image is fitted into the detector's input first and blurred there: that is what a fixed number of receptors
    does, and it costs less than blurring every pixel of the photograph.

    The canvas sees what the sensor shows of an image whose longer side is `reference`. With the canvas s times as
    large, windows shrink by s, and a band of the canvas holds what is :math:`\log_2 s` bands finer there, so that

    .. math:: \sigma_k' = s \, \sigma \, \mathrm{growth}^{k - \log_2 s}, \qquad
              \sigma' = \sigma \, s^{1 - \log_2 \mathrm{growth}}

    keeps the same detail at the same distance from the fovea. (With growth 2 acuity is a function of eccentricity
    that has no scale, and σ' = σ.)

    Args:
        sensor: the foveal sensor; its σ is in pixels of an image whose longer side is `reference`.
        detector: any detector.
        reference: longer side, in pixels, that σ is meant for (those of `semfov.sensor.SENSORS` are meant for 640).
    """

    def __init__(self, sensor: Foveation, detector: Detector, *, reference: float = 640.0) -> None:
        super().__init__()
        check(reference > 0, "reference", "a positive number of pixels", reference)
        self.sensor = sensor
        self.detector = detector
        self.reference = reference

    def open(self, image: Tensor) -> View:
        """Fit an image `(1, 3, H, W)`, RGB in [0, 1], into the input and build its pyramid."""
        check_shape(image, "image", 1, 3, None, None)
        canvas, placement = self.detector.fit(image)
        return View(self.sensor.pyramid(canvas), placement, self.width(placement, canvas))

    def width(self, placement: Placement, like: Tensor) -> Tensor:
        """Width of the fovea in canvas pixels along x and y, `(1, 2)`, where an image lies so; type as of `like`."""
        scale = like.new_tensor([placement.scale]) * (max(placement.size) / self.reference)
        shrink = scale.pow(1 - torch.as_tensor(self.sensor.growth).to(scale).log2())
        return self.sensor.sigma * shrink

    def foveated(self, view: View, fixations: Tensor) -> Tensor:
        """What the sensor gives for fixations `(F, 2)` in image pixels: canvases `(F, 3, h, w)`."""
        check_shape(fixations, "fixations", None, 2)
        gaze = view.placement.points_to_canvas(fixations)
        sensor = self.sensor
        return foveate(view.bands, gaze[None], sigma=view.sigma, growth=sensor.growth)[0]

    def look(self, view: View, fixations: Tensor) -> Detections:
        """Detections seen from fixations `(F, 2)`, a batch of F, boxes in pixels of the image."""
        return self.detector.detect(self.foveated(view, fixations), view.placement)

    def forward(self, image: Tensor, fixations: Tensor) -> Detections:
        """`look` at an image `(1, 3, H, W)` from fixations `(F, 2)`."""
        return self.look(self.open(image), fixations)

    def settings(self) -> dict[str, Any]:
        """What the detections depend on, for the keys of caches and the metadata of fitted models."""
        sensor = self.sensor
        return {
            "sensor": {
                "sigma": float(sensor.sigma),
                "levels": sensor.levels,
                "growth": float(sensor.growth),
                "convention": sensor.convention,
                "reference": self.reference,
            },
            "detector": self.detector.settings(),
        }

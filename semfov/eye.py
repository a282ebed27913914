"""Sensor and detector as one eye: what is detected when an image is fixated at a point."""

from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor, nn

from semfov.data.inputs import ImageLike, PointLike, as_image, as_points
from semfov.detection.detections import Detections
from semfov.detection.detector import Detector
from semfov.detection.placement import Placement
from semfov.errors import check, check_shape
from semfov.sensor.base import Sensor


@dataclass(frozen=True)
class View:
    """An image as the eye holds it: everything that does not depend on where it looks.

    Attributes:
        canvas: the image fitted into the detector's input, `(1, 3, h, w)`.
        placement: where the image lies on the canvas.
        state: what the sensor keeps of the canvas.
    """

    canvas: Tensor
    placement: Placement
    state: Any


class Eye(nn.Module):
    """Looks at an image through a sensor, at the detector's resolution, and detects.

    The image is fitted into the detector's input first and shown to the sensor there: that is what a fixed number of
    receptors does, and it costs less than blurring every pixel of the photograph. The canvas sees what the sensor shows
    of an image whose longer side is `reference`.

    Args:
        sensor: `Foveation`, `LogPolar`, or any other `semfov.sensor.Sensor`; its settings are in pixels of an image
            whose longer side is `reference`.
        detector: any detector.
        reference: longer side, in pixels, that the sensor's settings are meant for (those of `semfov.sensor.SENSORS`
            are meant for 640).
    """

    def __init__(self, sensor: Sensor, detector: Detector, *, reference: float = 640.0) -> None:
        super().__init__()
        check(reference > 0, "reference", "a positive number of pixels", reference)
        self.sensor = sensor
        self.detector = detector
        self.reference = reference

    def open(self, image: ImageLike) -> View:
        """Fit an image of any common kind (`semfov.as_image`) into the input, and open the sensor on it."""
        if not (isinstance(image, Tensor) and image.ndim == 4 and image.is_floating_point()):
            image = as_image(image, like=self.sensor.like)[None]
        check_shape(image, "image", 1, 3, None, None)
        canvas, placement = self.detector.fit(image)
        scale = canvas.new_tensor(placement.scale) * (max(placement.size) / self.reference)
        return View(canvas, placement, self.sensor.open(canvas, scale))

    def foveated(self, view: View, fixations: PointLike) -> Tensor:
        """What the sensor gives for fixations `(F, 2)` in image pixels, or one `(x, y)`: canvases `(F, 3, h, w)`."""
        return self.sensor.look(view.state, view.placement.points_to_canvas(_points(fixations, view)))

    def detect(self, view: View, fixations: Tensor, canvases: Tensor) -> Detections:
        """Detections on what `foveated` gave for the fixations, boxes in pixels of the image."""
        gaze = view.placement.points_to_canvas(fixations)
        back = partial(self.sensor.boxes_to_canvas, view.state, gaze)
        return self.detector.detect(canvases, view.placement, back=back)

    def look(self, view: View, fixations: PointLike) -> Detections:
        """Detections seen from fixations `(F, 2)`, a batch of F, boxes in pixels of the image."""
        points = _points(fixations, view)
        return self.detect(view, points, self.foveated(view, points))

    def forward(self, image: ImageLike, fixations: PointLike) -> Detections:
        """`look` at an image from fixations `(F, 2)`."""
        return self.look(self.open(image), fixations)

    def settings(self) -> dict[str, Any]:
        """What the detections depend on, for the keys of caches and the metadata of fitted models."""
        sensor = self.sensor.settings() | {"reference": self.reference}
        return {"sensor": sensor, "detector": self.detector.settings()}


def _points(fixations: PointLike, view: View) -> Tensor:
    """Fixations `(F, 2)`; one `(x, y)` is one."""
    points = as_points(fixations, "fixations").to(view.canvas)
    points = points[None] if points.ndim == 1 else points
    check_shape(points, "fixations", None, 2)
    return points

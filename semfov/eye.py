"""The eye: a sensor and a detector, which together return the detections at a fixation in an image."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from semfov.data.inputs import ImageLike, PointLike, as_image, as_points, as_positions
from semfov.data.windowed import reduction_for, resized
from semfov.detection.crops import merge_crops
from semfov.detection.detections import Detections
from semfov.detection.detector import Detector, check_images
from semfov.detection.feature_maps import FeatureMaps
from semfov.detection.placement import Placement, letterbox
from semfov.errors import check, check_shape
from semfov.io.state import StatedModule
from semfov.sensor.base import Sensor
from semfov.sensor.foveation import Foveation
from semfov.sensor.glimpse import glimpse, window_around

MOST_FLOATS = 1 << 25  # pixels of a picture all of whose floats are made
_LONGEST = 1024  # longer side in pixels of the copy of a picture of bytes, at least, which is fitted into the canvas


class View(NamedTuple):
    """An opened image: everything that does not depend on the fixation; canvas `(1, 3, h, w)`."""

    canvas: Tensor
    placement: Placement
    state: Any


class Eye(StatedModule):
    """Applies a sensor to an image at the detector's resolution, and detects objects in the result.

    The image is first fitted into the detector's input, the canvas, and the sensor is applied there, which costs less
    than blurring every pixel of the photograph. The settings of the sensor are scaled to the canvas, from an image
    whose longer side is `reference`.

    Args:
        sensor: `Foveation`, `LogPolar`, `MultiScaleFovea` or any other `semfov.sensor.Sensor`, with settings in pixels
            of an image whose longer side is `reference`.
        detector: any detector.
        reference: longer side, in pixels, of the image that the settings of the sensor are for; 640 for those of
            `semfov.sensor.SENSORS`.

    Raises:
        InputError: `reference` is not positive.

    Example::

        eye = semfov.Eye(semfov.Foveation(100.0), semfov.load_detector("yolox-nano"))
        view = eye.open("kitchen.jpg")
        detections = eye.look(view, [(320.0, 240.0), (100.0, 50.0)])  # a batch of two looks
    """

    _setting_names = ("reference",)  # the size that the settings of the sensor are for

    def __init__(self, sensor: Sensor, detector: Detector, *, reference: float = 640.0) -> None:
        super().__init__()
        check(reference > 0, "reference", "a positive number of pixels", reference)
        self.sensor = sensor
        self.detector = detector
        self.reference = reference

    def open(self, image: ImageLike) -> View:
        """Fit an image into the detector's input, and compute what the sensor needs once per image.

        Args:
            image: a picture of any common kind (`semfov.as_image`), or a tensor `(1, 3, H, W)`.

        Returns:
            The opened image.

        Raises:
            InputError: it is no picture.
            DataError: the file of the image cannot be read.
        """
        if not (isinstance(image, Tensor) and image.ndim == 4 and _is_taken(image)):
            image = as_image(image, like=self.sensor.like)[None]
        check_shape(image, "image", 1, 3, None, None)
        canvas, placement = self.fit(image)
        # From the image to the canvas, and from an image of the reference size to this one.
        to_canvas = as_positions(torch.tensor(placement.scale, dtype=torch.float64), canvas)
        from_reference = max(placement.size) / self.reference
        return View(canvas, placement, self.sensor.open(canvas, to_canvas * from_reference))

    def fit(self, image: Tensor) -> tuple[Tensor, Placement]:
        """Fit an image into the canvas of the sensor, which is the detector's input unless the sensor says otherwise.

        Args:
            image: `(1, 3, H, W)`, RGB in [0, 1], or bytes.

        Returns:
            The canvas `(1, 3, h, w)`, and the placement of the image on it.
        """
        if image.dtype == torch.uint8:
            return self._fit_bytes(image)
        size = self.sensor.canvas_size((image.shape[-1], image.shape[-2]), self.reference)
        if size is None:
            return self.detector.fit(image)
        check_images(image)
        return letterbox(image, size, stretch=True)

    def _fit_bytes(self, image: Tensor) -> tuple[Tensor, Placement]:
        """Fit the bytes of a large picture into the canvas, by way of a smaller copy, without floats of all pixels."""
        size = image.shape[-1], image.shape[-2]
        copy = _floats(image, max(size) / _LONGEST, self.sensor.like)
        canvas, placement = self.fit(copy)
        across = placement.scale[0] * copy.shape[-1] / size[0]
        down = placement.scale[1] * copy.shape[-2] / size[1]
        return canvas, replace(placement, size=size, scale=(across, down))

    def foveated(self, view: View, fixations: PointLike) -> Tensor:
        """Apply the sensor at fixations.

        Args:
            view: the opened image.
            fixations: `(F, 2)`, as `(x, y)` in pixels of the image, or a single point.

        Returns:
            `(F, 3, h, w)`, one canvas for each fixation; `(F·L, 3, h, w)` of a sensor with L crops.

        Raises:
            InputError: the shape of `fixations` is wrong.
        """
        return self.sensor.look(view.state, _on_canvas(fixations, view))

    def pictures(self, view: View, fixations: PointLike) -> Tensor:
        """Compute the views from fixations as pictures, for figures and environments.

        Args:
            view: the opened image.
            fixations: `(F, 2)`, as `(x, y)` in pixels of the image, or a single point.

        Returns:
            `(F, 3, h, w)`, one for each fixation.

        Raises:
            InputError: the shape of `fixations` is wrong.
        """
        return self.sensor.picture(view.state, _on_canvas(fixations, view))

    def detect(self, view: View, fixations: PointLike, canvases: Tensor) -> Detections:
        """Detect objects in foveated canvases.

        Args:
            view: the opened image.
            fixations: `(F, 2)`, as `(x, y)` in pixels of the image.
            canvases: `(F, 3, h, w)` or `(F·L, 3, h, w)`, from `foveated`.

        Returns:
            The detections, a batch of F, boxes in pixels of the image. Those of several crops are merged by
            `semfov.detection.crops.merge_crops`.
        """
        return self._detect(view, _on_canvas(fixations, view), canvases)

    def _detect(self, view: View, gaze: Tensor, canvases: Tensor) -> Detections:
        """Detect in canvases from fixations `(F, 2)` in their pixels."""
        back = partial(self.sensor.boxes_to_canvas, view.state, gaze)
        if self.sensor.crops == 1:
            return self.detector.detect(canvases, view.placement, back=back)
        detections = self.detector.detect(canvases)
        height, width = canvases.shape[-2:]
        frame = detections.boxes.new_tensor([0, 0, width, height]).expand(len(canvases), 1, 4)
        size = view.canvas.shape[-1], view.canvas.shape[-2]
        detections = replace(detections, boxes=back(detections.boxes))
        limit = self.detector.selection.limit
        merged = merge_crops(detections, back(frame)[:, 0], self.sensor.crops, width, size, limit)
        return replace(merged, boxes=view.placement.boxes_to_image(merged.boxes))

    def look(self, view: View, fixations: PointLike, lap: Callable[[str], object] = lambda stage: None) -> Detections:
        """Look from fixations: apply the sensor, then detect.

        Args:
            view: the opened image.
            fixations: `(F, 2)`, as `(x, y)` in pixels of the image, or a single point.
            lap: called with `foveate` and `detect` when they are done (`semfov.episode.stopwatch`).

        Returns:
            The detections, a batch of F, boxes in pixels of the image.

        Raises:
            InputError: the shape of `fixations` is wrong.
        """
        gaze = _on_canvas(fixations, view)
        canvases = self.sensor.look(view.state, gaze)
        lap("foveate")
        detections = self._detect(view, gaze, canvases)
        lap("detect")
        return detections

    def features(self, view: View, fixations: PointLike, layers: Sequence[str] | None = None) -> FeatureMaps:
        """Look from fixations, and keep feature maps of the passes.

        Args:
            view: the opened image.
            fixations: `(F, 2)`, as `(x, y)` in pixels of the image, or a single point.
            layers: names of the maps, as for `Detector.features`.

        Returns:
            The maps by name, a batch of F over the canvas, with the detections.

        Raises:
            InputError: the shape of `fixations` is wrong, the detector has no such map, or the sensor bends the image.
        """
        expected = "a Foveation, whose views are the image itself"
        check(isinstance(self.sensor, Foveation), "sensor", expected, type(self.sensor).__name__)
        return self.detector.canvas_features(self.foveated(view, fixations), view.placement, layers)

    def close_up(self, image: Tensor, box: Tensor) -> Detections:
        """Take a closer look at a place: enlarge a window around it to the detector's input, and detect.

        The window (`semfov.sensor.glimpse.window_around`) is taken from the image itself and not from its canvas, and
        the sensor is not applied. It shows small objects larger than any look at the whole image. One such look costs
        one pass of the detector.

        Args:
            image: `(1, 3, H, W)`, RGB in [0, 1], or bytes.
            box: `(4,)`, the place as `(x1, y1, x2, y2)` in pixels of the image.

        Returns:
            The detections, a batch of one, boxes in pixels of the image.

        Raises:
            InputError: a shape is wrong.
        """
        check_shape(image, "image", 1, 3, None, None)
        window = window_around(box.to(self.sensor.like.dtype), (image.shape[-1], image.shape[-2]))
        sides = window[2:] - window[:2]
        scale = (sides.new_tensor(self.detector.input_size) / sides).amin()
        width, height = (max(1, round(side)) for side in (sides * scale).tolist())
        canvas = self._closely(image, window, (width, height)).clamp_(0, 1)
        detections = self.detector(canvas).to(box.device)
        unit = (sides / sides.new_tensor([width, height])).repeat(2)
        return replace(detections, boxes=detections.boxes * unit + window[:2].repeat(2))

    def _closely(self, image: Tensor, window: Tensor, size: tuple[int, int]) -> Tensor:
        """Resample a window of an image to a `(width, height)`; of bytes, floats are made around it alone."""
        if image.dtype != torch.uint8:
            return glimpse(image, window[None], size)
        sides = window[2:] - window[:2]
        ratio = float(sides.amax()) / max(size)  # pixels of the image for one of the canvas
        # The filter reaches a pixel of the canvas further than the window.
        reach = math.ceil(max(ratio, 1.0)) + 1
        x1, y1, x2, y2 = window.tolist()
        left = max(math.floor(x1) - reach, 0)
        top = max(math.floor(y1) - reach, 0)
        right = math.ceil(x2) + reach
        bottom = math.ceil(y2) + reach
        part = image[:, :, top:bottom, left:right]
        copy = _floats(part, ratio, self.sensor.like)
        # The window in pixels of the copy.
        scale = window.new_tensor([copy.shape[-1] / part.shape[-1], copy.shape[-2] / part.shape[-2]])
        corner = window.new_tensor([left, top])
        on_copy = (window - corner.repeat(2)) * scale.repeat(2)
        return glimpse(copy, on_copy[None], size)

    def forward(self, image: ImageLike, fixations: PointLike) -> Detections:
        """Open an image and look from fixations.

        Args:
            image: a picture of any common kind (`semfov.as_image`), or a tensor `(1, 3, H, W)`.
            fixations: `(F, 2)`, as `(x, y)` in pixels of the image, or a single point.

        Returns:
            The detections, a batch of F, boxes in pixels of the image.
        """
        return self.look(self.open(image), fixations)

    def settings(self) -> dict[str, Any]:
        """List the settings that the detections depend on, for the keys of caches and the metadata of fitted models.

        Returns:
            JSON values by `sensor` and `detector`.
        """
        sensor = self.sensor.settings() | {"reference": self.reference}
        return {"sensor": sensor, "detector": self.detector.settings()}


def _is_taken(image: Tensor) -> bool:
    """Tell whether pixels are taken as they are: floats, and the bytes of a picture whose floats take too much."""
    are_many = image.shape[-1] * image.shape[-2] > MOST_FLOATS
    return image.is_floating_point() or (image.dtype == torch.uint8 and are_many)


def _floats(image: Tensor, ratio: float, like: Tensor) -> Tensor:
    """Make floats in [0, 1] of bytes `(1, 3, h, w)`, reduced where they are to have far fewer pixels (`ratio`)."""
    reduction = reduction_for(ratio)
    height, width = image.shape[-2:]
    size = (max(1, height // reduction), max(1, width // reduction))
    return resized(image[0], size).to(like) / 255


def _on_canvas(fixations: PointLike, view: View) -> Tensor:
    """Fixations as `(F, 2)` in pixels of the canvas, where the canvas is; a single point becomes a batch of one."""
    points = as_positions(as_points(fixations, "fixations"), view.canvas.dtype)
    points = points[None] if points.ndim == 1 else points
    check_shape(points, "fixations", None, 2)
    # Mapped where they are: the numbers of the placement are copied there, and a GPU would be waited for.
    return view.placement.points_to_canvas(points).to(view.canvas.device)

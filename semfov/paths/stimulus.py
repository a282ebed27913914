"""The stimulus of an episode: the data for its foveated views, small enough to keep, and reduced photographs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from torch import Tensor

from semfov.data.windowed import LargePicture, resized
from semfov.detection.placement import Placement, resize
from semfov.errors import InputError, check, check_shape
from semfov.eye import Eye
from semfov.sensor import Sensor
from semfov.sensor.named import sensor_of

LONGEST = 1280  # longer side of a kept photograph, in pixels; larger photographs are reduced to it


@dataclass(frozen=True)
class Stimulus:
    """The canvas from which foveated views are made.

    Attributes:
        canvas: `(3, H, W)`, bytes, the photograph as it was fitted into the detector's input.
        placement: where the photograph lies on the canvas.
        settings: settings of the eye, from which a sensor is made where there is none.
        sensor: sensor of the eye; None after the record was read from a file.
    """

    canvas: Tensor
    placement: Placement
    settings: Mapping[str, Any]
    sensor: Sensor | None = field(default=None, compare=False, repr=False)

    @classmethod
    def of(cls, eye: Eye, image: Tensor) -> Self:
        """Make the stimulus of a photograph `(3, H, W)`, or of a batch of one."""
        image = image[None] if image.ndim == 3 else image
        check_shape(image, "image", 1, 3, None, None)
        with torch.no_grad():
            canvas, placement = eye.fit(image)
            return cls(in_bytes(canvas[0]), placement, eye.settings(), eye.sensor)

    @classmethod
    def restored(cls, tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> Self | None:
        """Make the stimulus from the content of a file, and check that its parts fit each other."""
        # A record without the stimulus may have the photograph.
        parts = {
            "photograph": tensors.get("photograph"),
            "canvas": tensors.get("canvas"),
            "placement": record.get("placement"),
            "settings": record.get("settings"),
        }
        found = [name for name, part in parts.items() if part is not None]
        if found in ([], ["photograph"]):
            return None
        if len(found) < len(parts):
            expected = "photograph, canvas, placement and settings together"
            raise InputError(f"photograph: expected {expected}, got {len(found)} of these 4")
        placement = Placement(**{name: tuple(pair) for name, pair in record["placement"].items()})
        canvas = tensors["canvas"]
        height, width = canvas.shape[1:]
        _check_on_canvas(placement, 0, width)
        _check_on_canvas(placement, 1, height)
        return cls(canvas, placement, record["settings"])

    def views(self, fixations: Tensor) -> list[Tensor]:
        """Make the foveated views of fixations, those of `Eye.pictures` up to the rounding to bytes.

        Args:
            fixations: `(n, 2)`, in pixels of the photograph.

        Returns:
            `(3, h, w)` of each, without the border of the canvas.
        """
        check_shape(fixations, "fixations", None, 2)
        settings = self.settings["sensor"]
        sensor = sensor_of(settings) if self.sensor is None else self.sensor
        placement = self.placement  # of the photograph on the canvas of the detector
        # The sensor's blur is set for photographs of a reference size; a larger one is seen at more pixels a degree.
        magnification = max(placement.size) / settings["reference"]
        views = []
        with torch.no_grad():
            canvas = (self.canvas[None].double() / 255).to(sensor.like)  # (1, 3, h, w)
            state = sensor.open(canvas, canvas.new_tensor(placement.scale) * magnification)
            # One at a time: all views of a large canvas at once would take gigabytes.
            for point in placement.points_to_canvas(fixations.to(canvas)):
                picture = sensor.picture(state, point[None])[0]
                # A copy, as a view would keep the whole canvas in memory.
                views.append(placement.cut_out(picture).float().cpu().clone())
        return views


def _check_on_canvas(placement: Placement, axis: int, length: int) -> None:
    """Raise `InputError` unless a photograph lies on a canvas, of this length, along x (0) or y (1)."""
    side = placement.size[axis] * placement.scale[axis]
    lies_inside = round(side) >= 1 and placement.offset[axis] + round(side) <= length
    check(lies_inside, "placement", f"the photograph on a canvas of {length} px", f"{side:g} px")


def reduced_copy(picture: LargePicture | Tensor) -> Tensor:
    """Reduce a picture to the bytes that a record keeps for its drawings.

    Args:
        picture: the opened picture, or pixels `(3, H, W)` in [0, 1]; bytes of a larger one.

    Returns:
        `(3, h, w)`, with at most `LONGEST` pixels along the longer side.
    """
    if isinstance(picture, Tensor):
        return _reduced_pixels(picture)
    width, height = picture.size
    scale = min(1.0, LONGEST / max(width, height))
    pixels = picture.read((0, 0, width, height), picture.reduction(1 / scale, oversampling=1))
    # Frames may share the memory of a camera; a copy in the order of memory is made ten times faster than another.
    return resized(pixels, _reduced_sides(height, width))[0].clone()


def _reduced_pixels(image: Tensor) -> Tensor:
    """Reduce pixels `(3, H, W)`, of bytes or in [0, 1], to bytes of at most `LONGEST` pixels along the longer side."""
    height, width = image.shape[-2:]
    if max(height, width) <= LONGEST:
        return in_bytes(image)
    rows, columns = _reduced_sides(height, width)
    if image.dtype == torch.uint8:
        return resized(image, (rows, columns))[0].clone()
    return in_bytes(resize(image[None], (columns, rows))[0])


def _reduced_sides(height: int, width: int) -> tuple[int, int]:
    """Compute height and width of a picture of at most `LONGEST` pixels along the longer side."""
    scale = min(1.0, LONGEST / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def in_bytes(image: Tensor) -> Tensor:
    """Convert pixels in [0, 1] to bytes, on the CPU."""
    values = image.detach().clamp(0, 1).mul_(255).round_()
    # By way of whole numbers of 16 bits, as PyTorch converts floats to bytes one by one.
    return values.to(torch.int16).to("cpu", torch.uint8)

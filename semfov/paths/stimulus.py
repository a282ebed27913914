"""The stimulus of an episode: the data for its foveated views, small enough to keep, and reduced photographs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from torch import Tensor

from semfov.data.windowed import LargePicture, resized
from semfov.detection.placement import Placement, resize
from semfov.errors import check, check_shape
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
        values = [record[name] for name in ("placement", "settings") if record.get(name) is not None]
        if "canvas" not in tensors and not values:
            return None
        got = len(tensors.keys() & {"photograph", "canvas"}) + len(values)
        check(got == 4, "photograph", "photograph, canvas, placement and settings together", f"{got} of these 4")
        placement_values, settings = values
        placement = Placement(**{name: tuple(pair) for name, pair in placement_values.items()})
        canvas = tensors["canvas"]
        for axis in (0, 1):
            room = canvas.shape[2 - axis]
            side = placement.size[axis] * placement.scale[axis]
            lies_inside = round(side) >= 1 and placement.offset[axis] + round(side) <= room
            check(lies_inside, "placement", f"the photograph on a canvas of {room} px", f"{side:g} px")
        return cls(canvas, placement, settings)

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
        left, top = self.placement.offset
        width, height = (round(n * s) for n, s in zip(self.placement.size, self.placement.scale, strict=True))
        larger = max(self.placement.size) / settings["reference"]
        with torch.no_grad():
            canvas = (self.canvas[None].double() / 255).to(sensor.like)
            state = sensor.open(canvas, canvas.new_tensor(self.placement.scale) * larger)
            # One at a time: all views of a large canvas at once would take gigabytes.
            return [
                sensor.picture(state, point[None])[0, :, top : top + height, left : left + width].float().cpu().clone()
                for point in self.placement.points_to_canvas(fixations.to(canvas))
            ]


def reduced_copy(picture: LargePicture | Tensor) -> Tensor:
    """Reduce a picture to the bytes that a record keeps for its drawings, `(3, h, w)`."""
    if isinstance(picture, Tensor):
        height, width = picture.shape[-2:]
    else:
        width, height = picture.size
    scale = min(1.0, LONGEST / max(width, height))
    reduced_size = (max(1, round(width * scale)), max(1, round(height * scale)))
    if isinstance(picture, Tensor):
        return in_bytes(picture if scale == 1 else resize(picture[None], reduced_size)[0])
    pixels = picture.read((0, 0, width, height), picture.reduction(1 / scale, oversampling=1))
    # Frames may share the memory of a camera; a copy in the order of memory is made ten times faster than another.
    return resized(pixels, reduced_size[::-1])[0].clone()


def in_bytes(image: Tensor) -> Tensor:
    """Convert pixels in [0, 1] to bytes, on the CPU."""
    return image.detach().clamp(0, 1).mul_(255).round_().to("cpu", torch.uint8)

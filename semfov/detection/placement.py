"""Letterboxing: fitting an image into a detector's input, and mapping boxes back."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.inputs import as_positions
from semfov.errors import check, check_shape


@dataclass(frozen=True)
class Placement:
    """The placement of an image in a detector's input (its canvas).

    Points have pixel centres at integers, so the corner of the image is at -0.5:

        canvas + 0.5 = (image + 0.5) · scale + offset

    Box edges are positions between pixels (0 is the left edge of the image): canvas = image · scale + offset.

    Attributes:
        size: `(width, height)` of the image in pixels.
        scale: canvas pixels per image pixel, `(x, y)`; equal in both axes unless the image is stretched.
        offset: left and top padding on the canvas, in canvas pixels.

    >>> placement = Placement((640, 480), (0.5, 0.5), (0, 40))
    >>> placement.boxes_to_image(torch.tensor([10.0, 50.0, 30.0, 300.0]))
    tensor([ 20.,  20.,  60., 480.])
    """

    size: tuple[int, int]
    scale: tuple[float, float]
    offset: tuple[int, int]

    def points_to_canvas(self, points: Tensor) -> Tensor:
        """Map points from the image to the canvas.

        Args:
            points: `(..., 2)` in image pixels, pixel centres at integers.

        Returns:
            `(..., 2)` in canvas pixels.
        """
        check_shape(points, "points", 2)
        points = as_positions(points)
        scale = points.new_tensor(self.scale)
        offset = points.new_tensor(self.offset)
        return (points + 0.5) * scale + offset - 0.5

    def cut_out(self, canvas: Tensor) -> Tensor:
        """Cut out the part of a canvas that the image fills.

        Args:
            canvas: `(..., H, W)`.

        Returns:
            `(..., h, w)`, a view of the canvas.
        """
        left, top = self.offset
        width = round(self.size[0] * self.scale[0])
        height = round(self.size[1] * self.scale[1])
        return canvas[..., top : top + height, left : left + width]

    def boxes_to_image(self, boxes: Tensor) -> Tensor:
        """Map boxes from the canvas to the image, and cut them to the image.

        Args:
            boxes: `(..., 4)`, `(x1, y1, x2, y2)` in canvas pixels.

        Returns:
            `(..., 4)` in image pixels.
        """
        check_shape(boxes, "boxes", 4)
        boxes = as_positions(boxes)
        scale = boxes.new_tensor(self.scale * 2)
        offset = boxes.new_tensor(self.offset * 2)
        image = (boxes - offset) / scale
        limit = boxes.new_tensor(self.size * 2, dtype=boxes.dtype)
        return torch.minimum(image.clamp(min=0.0), limit)


def letterbox(
    image: Tensor,
    size: tuple[int, int],
    *,
    fill: float = 0.5,
    stride: int | None = None,
    stretch: bool = False,
    corner: bool = False,
) -> tuple[Tensor, Placement]:
    """Resize images to fit into a canvas with their proportions, and pad the rest.

    Args:
        image: `(B, C, H, W)`.
        size: `(width, height)` of the canvas.
        fill: value of the padding.
        stride: pad only to the next multiple of this number of pixels, which gives the same content with fewer pixels;
            None pads to the whole canvas.
        stretch: fill the canvas without keeping the proportions; then nothing is padded.
        corner: pad only on the right and at the bottom instead of equally on all sides.

    Returns:
        The canvas `(B, C, height, width)` and the `Placement` that maps points and boxes.

    >>> canvas, placement = letterbox(torch.rand(1, 3, 480, 640), (416, 416))
    >>> canvas.shape, placement.offset
    (torch.Size([1, 3, 416, 416]), (0, 52))
    """
    check_shape(image, "image", None, None, None, None)
    height, width = image.shape[-2:]
    check(image.is_floating_point(), "image", "floating-point pixels in [0, 1]", image.dtype)
    check(height > 0 and width > 0, "image", "at least one pixel", tuple(image.shape))
    columns, rows = size if stretch else _size_within(size, width, height)
    horizontal, vertical = _padding(size, (columns, rows), stride)
    left = 0 if corner else horizontal // 2
    top = 0 if corner else vertical // 2
    right = horizontal - left
    bottom = vertical - top
    resized = resize(image, (columns, rows))
    canvas = F.pad(resized, (left, right, top, bottom), value=fill)
    scale = (columns / width, rows / height)
    return canvas, Placement((width, height), scale, (left, top))


def _padding(canvas: tuple[int, int], content: tuple[int, int], stride: int | None) -> tuple[int, int]:
    """Compute how many pixels, along x and y, pad content to a canvas, or to the next multiples of a stride."""
    if stride is None:
        return canvas[0] - content[0], canvas[1] - content[1]
    # Networks with convolutions alone take a canvas of any size that their strides divide.
    return -content[0] % stride, -content[1] % stride


def _size_within(size: tuple[int, int], width: int, height: int) -> tuple[int, int]:
    """Find the largest `(width, height)` of the proportions of an image that is within a canvas."""
    ratio = min(size[0] / width, size[1] / height)
    return max(1, round(width * ratio)), max(1, round(height * ratio))


def resize(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize images bilinearly, antialiased where they shrink to less than half.

    Args:
        image: `(B, C, H, W)`.
        size: `(width, height)` of the result.

    Returns:
        `(B, C, height, width)`, a new tensor.
    """
    # Down to half the size, plain bilinear interpolation reads every pixel, and detectors are trained with it:
    # antialiasing COCO's photographs to 416 pixels costs YOLOv3-tiny a point of AP50.
    width, height = size
    if tuple(image.shape[-2:]) == (height, width):
        return image.clone()
    if 2 * height < image.shape[-2] or 2 * width < image.shape[-1]:
        return F.interpolate(image, (height, width), mode="bilinear", align_corners=False, antialias=True)
    return F.interpolate(image, (height, width), mode="bilinear", align_corners=False)

"""Glimpses: windows of a picture at a chosen magnification, resampled without aliasing."""

import math
from typing import Literal, TypeVar, get_args

import torch
from torch import Tensor

from semfov.data.inputs import as_positions
from semfov.errors import check, check_finite, check_shape, lookup, values_known
from semfov.precision import without_autocast
from semfov.sensor.base import stacked_views

CONTEXT = 3.0
"""Side of the window of a closer look, in longer sides of the box that it shows."""

_Padding = Literal["zeros", "border", "fill"]
# Pixels of a canvas that are resampled together: with fewer the products are slow, with more they multiply more zeros.
_TOGETHER = 32

_Length = TypeVar("_Length", float, Tensor)


def glimpse(
    image: Tensor,
    boxes: Tensor,
    size: tuple[int, int],
    *,
    padding_mode: _Padding = "zeros",
    fill_value: float = 0.0,
) -> Tensor:
    r"""Resample windows of an image to one size.

    Let a window start at a and let a canvas pixel be s picture pixels wide. Canvas pixel i is a weighted mean of the
    picture pixels j. The weights form a triangle around its centre, which falls to zero one canvas pixel away, but not
    less than one picture pixel away (the antialiased bilinear filter of Pillow and torch):

    .. math:: c_i = \frac{\sum_j t_{ij} I_j}{\sum_j t_{ij}}, \qquad
              t_{ij} = \max\left(0, 1 - \frac{|a + (i + ½) s - (j + ½)|}{\max(s, 1)}\right)

    along x and along y. The triangles of the outer pixels also reach picture pixels just outside the window. The result
    is differentiable in the image and in the boxes, in their position and in their size.

    Args:
        image: `(B, C, H, W)`.
        boxes: windows `(B, G, 4)`, or `(B, 4)` for one window of each image: `(x1, y1, x2, y2)`. Coordinates are edges
            between pixels, and 0 is the left (top) border of the image. Windows may extend beyond the image. (Kornia
            gives such boxes by `kornia.geometry.boxes.Boxes.to_tensor(mode="xyxy")`.)
        size: `(width, height)` of the canvas.
        padding_mode: values outside the image, as in Kornia: `zeros`, the nearest `border` pixels, or `fill` for
            `fill_value`.
        fill_value: value outside the image with `padding_mode="fill"`.

    Returns:
        Canvases `(B, G, C, height, width)`, or `(B, C, height, width)` for one window of each image.

    Raises:
        InputError: a shape does not fit, or a window is empty or not finite.

    >>> image = torch.rand(1, 3, 40, 60)
    >>> glimpse(image, torch.tensor([[[0.0, 0, 60, 40], [20, 10, 50, 30]]]), (30, 20)).shape
    torch.Size([1, 2, 3, 20, 30])
    """
    check_shape(image, "image", None, None, None, None)
    check(min(size) >= 1, "size", "(width, height) of at least one pixel", size)
    check(image.is_floating_point(), "image", "floating-point pixels", image.dtype)
    lookup(padding_mode, get_args(_Padding), "padding mode")
    batch = image.shape[0]
    _check_windows(boxes, batch)
    # Windows stay where they are: their corners are read, and a GPU would be waited for.
    windows = as_positions(boxes if boxes.ndim == 3 else boxes[:, None], image.dtype)
    value = 0.0 if padding_mode == "zeros" else fill_value

    def canvas(b: int, g: int) -> Tensor:
        return _window(image[b], windows[b, g], size, padding_mode, value)

    no_canvas = image.new_empty(image.shape[1], size[1], size[0])
    canvases = stacked_views(canvas, batch, windows.shape[1], no_canvas)
    return canvases if boxes.ndim == 3 else canvases[:, 0]


def _check_windows(boxes: Tensor, batch: int) -> None:
    """Raise `InputError` unless boxes are windows of a batch of images, finite and with an area where that is known."""
    check_shape(boxes, "boxes", 4)
    by_image = boxes.ndim in (2, 3) and boxes.shape[0] == batch
    check(by_image, "boxes", f"shape ({batch}, G, 4) or ({batch}, 4)", tuple(boxes.shape))
    if values_known(boxes):
        check_finite(boxes.detach(), "boxes")
        sides = boxes[..., 2:] - boxes[..., :2]
        check(bool((sides > 0).all()), "boxes", "windows with a positive width and height", "an empty window")


def windows_at(points: Tensor, magnification: Tensor, size: tuple[int, int]) -> Tensor:
    r"""Compute the windows that are centred at points and fill a canvas at given magnifications.

    .. math:: (x_1, y_1, x_2, y_2) = (p + ½) \mp \frac{(w, h)}{2 m}

    Args:
        points: p, `(..., 2)` in picture pixels.
        magnification: m, `(...)`, canvas pixels for a picture pixel.
        size: `(width, height)` of the canvas, `(w, h)`.

    Returns:
        `(..., 4)`, edges between pixels.
    """
    check_shape(points, "points", 2)
    points = as_positions(points)
    return torch.cat(edges_at(points, magnification[..., None], points.new_tensor(size)), -1)


def edges_at(point: _Length, magnification: _Length, length: _Length) -> tuple[_Length, _Length]:
    """Compute the edges along one axis of a window that is centred at a point (`windows_at`).

    Args:
        point: position along the axis, in picture pixels.
        magnification: canvas pixels for a picture pixel.
        length: number of canvas pixels along the axis.

    Returns:
        The lower and the upper edge.
    """
    centre = point + 0.5
    half = length / (2 * magnification)
    return centre - half, centre + half


def window_around(box: Tensor, picture: tuple[int, int], *, context: float = CONTEXT, least: float = 1 / 3) -> Tensor:
    """Compute the window that shows a box closely, with some of its surroundings.

    It is moved to lie inside the picture. Where the picture is narrower, it is cut.

    Args:
        box: `(4,)` in pixels of the picture.
        picture: `(width, height)` of the picture.
        context: side of the square window, in longer sides of the box.
        least: its smallest side, in longer sides of the picture.

    Returns:
        The window, `(4,)`.
    """
    check_shape(box, "box", 4)
    check(min(picture) >= 1, "picture", "a width and a height in pixels", picture)
    box = as_positions(box)
    upper_left = box[:2]
    lower_right = box[2:]
    size = box.new_tensor(picture)
    wanted_side = (context * (lower_right - upper_left).amax()).clamp(min=least * max(picture))
    side = torch.minimum(wanted_side, size)  # (2,), as a narrow picture cuts the square
    centred_start = (upper_left + lower_right - side) / 2
    start = torch.minimum(centred_start.clamp(min=0), size - side)
    return torch.cat([start, start + side])


def _window(image: Tensor, box: Tensor, size: tuple[int, int], padding: _Padding, value: float) -> Tensor:
    """Resample one window of an image: two matrix products, over the pixels that the window shows.

    Args:
        image: `(C, H, W)`.
        box: the window `(4,)`, edges between pixels.
        size: `(width, height)` of the canvas.
        padding: what is outside the image.
        value: the value there, unless it is the nearest border.

    Returns:
        The canvas, `(C, height, width)`.
    """
    width, height = size
    x1, y1, x2, y2 = box.unbind(-1)
    border = padding == "border"
    columns, (left, right) = _weights(x1, x2, width, image.shape[-1], border=border)
    rows, (top, bottom) = _weights(y1, y2, height, image.shape[-2], border=border)
    part = image[:, top:bottom, left:right]  # (C, h, w)
    columns = columns.to(part)  # (width, w)
    rows = rows.to(part)  # (height, h)
    # Weights end at the image, as if 0 followed; another value is subtracted before and added after.
    if value:
        part = part - value
    if _can_skip_zeros(image, part, box):
        canvas = _product_in_bands(rows, part, columns, box.tolist(), (left, top))
    else:
        with without_autocast(part):
            canvas = rows @ part @ columns.mT
    return canvas + value if value else canvas


def _can_skip_zeros(image: Tensor, part: Tensor, box: Tensor) -> bool:
    """Tell whether the products may be written in bands: on a CPU, where no gradient and no graph needs them whole."""
    is_recorded = torch.is_grad_enabled() and (image.requires_grad or box.requires_grad)
    return image.device.type == "cpu" and part.numel() > 0 and not is_recorded and values_known(image, box)


def _product_in_bands(rows: Tensor, part: Tensor, columns: Tensor, box: list[float], corner: tuple[int, int]) -> Tensor:
    """Compute `rows @ part @ columns.mT`, without most of the zeros in the weights.

    Args:
        rows: weights of the rows, `(height, h)`.
        part: what the window shows of the image, `(C, h, w)`.
        columns: weights of the columns, `(width, w)`.
        box: the window, edges between pixels of the image.
        corner: first pixel `(x, y)` of the part in the image.

    Returns:
        The canvas, `(C, height, width)`.
    """
    x1, y1, x2, y2 = box
    left, top = corner
    height = len(rows)
    width = len(columns)
    between = part.new_empty(len(part), height, part.shape[-1])
    canvas = part.new_empty(len(part), height, width)
    _fill(between, rows, part, y1 - top, y2 - top)
    _fill(canvas.mT, columns, between.mT, x1 - left, x2 - left)
    return canvas


def _fill(result: Tensor, weight: Tensor, part: Tensor, start: float, end: float) -> None:
    """Resample the columns of planes, some pixels of the canvas at a time, from the pixels that they show.

    The matrix of weights is zero far from its diagonal, where nothing is multiplied.

    Args:
        result: memory for the canvas, `(C, count, w)`.
        weight: weights of the pixels in each pixel of the canvas, `(count, n)`.
        part: the planes, `(C, n, w)`.
        start: upper edge of the window in pixels of the part.
        end: its lower edge.
    """
    count, length = weight.shape
    step = (end - start) / count
    reach = max(step, 1.0) + 1  # of a triangle, and a pixel for rounding
    together = _TOGETHER if length > 4 * _TOGETHER else count
    for first in range(0, count, together):
        last = min(first + together, count)
        first_centre = start + (first + 0.5) * step
        last_centre = start + (last - 0.5) * step
        first_shown = math.floor(first_centre - reach)
        end_shown = math.ceil(last_centre + reach)
        # At least one pixel, also for a part that shows none.
        begin = min(max(first_shown, 0), length - 1)
        stop = min(max(end_shown, begin + 1), length)
        matrix = weight[first:last, begin:stop].expand(len(part), -1, -1)
        torch.bmm(matrix, part[:, begin:stop], out=result[:, first:last])


def _weights(start: Tensor, end: Tensor, count: int, length: int, *, border: bool) -> tuple[Tensor, tuple[int, int]]:
    """Compute the weights of picture pixels in every canvas pixel along one axis.

    Args:
        start: lower edge of the window along the axis, `()`.
        end: its upper edge, `()`.
        count: number of canvas pixels.
        length: number of picture pixels.
        border: continue the picture by its outer pixels, instead of black.

    Returns:
        Weights `(count, n)` of n picture pixels, and the range of these pixels.
    """
    step = (end - start) / count
    reach = step.clamp(min=1.0)
    middle = start + (torch.arange(count).to(start) + 0.5) * step
    if not values_known(start, end):
        return _weights_of_all(middle, reach, length, border=border), (0, length)

    # The pixels that some triangle reaches, also outside the picture: all weights of a canvas pixel sum to 1.
    first_reached = (start - reach).floor()
    last_reached = (end + reach).ceil()
    first, end_of_reached = torch.stack([first_reached, last_reached + 1]).detach().long().tolist()
    centre = torch.arange(first, end_of_reached, device=start.device).to(start) + 0.5
    distance = (middle[:, None] - centre).abs()  # (count, pixels)
    triangle = (1 - distance / reach).clamp(min=0)
    weight = triangle / triangle.sum(-1, keepdim=True)
    if border:
        return _moved_to_border(weight, first, length)
    return _inside(weight, first, length)


def _inside(weight: Tensor, first: int, length: int) -> tuple[Tensor, tuple[int, int]]:
    """Leave out the weights of pixels outside the picture, whose values are 0.

    Args:
        weight: weights `(count, n)` of n pixels.
        first: number of the first of these pixels.
        length: number of picture pixels.

    Returns:
        The weights of pixels of the picture, and the range of these pixels; there may be none.
    """
    end = first + weight.shape[1]
    begin = min(max(first, 0), length)
    stop = min(max(end, begin), length)
    return weight[:, begin - first : stop - first], (begin, stop)


def _moved_to_border(weight: Tensor, first: int, length: int) -> tuple[Tensor, tuple[int, int]]:
    """Add the weights of pixels outside the picture to those of the nearest pixel inside, as `_inside`."""
    end = first + weight.shape[1]
    begin = min(max(first, 0), length - 1)
    stop = min(max(end, begin + 1), length)
    pixel = torch.arange(first, end, device=weight.device)
    nearest = pixel.clamp(0, length - 1) - begin
    return weight.new_zeros(len(weight), stop - begin).index_add(1, nearest, weight), (begin, stop)


def _weights_of_all(middle: Tensor, reach: Tensor, length: int, *, border: bool) -> Tensor:
    """Compute the weights of all pixels of a picture, in a graph of one shape for all windows.

    Args:
        middle: middles of the canvas pixels, `(count,)` in picture pixels, edges between pixels.
        reach: half the base of the triangles, `()`.
        length: number of picture pixels.
        border: continue the picture by its outer pixels, instead of black.

    Returns:
        `(count, length)`.
    """
    place = middle - 0.5
    pixel = torch.arange(length)
    distance = (place[:, None] - pixel.to(place)).abs()  # (count, length)
    weight = (1 - distance / reach).clamp(min=0)
    # The whole triangle, on an endless line of pixels: the part on either side of its middle.
    fraction = place - place.floor()
    total = _beyond(fraction, reach) + _beyond(1 - fraction, reach)
    if border:
        pixel = pixel.to(place.device)
        before_first = _outside(place, reach, total)[:, None]
        after_last = _outside(length - 1 - place, reach, total)[:, None]
        weight = weight + before_first * (pixel == 0) + after_last * (pixel == length - 1)
    return weight / total[:, None]


def _outside(inwards: Tensor, reach: Tensor, total: Tensor) -> Tensor:
    """Sum the part of each triangle that is beyond a border of the picture.

    Args:
        inwards: distance of the triangle's middle from the outermost pixel, `(count,)`, negative outside the picture.
        reach: half the base of the triangles, `()`.
        total: sum of each whole triangle, `(count,)`.

    Returns:
        `(count,)`.
    """
    from_inside = _beyond((inwards + 1).clamp(min=0), reach)
    from_outside = total - _beyond((-inwards).clamp(min=0), reach)
    return torch.where(inwards >= -1, from_inside, from_outside)


def _beyond(distance: Tensor, reach: Tensor) -> Tensor:
    """Sum the triangle 1 - d / reach over d = distance, distance + 1, … up to the reach."""
    count = (reach - distance).floor().clamp(min=-1) + 1
    # The sum of `count` numbers d, d + 1, …
    distances = count * distance + count * (count - 1) / 2
    return count - distances / reach

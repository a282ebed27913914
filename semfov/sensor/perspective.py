"""Perspective views of a panorama, in any direction and with any field of view."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.inputs import as_positions
from semfov.errors import check, check_shape, values_known
from semfov.sensor.base import stacked_views
from semfov.sensor.sphere import Camera, panorama_points


def perspective(panorama: Tensor, pose: Tensor, size: tuple[int, int], *, antialias: bool = True) -> Tensor:
    r"""Compute the views of an equirectangular panorama through a camera that turns and zooms.

    Each pixel of a view is a bilinear sample of the panorama in the pixel's direction. The left and the right border of
    the panorama are joined. Beyond a pole a column continues in the column half a turn away.

    Where a view shrinks the panorama, `antialias` takes the mean of k × k samples for each pixel; k is the number of
    panorama pixels that a pixel in the middle of the view covers along each axis, rounded up. Towards the poles a row
    of the panorama oversamples the sphere, so `antialias` first smooths all rows to one resolution (`go_around`).

    The result is differentiable in the panorama and in yaw, pitch and field of view.

    Args:
        panorama: `(B, C, H, W)` with an even number of columns; twice as wide as high where pixels are square.
        pose: `(B, G, 3)`, or `(B, 3)` for one view of each panorama: yaw, pitch and horizontal field of view in
            degrees (`semfov.sensor.sphere.Camera`).
        size: `(width, height)` of the views.
        antialias: smooth where a view shrinks the panorama; False takes one bilinear sample for each pixel.

    Returns:
        Views `(B, G, C, height, width)`, or `(B, C, height, width)` for one view of each panorama.

    Raises:
        InputError: a shape does not fit, or a field of view is not between 0 and 180 degrees.

    >>> perspective(torch.rand(1, 3, 64, 128), torch.tensor([[[0.0, 0.0, 60.0], [180.0, 45.0, 90.0]]]), (40, 30)).shape
    torch.Size([1, 2, 3, 30, 40])
    """
    check_shape(panorama, "panorama", None, None, None, None)
    check(panorama.is_floating_point(), "panorama", "floating-point pixels", panorama.dtype)
    batch = panorama.shape[0]
    columns = panorama.shape[-1]
    joins = "an even number of columns, because a pole joins columns half a turn apart"
    check(columns % 2 == 0, "panorama", joins, columns)
    check_shape(pose, "pose", 3)
    by_panorama = pose.ndim in (2, 3) and pose.shape[0] == batch
    check(by_panorama, "pose", f"shape ({batch}, G, 3) or ({batch}, 3)", tuple(pose.shape))
    poses = as_positions(pose if pose.ndim == 3 else pose[:, None], panorama)
    source = go_around(panorama, even=antialias)

    def view(b: int, g: int) -> Tensor:
        return sample(source[b], poses[b, g], size, antialias=antialias)

    no_view = panorama.new_empty(panorama.shape[1], size[1], size[0])
    views = stacked_views(view, batch, poses.shape[1], no_view)
    return views if pose.ndim == 3 else views[:, 0]


def go_around(panorama: Tensor, *, even: bool = True) -> Tensor:
    """Continue a panorama beyond its sides and poles by a border of one pixel.

    Args:
        panorama: `(..., H, W)`.
        even: smooth its rows to one resolution first (`_even_rows`).

    Returns:
        `(..., H + 2, W + 2)`.
    """
    panorama = _even_rows(panorama) if even else panorama
    half = panorama.shape[-1] // 2
    above = panorama[..., :1, :].roll(half, -1)
    below = panorama[..., -1:, :].roll(half, -1)
    rows = torch.cat([above, panorama, below], -2)  # (..., H + 2, W); beyond a pole lies the other half of its row
    return torch.cat([rows[..., -1:], rows, rows[..., :1]], -1)


def _even_rows(panorama: Tensor) -> Tensor:
    r"""Smooth every row of a panorama `(..., H, W)` to the resolution of the horizon.

    A pixel at latitude φ covers cos φ times the width of a pixel at the horizon. Each pixel becomes the mean of the row
    over :math:`\min(1 / \cos\varphi, W)` pixels around it. The integral of a row is piecewise linear, so the mean is
    exact for any width.
    """
    rows, columns = panorama.shape[-2:]
    # In float64, because a mean is a small difference of long sums.
    row = torch.arange(rows, dtype=torch.float64, device=panorama.device)
    column = torch.arange(columns, dtype=torch.float64, device=panorama.device)
    half_turns = (row + 0.5) / rows - 0.5  # of latitude
    latitude = half_turns * torch.pi
    width = (1 / latitude.cos()).clamp(max=columns)[:, None]
    # Two rounds of each row: a mean around a pixel of the middle of them never leaves them.
    twice = torch.cat([panorama, panorama], -1).double()
    total = F.pad(twice.cumsum(-1), (1, 0))
    middle = column + columns / 2 + 0.5

    def integral(place: Tensor) -> Tensor:
        """Integrate each row from its begin to the places `(H, W)`."""
        pixel = place.floor().long().clamp(0, 2 * columns - 1)
        index = pixel.expand(*panorama.shape[:-2], rows, columns)
        whole_pixels = total.gather(-1, index)
        last_pixel = (place - pixel) * twice.gather(-1, index)
        return whole_pixels + last_pixel

    upper = integral(middle + width / 2)
    lower = integral(middle - width / 2)
    means = (upper - lower) / width
    return means.roll(columns // 2, -1).to(panorama)


def sample(source: Tensor, pose: Tensor, size: tuple[int, int], *, antialias: bool = True) -> Tensor:
    """Compute one view of one panorama; see `perspective`.

    Args:
        source: the panorama `(C, H + 2, W + 2)`, with the border of `go_around`.
        pose: `(3,)`, yaw, pitch and field of view in degrees.
        size: `(width, height)` of the view, `(w, h)`.
        antialias: take the mean of several samples for each pixel where the view shrinks the panorama.

    Returns:
        `(C, h, w)`.
    """
    width = source.shape[-1] - 2
    height = source.shape[-2] - 2
    camera = Camera(pose, size)
    samples = _samples(camera, width) if antialias else 1
    x = _sample_positions(size[0], samples, pose)
    y = _sample_positions(size[1], samples, pose)
    grid = torch.stack(torch.broadcast_tensors(x, y[:, None]), -1)
    directions = camera.directions(grid.flatten(0, 1))
    points = panorama_points(directions, (width, height)).unflatten(0, grid.shape[:2])
    # Places in the source from -1 to 1, beyond its border of one pixel.
    sides = points.new_tensor([width + 2, height + 2])
    place = as_positions((2 * points + 3) / sides - 1, source)
    image = source.to(place.dtype)
    view = F.grid_sample(image[None], place[None], mode="bilinear", align_corners=False)
    if samples > 1:
        view = F.avg_pool2d(view, samples)
    return view[0].to(source.dtype)


def _samples(camera: Camera, width: int) -> int:
    """Count the samples along each axis for a pixel of a view: panorama pixels that one in its middle covers."""
    is_known = values_known(camera.pose)
    check(is_known, "antialias", "False where the pose is not known, as in vmap and torch.export", True)
    panorama_pixels = width / (2 * math.pi * float(camera.focal.detach()))  # that a pixel in the middle covers
    return max(1, math.ceil(panorama_pixels - 1e-6))


def _sample_positions(pixels: int, samples: int, like: Tensor) -> Tensor:
    """Place several samples in each pixel of a line, evenly, `(pixels · samples,)`."""
    index = torch.arange(pixels * samples, dtype=like.dtype, device=like.device)
    return (index + 0.5) / samples - 0.5

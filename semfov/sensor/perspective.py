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
    batch, wide = panorama.shape[0], panorama.shape[-1]
    check(wide % 2 == 0, "panorama", "an even number of columns, because a pole joins columns half a turn apart", wide)
    check_shape(pose, "pose", 3)
    fits = pose.ndim in (2, 3) and pose.shape[0] == batch
    check(fits, "pose", f"shape ({batch}, G, 3) or ({batch}, 3)", tuple(pose.shape))
    poses = as_positions(pose if pose.ndim == 3 else pose[:, None], panorama)
    source = go_around(panorama, even=antialias)

    result = stacked_views(
        lambda b, g: sample(source[b], poses[b, g], size, antialias=antialias),
        batch,
        poses.shape[1],
        panorama.new_empty(panorama.shape[1], size[1], size[0]),
    )
    return result if pose.ndim == 3 else result[:, 0]


def go_around(panorama: Tensor, *, even: bool = True) -> Tensor:
    """A panorama `(..., H, W)`, smoothed (`_even_rows`), with a border that continues it beyond sides and poles."""
    panorama = _even_rows(panorama) if even else panorama
    half = panorama.shape[-1] // 2
    above, below = panorama[..., :1, :].roll(half, -1), panorama[..., -1:, :].roll(half, -1)
    high = torch.cat([above, panorama, below], -2)
    return torch.cat([high[..., -1:], high, high[..., :1]], -1)


def _even_rows(panorama: Tensor) -> Tensor:
    r"""Smooth every row of a panorama `(..., H, W)` to the resolution of the horizon.

    A pixel at latitude φ covers cos φ times the width of a pixel at the horizon. Each pixel becomes the mean of the row
    over :math:`\min(1 / \cos\varphi, W)` pixels around it. The integral of a row is piecewise linear, so the mean is
    exact for any width.
    """
    high, wide = panorama.shape[-2:]
    latitude = (torch.arange(high, dtype=torch.float64, device=panorama.device) + 0.5) / high - 0.5
    width = (1 / (latitude * torch.pi).cos()).clamp(max=wide)
    # In float64, because a mean is a small difference of long sums.
    twice = torch.cat([panorama, panorama], -1).double()
    total = F.pad(twice.cumsum(-1), (1, 0))
    middle = torch.arange(wide, dtype=torch.float64, device=panorama.device) + wide / 2 + 0.5

    def up_to(place: Tensor) -> Tensor:
        low = place.floor().long().clamp(0, 2 * wide - 1)
        index = low.expand(*panorama.shape[:-2], high, wide)
        return total.gather(-1, index) + (place - low) * twice.gather(-1, index)

    means = (up_to(middle + width[:, None] / 2) - up_to(middle - width[:, None] / 2)) / width[:, None]
    return means.roll(wide // 2, -1).to(panorama)


def sample(source: Tensor, pose: Tensor, size: tuple[int, int], *, antialias: bool = True) -> Tensor:
    """A view `(C, h, w)` of a panorama `(C, H + 2, W + 2)` with the border of `go_around`; see `perspective`."""
    (wide, high), (columns, rows) = (source.shape[-1] - 2, source.shape[-2] - 2), size
    camera = Camera(pose, size)
    times = 1
    if antialias:
        known = values_known(pose)
        check(known, "antialias", "False where the pose is not known, as in vmap and torch.export", antialias)
        times = max(1, math.ceil(wide / (2 * math.pi * float(camera.focal.detach())) - 1e-6))
    y, x = (
        (torch.arange(n * times, dtype=pose.dtype, device=pose.device) + 0.5) / times - 0.5 for n in (rows, columns)
    )
    grid = torch.stack(torch.broadcast_tensors(x, y[:, None]), -1)
    points = panorama_points(camera.directions(grid.flatten(0, 1)), (wide, high)).unflatten(0, grid.shape[:2])
    place = (2 * points + 3) / points.new_tensor([wide + 2, high + 2]) - 1
    place = as_positions(place, source)
    view = F.grid_sample(source[None].to(place.dtype), place[None], mode="bilinear", align_corners=False)
    return (F.avg_pool2d(view, times) if times > 1 else view)[0].to(source.dtype)

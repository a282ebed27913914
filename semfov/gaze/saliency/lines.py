"""Blur and enlargement of images as products of matrices with their lines.

On a CPU this is several times faster than a convolution of few channels, above all for wide kernels.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.errors import check, check_shape, values_known
from semfov.sensor.pyramid import constant

# Pixels that one product makes at once: more of them multiply more zeros, fewer make the products slow.
_TILE = 24
# Up to this many pixels lines are made by one dense matrix, beyond it by one for every tile.
_SMALL = 160


class Lines(NamedTuple):
    """A matrix that makes lines of other lengths out of lines, and is zero far from its diagonal.

    Attributes:
        first: what makes the first pixels of a line, `(a, n)`; without `middle`, all of them.
        middle: what makes each of the tiles that follow, `(tile, window)`.
        last: what makes the pixels that remain, `(b, m)`.
        tiles: how many follow.
        start: where on the line the window of the first of them begins.
        shift: how far apart the windows of two in succession lie.
    """

    first: Tensor
    middle: Tensor | None = None
    last: Tensor | None = None
    tiles: int = 0
    start: int = 0
    shift: int = 0


def gaussian_kernel(sigma: float) -> Tensor:
    r"""Weights of a Gaussian, `(2r+1,)` in float64.

    .. math:: w_i \propto \exp(-i^2 / 2\sigma^2), \quad |i| \le r, \quad 2r + 1 = \mathrm{round}(8\sigma + 1)

    the number of taps made odd by rounding up: OpenCV's kernel for floats where no size is given.

    >>> gaussian_kernel(0.25)
    tensor([3.3524e-04, 9.9933e-01, 3.3524e-04], dtype=torch.float64)
    """
    check(sigma > 0, "sigma", "a positive number of pixels", sigma)
    radius = (round(8 * sigma + 1) | 1) // 2
    weight = torch.exp(-(torch.arange(-radius, radius + 1).double() ** 2) / (2 * sigma**2))
    return weight / weight.sum()


def gaussian_blur(image: Tensor, sigma: float, *, halve: bool = False) -> Tensor:
    """Blur with a Gaussian, borders continued: `cv2.GaussianBlur` of floats with `BORDER_REPLICATE`.

    Args:
        image: `(B, C, H, W)`.
        sigma: standard deviation in pixels, see `gaussian_kernel`.
        halve: keep only the first of every two pixels, `floor(n / 2)` of n (at least 1) along each axis.

    >>> gaussian_blur(torch.ones(1, 3, 5, 7), 2.0, halve=True).shape
    torch.Size([1, 3, 2, 3])
    """
    check_shape(image, "image", None, None, None, None)
    check(min(image.shape[-2:]) > 0, "image", "at least one pixel", tuple(image.shape))
    check(sigma > 0, "sigma", "a positive number of pixels", sigma)
    height, width = (_blurring(n, sigma, 2 if halve else 1, image.dtype, image.device) for n in image.shape[-2:])
    return separable(image, height, width)


def enlarge(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Enlarge an image `(..., h, w)` to `(height, width)` by cubic interpolation (a = -0.75): `cv2.INTER_CUBIC`.

    >>> enlarge(torch.rand(1, 2, 3), (4, 5)).shape
    torch.Size([1, 4, 5])
    """
    check_shape(image, "image", None, None)
    if tuple(image.shape[-2:]) == tuple(size):
        return image
    lengths = zip(image.shape[-2:], size, strict=True)
    return separable(image, *(_enlarging(count, length, image.dtype, image.device) for count, length in lengths))


def separable(image: Tensor, down: Lines, across: Lines) -> Tensor:
    """Columns of an image `(..., h, w)` made into others by `down`, its rows by `across`.

    A product reads a transposed image as quickly, so that two make both axes without a copy.
    """
    if not values_known() or (image.requires_grad and torch.is_grad_enabled()):
        return _product(_product(image.mT, across).mT, down)
    if down.middle is None and across.middle is None:
        return down.first @ (image @ across.first.mT)
    planes = image.reshape(image.shape[:-2].numel(), *image.shape[-2:])
    # Fresh memory costs as much as a product: what lies between both is one plane, used again.
    between = image.new_empty(_length(across), image.shape[-2])
    result = image.new_empty(len(planes), _length(down), len(between))
    for plane, made in zip(planes, result, strict=True):
        _write(plane.mT, across, between)
        _write(between.mT, down, made)
    return result.reshape(*image.shape[:-2], *result.shape[-2:])


def _product(image: Tensor, lines: Lines) -> Tensor:
    """Columns made into others."""
    if lines.middle is None or lines.last is None:
        return lines.first @ image
    top, bottom = (
        lines.first @ image[..., : lines.first.shape[1], :],
        lines.last @ image[..., -lines.last.shape[1] :, :],
    )
    return torch.cat([top, (lines.middle @ _windows(image, lines)).flatten(-3, -2), bottom], -2)


def _write(image: Tensor, lines: Lines, out: Tensor) -> None:
    """The same of one plane, into memory that is there."""
    top = len(lines.first)
    torch.mm(lines.first, image[: lines.first.shape[1]], out=out[:top])
    if lines.middle is not None and lines.last is not None:
        bottom = len(out) - len(lines.last)
        matrices, inner = lines.middle.expand(lines.tiles, -1, -1), out[top:bottom].unflatten(0, (lines.tiles, -1))
        torch.bmm(matrices, _windows(image, lines), out=inner)
        torch.mm(lines.last, image[-lines.last.shape[1] :], out=out[bottom:])


def _windows(image: Tensor, lines: Lines) -> Tensor:
    """What the tiles are made of, overlapping: `(..., tiles, window, w)`."""
    assert lines.middle is not None
    window = lines.middle.shape[1]
    stop = lines.start + (lines.tiles - 1) * lines.shift + window
    return image[..., lines.start : stop, :].unfold(-2, window, lines.shift).mT


def _length(lines: Lines) -> int:
    """Pixels of the lines that are made."""
    inner = 0 if lines.middle is None else lines.tiles * len(lines.middle)
    return len(lines.first) + inner + (0 if lines.last is None else len(lines.last))


@constant
def _blurring(count: int, sigma: float, step: int, dtype: torch.dtype, device: torch.device) -> Lines:
    """Blur of lines of `count` pixels, of which one of `step` is kept."""
    kernel = gaussian_kernel(sigma)

    def matrix(count: int) -> Tensor:
        length = max(count // step, 1)
        index = torch.arange(length)[:, None] * step + torch.arange(len(kernel)) - len(kernel) // 2
        weights = kernel.expand(length, -1)
        return torch.zeros(length, count, dtype=torch.float64).scatter_add(1, index.clamp(0, count - 1), weights)

    return _cut(matrix, count, _TILE, _TILE * step, len(kernel) // 2, dtype, device)


@constant
def _enlarging(count: int, length: int, dtype: torch.dtype, device: torch.device) -> Lines:
    """Cubic interpolation of lines of `count` pixels at `length`."""
    ratio, rest = divmod(length, count)
    if rest:
        return Lines(_cubic_matrix(count, length).to(device, dtype))
    shift = max(_TILE // ratio, 1)
    return _cut(lambda count: _cubic_matrix(count, ratio * count), count, shift * ratio, shift, 2, dtype, device)


def _cut(
    matrix: Callable[[int], Tensor],
    count: int,
    tile: int,
    shift: int,
    reach: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Lines:
    """The matrix for lines of `count` pixels, of which all tiles but the outermost are alike.

    Args:
        matrix: makes it for lines of so many pixels.
        count: pixels of a line.
        tile: pixels made at once.
        shift: pixels of the lines that lie under a tile.
        reach: pixels before and behind that it needs too.
    """
    before = -(-reach // shift)
    tiles = (count - reach) // shift - before
    if count * max(tile, shift) <= _SMALL * shift or tiles < 2:
        return Lines(matrix(count).to(device, dtype))
    # The outermost tiles, and what remains, are those of a line with one tile in between.
    short = matrix(count - (tiles - 1) * shift).to(device, dtype)
    top, start, window = before * tile, before * shift - reach, shift + 2 * reach
    return Lines(
        short[:top, : start + 2 * reach].contiguous(),
        short[top : top + tile, start : start + window].contiguous(),
        short[top + tile :, start + shift :].contiguous(),
        tiles,
        start,
        shift,
    )


def _cubic_matrix(count: int, length: int) -> Tensor:
    """`(length, count)`: Keys' cubic convolution with a = -0.75, pixels as areas, borders continued."""
    place = (torch.arange(length).double() + 0.5) * (count / length) - 0.5
    index = place.floor().long()[:, None] + torch.arange(-1, 3)
    distance = (place[:, None] - index).abs()
    a = -0.75
    near = ((a + 2) * distance - (a + 3)) * distance**2 + 1
    far = a * (((distance - 5) * distance + 8) * distance - 4)
    matrix = torch.zeros(length, count, dtype=torch.float64)
    return matrix.scatter_add(1, index.clamp(0, count - 1), torch.where(distance <= 1, near, far))

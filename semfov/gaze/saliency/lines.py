"""Blur and enlargement of images as products of matrices with their lines.

On a CPU this is several times faster than a convolution of few channels, above all for wide kernels.
"""

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check, check_shape

# Pixels that one product makes at once: more of them multiply more zeros, fewer copy more pixels twice.
_TILE = 32


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
    step = 2 if halve else 1
    return _blur(_blur(image, -1, sigma, step), -2, sigma, step)


def enlarge(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Enlarge an image `(..., h, w)` to `(height, width)` by cubic interpolation (a = -0.75): `cv2.INTER_CUBIC`.

    >>> enlarge(torch.rand(1, 2, 3), (4, 5)).shape
    torch.Size([1, 4, 5])
    """
    check_shape(image, "image", None, None)
    height, width = size
    # A compiler traces the matrices into its graph; a cache would be a side effect.
    matrix = _cubic_matrix if torch.compiler.is_compiling() else _cached_cubic_matrix
    if image.shape[-1] != width:
        image = image @ matrix(image.shape[-1], width, image.dtype, image.device).mT
    if image.shape[-2] != height:
        image = matrix(image.shape[-2], height, image.dtype, image.device) @ image
    return image


def _blur(image: Tensor, axis: int, sigma: float, step: int) -> Tensor:
    """Blur along one axis and keep the first of every `step` pixels."""
    batch, channels, height, width = image.shape
    count = image.shape[axis]
    length = max(count // step, 1)
    tile = min(_TILE, length)
    tiles = -(-length // tile)
    blocks = _block if torch.compiler.is_compiling() else _cached_block
    block = blocks(sigma, tile, step, image.dtype, image.device)
    # Every tile is the same product with a window of the line that reaches as far as its outermost taps.
    window = block.shape[1]
    radius = (window - (tile - 1) * step) // 2
    after = max((tiles - 1) * tile * step + window - radius - count, 0)
    padding = (radius, after, 0, 0) if axis == -1 else (0, 0, radius, after)
    windows = F.pad(image, padding, mode="replicate").unfold(axis, window, tile * step)
    if axis == -1:
        # One product for all lines: `matmul` would make one of each.
        blurred = windows.reshape(-1, window) @ block.mT
        return blurred.reshape(batch, channels, height, tiles * tile)[..., :length]
    windows = windows.mT.reshape(-1, window, width)
    blurred = torch.bmm(block.expand(len(windows), -1, -1), windows)
    return blurred.reshape(batch, channels, tiles * tile, width)[..., :length, :]


def _block(sigma: float, tile: int, step: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`(tile, window)`: the kernel in every row, each `step` pixels further than the one before."""
    kernel = gaussian_kernel(sigma)
    index = torch.arange(tile)[:, None] * step + torch.arange(len(kernel))
    block = torch.zeros(tile, (tile - 1) * step + len(kernel), dtype=torch.float64)
    return block.scatter(1, index, kernel.expand(tile, -1)).to(device, dtype)


def _cubic_matrix(count: int, length: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`(length, count)`: Keys' cubic convolution with a = -0.75, pixels as areas, borders continued."""
    place = (torch.arange(length).double() + 0.5) * (count / length) - 0.5
    index = place.floor().long()[:, None] + torch.arange(-1, 3)
    distance = (place[:, None] - index).abs()
    a = -0.75
    near = ((a + 2) * distance - (a + 3)) * distance**2 + 1
    far = a * (((distance - 5) * distance + 8) * distance - 4)
    matrix = torch.zeros(length, count, dtype=torch.float64)
    matrix = matrix.scatter_add(1, index.clamp(0, count - 1), torch.where(distance <= 1, near, far))
    return matrix.to(device, dtype)


@lru_cache(maxsize=64)
def _cached_block(sigma: float, tile: int, step: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    # Tensors born in inference mode could not take part in a later backward pass.
    with torch.inference_mode(False), torch.no_grad():
        return _block(sigma, tile, step, dtype, device)


@lru_cache(maxsize=64)
def _cached_cubic_matrix(count: int, length: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False), torch.no_grad():
        return _cubic_matrix(count, length, dtype, device)

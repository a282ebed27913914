"""Linear maps along one axis of an image as banded matrices: blur, subsampling and enlargement as few matrix products.

On a CPU this is several times faster than a convolution of one channel, and the borders are part of the matrix.
"""

from functools import lru_cache

import torch
from torch import Tensor

# Rows of one block: a larger block multiplies more zeros, a smaller one makes smaller products.
_ROWS = 48

Blocks = tuple[tuple[int, int, Tensor], ...]


def gaussian_blur(image: Tensor, sigma: float, *, halve: bool = False) -> Tensor:
    r"""Blur with a Gaussian, the outermost pixels continued beyond the borders.

    .. math:: w_i \propto \exp(-i^2 / 2\sigma^2), \quad |i| \le r, \quad 2r + 1 = \mathrm{round}(8\sigma + 1)

    the odd number of taps rounded up: `cv2.GaussianBlur` of floats with `BORDER_REPLICATE` and no kernel size.

    Args:
        image: `(..., H, W)`.
        sigma: standard deviation in pixels.
        halve: keep only pixels `floor(i n / m)` of each axis, `m = floor(n / 2)` of n (nearest-neighbour halving).

    >>> gaussian_blur(torch.ones(1, 3, 5, 7), 2.0, halve=True).shape
    torch.Size([1, 3, 2, 3])
    """
    step = 2 if halve else 1
    for axis in (-2, -1):
        image = _apply(_blocks("gaussian", image, axis, sigma, max(image.shape[axis] // step, 1)), image, axis)
    return image


def enlarge(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Enlarge an image `(..., h, w)` to `(height, width)` by cubic interpolation (a = -0.75): `cv2.INTER_CUBIC`.

    >>> enlarge(torch.rand(1, 2, 3), (4, 5)).shape
    torch.Size([1, 4, 5])
    """
    for axis in (-2, -1):
        if image.shape[axis] != size[axis]:
            image = _apply(_blocks("cubic", image, axis, 0.0, size[axis]), image, axis)
    return image


def _apply(blocks: Blocks, image: Tensor, axis: int) -> Tensor:
    if axis == -2:
        pieces = [matrix @ image[..., start:stop, :] for start, stop, matrix in blocks]
    else:
        pieces = [image[..., start:stop] @ matrix.mT for start, stop, matrix in blocks]
    return pieces[0] if len(pieces) == 1 else torch.cat(pieces, axis)


def _blocks(kind: str, image: Tensor, axis: int, sigma: float, length: int) -> Blocks:
    # A compiler traces the matrices into its graph; a cache would be a side effect.
    build = _build if torch.compiler.is_compiling() else _cached
    return build(kind, image.shape[axis], sigma, length, image.dtype, image.device)


def _build(kind: str, count: int, sigma: float, length: int, dtype: torch.dtype, device: torch.device) -> Blocks:
    """Blocks `(first pixel, end, matrix)` of the map from lines of `count` pixels to lines of `length`."""
    index, weight = _gaussian(count, sigma, length) if kind == "gaussian" else _cubic(count, length)
    reach = int(weight.shape[1])
    blocks = []
    for first in range(0, length, _ROWS):
        last = min(first + _ROWS, length) - 1
        # Where the outermost taps of the block's first and last row lie.
        start = max(_middle(kind, first, count, length) - reach // 2, 0)
        stop = min(_middle(kind, last, count, length) + reach // 2 + 1, count)
        matrix = torch.zeros(last + 1 - first, stop - start, dtype=torch.float64)
        matrix = matrix.scatter_add(1, index[first : last + 1] - start, weight[first : last + 1])
        blocks.append((start, stop, matrix.to(device, dtype)))
    return tuple(blocks)


@lru_cache(maxsize=256)
def _cached(kind: str, count: int, sigma: float, length: int, dtype: torch.dtype, device: torch.device) -> Blocks:
    # Tensors born in inference mode could not take part in a later backward pass.
    with torch.inference_mode(False), torch.no_grad():
        return _build(kind, count, sigma, length, dtype, device)


def _middle(kind: str, row: int, count: int, length: int) -> int:
    """Pixel on which the taps of a row of the matrix are centred."""
    if kind == "gaussian":
        return row * count // length
    return ((2 * row + 1) * count - length) // (2 * length)


def _gaussian(count: int, sigma: float, length: int) -> tuple[Tensor, Tensor]:
    """Pixels and weights of every tap, `(length, taps)`."""
    radius = (round(8 * sigma + 1) | 1) // 2
    offset = torch.arange(-radius, radius + 1)
    weight = torch.exp(-(offset.double() ** 2) / (2 * sigma**2))
    middle = torch.arange(length) * count // length
    return (middle[:, None] + offset).clamp(0, count - 1), (weight / weight.sum()).expand(length, -1)


def _cubic(count: int, length: int) -> tuple[Tensor, Tensor]:
    """Pixels and weights of every tap, `(length, 5)`; the first tap is idle, so that the taps have a middle."""
    numerator = (2 * torch.arange(length) + 1) * count - length
    middle = numerator.div(2 * length, rounding_mode="floor")
    offset = torch.arange(-2, 3)
    distance = (numerator.double() / (2 * length) - middle)[:, None].sub(offset).abs()
    a = -0.75
    near = ((a + 2) * distance - (a + 3)) * distance**2 + 1
    far = a * (((distance - 5) * distance + 8) * distance - 4)
    weight = torch.where(distance <= 1, near, torch.where(distance < 2, far, 0.0))
    return (middle[:, None] + offset).clamp(0, count - 1), weight

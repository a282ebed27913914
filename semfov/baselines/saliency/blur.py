"""Blur and enlargement of images as in OpenCV."""

import torch
from torch import Tensor

from semfov.errors import check, check_shape
from semfov.sensor.constants import constant
from semfov.sensor.lines import Lines, Taps, banded, separable

# Number of pixels that one matrix product computes: larger tiles multiply more zeros, smaller tiles are slower.
_TILE = 24


def _gaussian_kernel(sigma: float) -> Tensor:
    """Compute the weights of a Gaussian, as many as OpenCV takes for floats.

    They are products with lines (`semfov.sensor.lines`); Kornia's blur would take twice as long on a CPU.
    """
    # Imported when first needed: Kornia takes a quarter of a second.
    from kornia.filters import get_gaussian_kernel1d

    taps = round(8 * sigma + 1) | 1  # the next odd number
    return get_gaussian_kernel1d(taps, sigma, dtype=torch.float64)[0]


def gaussian_blur(image: Tensor, sigma: float, *, halve: bool = False) -> Tensor:
    """Blur an image with a Gaussian: `cv2.GaussianBlur` of floats with `BORDER_REPLICATE`.

    Args:
        image: `(B, C, H, W)`.
        sigma: standard deviation in pixels.
        halve: keep every second pixel alone.

    Returns:
        `(B, C, H', W')`.
    """
    check_shape(image, "image", None, None, None, None)
    check(min(image.shape[-2:]) > 0, "image", "at least one pixel", tuple(image.shape))
    check(sigma > 0, "sigma", "a positive number of pixels", sigma)
    step = 2 if halve else 1
    vertical, horizontal = (_blurring(count, sigma, step, image.dtype, image.device) for count in image.shape[-2:])
    return separable(image, vertical, horizontal)


def enlarge(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Enlarge an image `(..., h, w)` to `(height, width)` by cubic interpolation (a = -0.75): `cv2.INTER_CUBIC`."""
    check_shape(image, "image", None, None)
    if tuple(image.shape[-2:]) == tuple(size):
        return image
    vertical = _enlarging(image.shape[-2], size[0], image.dtype, image.device)
    horizontal = _enlarging(image.shape[-1], size[1], image.dtype, image.device)
    return separable(image, vertical, horizontal)


@constant
def _blurring(count: int, sigma: float, step: int, dtype: torch.dtype, device: torch.device) -> Lines:
    """Make the matrix that blurs lines of `count` pixels and keeps one of every `step`; border pixels are repeated."""
    kernel = _gaussian_kernel(sigma)
    length = max(count // step, 1)
    reach = len(kernel) // 2
    middle = torch.arange(length)[:, None] * step
    index = middle + torch.arange(len(kernel)) - reach  # (length, taps)
    taps = Taps(index.clamp(0, count - 1), kernel.expand(length, -1))
    return banded(taps, count, _TILE, _TILE * step, reach, dtype, device)


@constant
def _enlarging(count: int, length: int, dtype: torch.dtype, device: torch.device) -> Lines:
    """Make the matrix of Keys' cubic interpolation (a = -0.75) of pixels as areas; border pixels are repeated.

    Args:
        count: number of input pixels.
        length: number of output pixels.
        dtype: dtype of the matrix.
        device: device of the matrix.

    Returns:
        The matrix.
    """
    place = (torch.arange(length).double() + 0.5) * (count / length) - 0.5
    index = place.floor().long()[:, None] + torch.arange(-1, 3)  # (length, 4)
    distance = (place[:, None] - index).abs()
    a = -0.75
    # Keys' two cubics: up to a distance of one pixel, and from one to two.
    inner = ((a + 2) * distance - (a + 3)) * distance**2 + 1
    outer = a * (((distance - 5) * distance + 8) * distance - 4)
    weight = torch.where(distance <= 1, inner, outer)
    taps = Taps(index.clamp(0, count - 1), weight)
    ratio, rest = divmod(length, count)
    if rest:
        # Tiles are evenly spaced only where the ratio is a whole number: without it all is one tile.
        return banded(taps, count, length, count, 2, dtype, device)
    shift = max(_TILE // ratio, 1)
    return banded(taps, count, shift * ratio, shift, 2, dtype, device)


def rescale(saliency: Tensor, flat: float = 0.0) -> Tensor:
    """Shift and scale maps to [0, 1].

    Args:
        saliency: `(..., H, W)`.
        flat: maps with at most this range become 0.

    Returns:
        `(..., H, W)`.
    """
    least = saliency.amin((-2, -1), keepdim=True)
    span = saliency.amax((-2, -1), keepdim=True) - least
    # Division by infinity sets a flat map to 0, and its gradient too.
    return (saliency - least) / torch.where(span > flat, span, torch.inf)

"""Gaussian and Laplacian pyramids in Kornia's and in OpenCV's convention, for images of any size."""

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check, check_shape, lookup

Convention = Literal["kornia", "opencv"]

# Kornia blurs with [1 4 6 4 1] / 16 and resizes bilinearly. Between even sizes both are one filter:
# halving averages two blurred pixels, doubling blurs pixels at 1/4 and 3/4 between two.
_HALVE = (1 / 32, 5 / 32, 10 / 32, 10 / 32, 5 / 32, 1 / 32)
_DOUBLE_EVEN = (1 / 64, 21 / 64, 35 / 64, 7 / 64)
_DOUBLE_ODD = _DOUBLE_EVEN[::-1]
_OPENCV_HALVE = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


@dataclass(frozen=True)
class Bands:
    """A Laplacian pyramid.

    Attributes:
        details: bands `L_0..L_{K-1}`, `(B, C, h_k, w_k)`, finest first.
        base: the coarsest level `G_K`.
        convention: the pyramid's, which tells where the pixels of a band lie in the image.
    """

    details: tuple[Tensor, ...]
    base: Tensor
    convention: Convention

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the image."""
        height, width = (self.details[0] if self.details else self.base).shape[-2:]
        return height, width


def pyrdown(image: Tensor, convention: Convention = "kornia") -> Tensor:
    """Blur and halve an image.

    - `kornia`: `kornia.geometry.transform.pyrdown`: 5 taps [1 4 6 4 1] / 16, reflected borders, then bilinear
      resizing to half the size, rounded down (to at least 1 pixel).
    - `opencv`: `cv2.pyrDown`: the same taps at every second pixel, half the size rounded up.

    Args:
        image: `(B, C, H, W)`.

    Returns:
        `(B, C, H', W')`.

    >>> pyrdown(torch.rand(1, 3, 48, 65)).shape, pyrdown(torch.rand(1, 3, 48, 65), "opencv").shape
    (torch.Size([1, 3, 24, 32]), torch.Size([1, 3, 24, 33]))
    """
    check_shape(image, "image", None, None, None, None)
    lookup(convention, get_args(Convention), "pyramid convention")
    for axis in (-2, -1):
        if convention == "opencv":
            image = _filter(_extend(image, axis, 2, "reflect"), axis, _OPENCV_HALVE, step=2)
        elif image.shape[axis] % 2 == 0 and image.shape[axis] >= 4:
            image = _filter(_extend(image, axis, 2, "reflect"), axis, _HALVE, step=2)
        else:
            image = _resize(_blur(image, axis), axis, max(image.shape[axis] // 2, 1))
    return image


def pyrup(image: Tensor, size: tuple[int, int], convention: Convention = "kornia") -> Tensor:
    """Enlarge an image to `size` and blur it, the counterpart of `pyrdown`.

    - `kornia`: bilinear resizing, then the 5 taps with reflected borders: `kornia.geometry.transform.pyrup` where
      `size` is twice the image's.
    - `opencv`: `cv2.pyrUp` with `dstsize=size`.

    Args:
        image: `(B, C, H, W)`.
        size: `(height, width)` of the result; with `opencv` 2n or 2n - 1 for n pixels.

    Returns:
        `(B, C, *size)`.
    """
    check_shape(image, "image", None, None, None, None)
    lookup(convention, get_args(Convention), "pyramid convention")
    for axis, length in ((-1, size[1]), (-2, size[0])):
        count = image.shape[axis]
        if convention == "opencv":
            check(
                0 <= 2 * count - length <= 1, "size", f"{2 * count} or {2 * count - 1} for {count} pixels", length
            )
            image = _double_opencv(image, axis).narrow(axis, 0, length)
        elif length == 2 * count and count >= 4:
            image = _double(image, axis)
        else:
            image = _blur(_resize(image, axis, length), axis)
    return image


def laplacian_pyramid(image: Tensor, levels: int, convention: Convention = "kornia") -> Bands:
    r"""Split an image into bands of decreasing frequency (Burt and Adelson, 1983).

    .. math:: G_0 = I, \quad G_{k+1} = \mathrm{reduce}(G_k), \quad L_k = G_k - \mathrm{expand}(G_{k+1})

    Args:
        image: `(B, C, H, W)`.
        levels: number of bands, K; 0 leaves the image as the base.

    >>> bands = laplacian_pyramid(torch.rand(1, 3, 64, 48), 3)
    >>> [tuple(band.shape[-2:]) for band in bands.details], tuple(bands.base.shape[-2:])
    ([(64, 48), (32, 24), (16, 12)], (8, 6))
    """
    check(levels >= 0, "levels", "0 or more", levels)
    check_shape(image, "image", None, None, None, None)
    check(min(image.shape[-2:]) > 0, "image", "at least one pixel", tuple(image.shape))
    details = []
    for _ in range(levels):
        smaller = pyrdown(image, convention)
        details.append(image - pyrup(smaller, (image.shape[-2], image.shape[-1]), convention))
        image = smaller
    return Bands(tuple(details), image, convention)


def _filter(image: Tensor, axis: int, taps: tuple[float, ...], step: int = 1) -> Tensor:
    """Correlate with `taps` along `axis`, at every `step`-th place where all of them fit."""
    places = image.shape[axis] - len(taps) + 1
    # Sums of shifted slices run several times faster on a CPU than convolutions of one channel.
    result = _part(image, axis, 0, places, step) * taps[0]
    for i, tap in enumerate(taps[1:], start=1):
        result = _add(result, _part(image, axis, i, places + i, step), tap)
    return result


def _part(image: Tensor, axis: int, start: int, stop: int, step: int = 1) -> Tensor:
    piece = slice(start, stop, step)
    return image[..., piece, :] if axis == -2 else image[..., piece]


def _add(total: Tensor, image: Tensor, factor: float) -> Tensor:
    """`total + factor * image`, in the memory of `total` (a temporary of ours) where no gradient needs it."""
    if torch.is_grad_enabled():
        return torch.add(total, image, alpha=factor)
    return total.add_(image, alpha=factor)


def _extend(image: Tensor, axis: int, width: int, mode: str) -> Tensor:
    """Continue an image beyond its borders along one axis; a single pixel is repeated."""
    pad = (width, width, 0, 0) if axis == -1 else (0, 0, width, width)
    if mode == "reflect" and image.shape[axis] <= width:
        # Reflection of a short line bounces to and fro, as `BORDER_REFLECT_101` of OpenCV does.
        count = image.shape[axis]
        period = max(2 * count - 2, 1)
        place = torch.arange(-width, count + width, device=image.device) % period
        return image.index_select(axis, torch.minimum(place, period - place) if count > 1 else place)
    return F.pad(image, pad, mode=mode)


def _blur(image: Tensor, axis: int) -> Tensor:
    return _filter(_extend(image, axis, 2, "reflect"), axis, _OPENCV_HALVE)


def _resize(image: Tensor, axis: int, length: int) -> Tensor:
    """Bilinear resizing along one axis, without antialiasing."""
    size = (length, image.shape[-1]) if axis == -2 else (image.shape[-2], length)
    return F.interpolate(image, size, mode="bilinear", align_corners=False)


def _interleave(even: Tensor, odd: Tensor, axis: int) -> Tensor:
    return torch.stack([even, odd], axis).flatten(axis - 1, axis)


def _double(image: Tensor, axis: int) -> Tensor:
    """Kornia's enlargement to twice the size: two filters of four taps, for even and for odd pixels."""
    count = image.shape[axis]
    first, second = _part(image, axis, 0, 1), _part(image, axis, 1, 2)
    last, previous = _part(image, axis, count - 1, count), _part(image, axis, count - 2, count - 1)
    # Beyond the borders, what makes the inner filters give the result of clamped resizing and reflected blur.
    even = torch.cat([7 * second - 6 * first, first, image, (6 * last + previous) / 7], axis)
    odd = torch.cat([(6 * first + second) / 7, image, last, 7 * previous - 6 * last], axis)
    return _interleave(_filter(even, axis, _DOUBLE_EVEN), _filter(odd, axis, _DOUBLE_ODD), axis)


def _double_opencv(image: Tensor, axis: int) -> Tensor:
    """OpenCV's enlargement: pixels with zeros between them, blurred and doubled."""
    count = image.shape[axis]
    first = _part(image, axis, min(1, count - 1), min(1, count - 1) + 1)
    last = _part(image, axis, count - 1, count)
    extended = torch.cat([first, image, last], axis)
    even = _filter(extended, axis, (1 / 8, 6 / 8, 1 / 8))
    odd = _filter(_part(extended, axis, 1, count + 2), axis, (1 / 2, 1 / 2))
    return _interleave(even, odd, axis)

"""Gaussian and Laplacian pyramids in Kornia's and in OpenCV's convention, for images of any size."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check, check_shape, lookup

Convention = Literal["kornia", "opencv"]

# Kornia blurs with [1 4 6 4 1] / 16 and resizes bilinearly. Between even sizes both are one filter:
# halving averages two blurred pixels, doubling blurs pixels at 1/4 and 3/4 between two.
_BLUR = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
_HALVE = (1 / 32, 5 / 32, 10 / 32, 10 / 32, 5 / 32, 1 / 32)
_DOUBLE_EVEN = (1 / 64, 21 / 64, 35 / 64, 7 / 64)
_DOUBLE_ODD = _DOUBLE_EVEN[::-1]

_SMALL = 128


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

    def places(self, k: int, axis: int) -> Tensor:
        """Where in the image the pixels of band k lie, along y (axis -2) or x (-1): `(n,)`, in image pixels."""
        band = self.details[k]
        count, length = band.shape[axis], self.size[axis]
        place = torch.arange(count, dtype=band.dtype, device=band.device)
        return place * 2**k if self.convention == "opencv" else (place + 0.5) * (length / count) - 0.5


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
    height, width = image.shape[-2:]
    if max(height, width) <= _SMALL and not torch.compiler.is_compiling():
        down, across = (_matrix(n, None, convention, image.dtype, image.device) for n in (height, width))
        return down @ image @ across.mT
    for axis in (-2, -1):
        image = _reduce(image, axis, convention)
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
    if convention == "opencv":
        for count, length in zip(image.shape[-2:], size, strict=True):
            check(0 <= 2 * count - length <= 1, "size", f"{2 * count} or {2 * count - 1} for {count} pixels", length)
    if max(size) <= _SMALL and not torch.compiler.is_compiling():
        lengths = zip(image.shape[-2:], size, strict=True)
        down, across = (_matrix(n, length, convention, image.dtype, image.device) for n, length in lengths)
        return down @ image @ across.mT
    return _expand(_expand(image, -1, size[1], convention), -2, size[0], convention)


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


@lru_cache(maxsize=256)
def _matrix(count: int, length: int | None, convention: Convention, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix that reduces a line of `count` pixels, or expands it to `length`.

    Levels of a few thousand pixels cost less as two matrix products than as many short sums.
    """
    with torch.no_grad():
        lines = torch.eye(count, dtype=torch.float64)[None, None]
        lines = _reduce(lines, -2, convention) if length is None else _expand(lines, -2, length, convention)
        return lines[0, 0].to(dtype=dtype, device=device)


def _reduce(image: Tensor, axis: int, convention: Convention) -> Tensor:
    """`pyrdown` along one axis."""
    count = image.shape[axis]
    if convention == "opencv":
        return _halve(image, axis, _BLUR)
    if count % 2 == 0 and count >= 4:
        return _halve(image, axis, _HALVE)
    return _resize(_blur(image, axis), axis, max(count // 2, 1))


def _expand(image: Tensor, axis: int, length: int, convention: Convention) -> Tensor:
    """`pyrup` along one axis."""
    count = image.shape[axis]
    if convention == "opencv":
        return _double_opencv(image, axis).narrow(axis, 0, length)
    if length == 2 * count and count >= 4:
        return _double(image, axis)
    return _blur(_resize(image, axis, length), axis)


def _filter(pieces: list[Tensor], taps: tuple[float, ...]) -> Tensor:
    """Weighted sum of shifted views; on a CPU several times faster than a convolution of one channel."""
    result = pieces[0] * taps[0]
    for piece, tap in zip(pieces[1:], taps[1:], strict=True):
        # The sum is ours to write to, unless a gradient is to flow back through it.
        result = torch.add(result, piece, alpha=tap) if torch.is_grad_enabled() else result.add_(piece, alpha=tap)
    return result


def _part(image: Tensor, axis: int, start: int, stop: int) -> Tensor:
    return image[..., start:stop, :] if axis == -2 else image[..., start:stop]


def _reflect(image: Tensor, axis: int) -> Tensor:
    """Continue an image by two pixels beyond its borders along one axis, mirrored at the outermost pixels."""
    count = image.shape[axis]
    if count > 2:
        return F.pad(image, (2, 2, 0, 0) if axis == -1 else (0, 0, 2, 2), mode="reflect")
    # A line of one or two pixels is mirrored to and fro, as `BORDER_REFLECT_101` of OpenCV does.
    place = torch.arange(-2, count + 2, device=image.device) % max(2 * count - 2, 1)
    return image.index_select(axis, place)


def _blur(image: Tensor, axis: int) -> Tensor:
    extended, count = _reflect(image, axis), image.shape[axis]
    return _filter([_part(extended, axis, i, i + count) for i in range(5)], _BLUR)


def _resize(image: Tensor, axis: int, length: int) -> Tensor:
    """Bilinear resizing along one axis, without antialiasing."""
    size = (length, image.shape[-1]) if axis == -2 else (image.shape[-2], length)
    return F.interpolate(image, size, mode="bilinear", align_corners=False)


def _halve(image: Tensor, axis: int, taps: tuple[float, ...]) -> Tensor:
    """Correlate with 5 or 6 taps at every second place, from two pixels before the border on."""
    extended = _reflect(image, axis)
    count = (extended.shape[axis] - len(taps)) // 2 + 1
    even, odd = _phases(extended, axis)
    pieces = [_part(odd if i % 2 else even, axis, i // 2, i // 2 + count) for i in range(len(taps))]
    return _filter(pieces, taps)


def _phases(image: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Pixels with even and with odd numbers along one axis, laid out for sums of shifted views."""
    if axis == -2:
        return image[..., 0::2, :], image[..., 1::2, :]
    return image[..., 0::2].contiguous(), image[..., 1::2].contiguous()


def _interleave(even: Tensor, odd: Tensor, axis: int) -> Tensor:
    """Even and odd pixels in turn."""
    if axis == -1 and even.dtype in (torch.float32, torch.float64):
        # Pairs of neighbours are laid out as complex numbers are, and those are written in one pass.
        return torch.view_as_real(torch.complex(even, odd)).flatten(-2)
    return torch.stack([even, odd], axis).flatten(axis - 1, axis)


def _double(image: Tensor, axis: int) -> Tensor:
    """Kornia's enlargement to twice the size: two filters of four taps, for even and for odd pixels."""
    count = image.shape[axis]
    first, second = _part(image, axis, 0, 1), _part(image, axis, 1, 2)
    last, previous = _part(image, axis, count - 1, count), _part(image, axis, count - 2, count - 1)
    # Continued like this, the inner filters give what clamped resizing and reflected blur give at the borders,
    # but for one pixel of each phase, which is put right afterwards.
    extended = torch.cat([7 * second - 6 * first, first, image, last, 7 * previous - 6 * last], axis)
    pieces = [_part(extended, axis, i, i + count) for i in range(5)]
    even, odd = _filter(pieces[:4], _DOUBLE_EVEN), _filter(pieces[1:], _DOUBLE_ODD)
    _part(even, axis, count - 1, count).add_(previous - last, alpha=1 / 64)
    _part(odd, axis, 0, 1).add_(second - first, alpha=1 / 64)
    return _interleave(even, odd, axis)


def _double_opencv(image: Tensor, axis: int) -> Tensor:
    """OpenCV's enlargement: pixels with zeros between them, blurred and doubled."""
    count = image.shape[axis]
    second = _part(image, axis, min(1, count - 1), min(1, count - 1) + 1)
    extended = torch.cat([second, image, _part(image, axis, count - 1, count)], axis)
    pieces = [_part(extended, axis, i, i + count) for i in range(3)]
    return _interleave(_filter(pieces, (1 / 8, 6 / 8, 1 / 8)), _filter(pieces[1:], (1 / 2, 1 / 2)), axis)

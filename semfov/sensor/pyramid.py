"""Gaussian and Laplacian pyramids in Kornia's and in OpenCV's convention, for images of any size."""

from dataclasses import dataclass
from types import ModuleType
from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.errors import check, check_shape, lookup, values_known
from semfov.sensor.lines import Lines, Taps, banded, constant, separable

Convention = Literal["kornia", "opencv"]

# Devices where `python -m benchmarks.pyramid` finds the matrices of `lines` ahead of Kornia, with gradients too.
_AHEAD = frozenset({"cpu"})
_BLUR = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
# Pixels read that lie under a tile of those made: fewer make the products slow, more multiply more zeros.
_SHIFT = 8


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
        return places(band.shape[axis], self.size[axis], k, self.convention).to(band)


def places(count: int, length: int, k: int, convention: Convention) -> Tensor:
    """Where on a line of `length` pixels those of its `count` in band k lie: `(count,)`, double precision."""
    place = torch.arange(count, dtype=torch.float64)
    return place * 2**k if convention == "opencv" else (place + 0.5) * (length / count) - 0.5


def pyrdown(image: Tensor, convention: Convention = "kornia") -> Tensor:
    """Blur and halve an image.

    - `kornia`: `kornia.geometry.transform.pyrdown`: 5 taps [1 4 6 4 1] / 16, reflected borders, then bilinear
      resizing to half the size, rounded down (to at least 1 pixel).
    - `opencv`: `cv2.pyrDown`: the same taps at every second pixel, half the size rounded up.

    On accelerators Kornia computes its own; on a CPU products of matrices are faster (`benchmarks.pyramid`).

    Args:
        image: `(B, C, H, W)`.

    Returns:
        `(B, C, H', W')`.

    >>> pyrdown(torch.rand(1, 3, 48, 65)).shape, pyrdown(torch.rand(1, 3, 48, 65), "opencv").shape
    (torch.Size([1, 3, 24, 32]), torch.Size([1, 3, 24, 33]))
    """
    _check_image(image)
    lookup(convention, get_args(Convention), "pyramid convention")
    return reduce(image, convention)


def reduce(image: Tensor, convention: Convention) -> Tensor:
    """`pyrdown` of what was checked before."""
    if _runs_in_kornia(image, convention):
        return _kornia().pyrdown(image.contiguous())
    down, across = (_reducing(count, convention, image.dtype, image.device) for count in image.shape[-2:])
    return separable(image, down, across)


def pyrup(image: Tensor, size: tuple[int, int], convention: Convention = "kornia") -> Tensor:
    """Enlarge an image to `size` and blur it, the counterpart of `pyrdown`.

    - `kornia`: bilinear resizing, then the 5 taps with reflected borders: `kornia.geometry.transform.pyrup` where
      `size` is twice the image's.
    - `opencv`: `cv2.pyrUp` with `dstsize=size`.

    On accelerators Kornia computes what it defines; on a CPU products of matrices are faster (`benchmarks.pyramid`).

    Args:
        image: `(B, C, H, W)`.
        size: `(height, width)` of the result; with `opencv` 2n or 2n - 1 for n pixels.

    Returns:
        `(B, C, *size)`.
    """
    _check_image(image)
    lookup(convention, get_args(Convention), "pyramid convention")
    if convention == "opencv":
        for count, length in zip(image.shape[-2:], size, strict=True):
            check(0 <= 2 * count - length <= 1, "size", f"{2 * count} or {2 * count - 1} for {count} pixels", length)
    return expand(image, size, convention)


def expand(image: Tensor, size: tuple[int, int], convention: Convention) -> Tensor:
    """`pyrup` of what was checked before."""
    if _runs_in_kornia(image, convention, size):
        return _kornia().pyrup(image.contiguous())
    lengths = zip(image.shape[-2:], size, strict=True)
    down, across = (_expanding(count, length, convention, image.dtype, image.device) for count, length in lengths)
    return separable(image, down, across)


def gaussian_pyramid(image: Tensor, levels: int, convention: Convention = "kornia") -> tuple[Tensor, ...]:
    """An image and its ever coarser levels, `G_0..G_K`, each blurred and halved from the one before (`pyrdown`).

    Args:
        image: `(B, C, H, W)`.
        levels: K, how often it is halved.

    >>> [tuple(level.shape[-2:]) for level in gaussian_pyramid(torch.rand(1, 3, 64, 48), 2)]
    [(64, 48), (32, 24), (16, 12)]
    """
    check(levels >= 0, "levels", "0 or more", levels)
    _check_image(image)
    check(min(image.shape[-2:]) > 0, "image", "at least one pixel", tuple(image.shape))
    lookup(convention, get_args(Convention), "pyramid convention")
    found = [image]
    for _ in range(levels):
        found.append(reduce(found[-1], convention))
    return tuple(found)


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
    _check_image(image)
    check(min(image.shape[-2:]) > 0, "image", "at least one pixel", tuple(image.shape))
    lookup(convention, get_args(Convention), "pyramid convention")
    details = []
    for _ in range(levels):
        smaller = reduce(image, convention)
        expanded = expand(smaller, (image.shape[-2], image.shape[-1]), convention)
        # Fresh memory costs more than the difference itself, so it is taken only where a gradient or a graph needs it.
        fresh = expanded.requires_grad or not values_known(image, expanded)
        details.append(image - expanded if fresh else torch.sub(image, expanded, out=expanded))
        image = smaller
    return Bands(tuple(details), image, convention)


def _runs_in_kornia(image: Tensor, convention: Convention, size: tuple[int, int] | None = None) -> bool:
    """Whether Kornia makes the next level of `image`, or enlarges it to `size`, rather than the matrices of `lines`.

    It does in its own convention, on devices where `benchmarks.pyramid` does not show ours ahead, with gradients and
    without. What it does not define stays ours: levels of fewer than three pixels along an axis, and enlargement to
    other than twice the size. So does what it would make less exact or less repeatable than asked for.
    """
    if convention != "kornia" or image.device.type in _AHEAD:
        return False
    channels, height, width = image.shape[-3:]
    # Of a single channel the convolution is no depthwise one, which CUDA rounds to ten bits unless told otherwise; and
    # the gradient of reflected borders has no deterministic algorithm there.
    if channels == 1 or torch.are_deterministic_algorithms_enabled():
        return False
    return min(height, width) > 2 if size is None else min(height, width) > 1 and tuple(size) == (2 * height, 2 * width)


def _kornia() -> ModuleType:
    """Kornia's geometry, imported when first needed: it takes a quarter of a second."""
    import kornia.geometry.transform

    return kornia.geometry.transform


def _check_image(image: Tensor) -> None:
    """Raise `InputError` unless `image` is `(B, C, H, W)` of floating-point numbers."""
    check_shape(image, "image", None, None, None, None)
    check(image.is_floating_point(), "image", "floating-point numbers", image.dtype)


@constant
def _reducing(count: int, convention: Convention, dtype: torch.dtype, device: torch.device) -> Lines:
    """`pyrdown` of lines of `count` pixels."""
    if convention == "opencv":
        taps = _blur(torch.arange(0, count, 2), count)
    else:
        taps = _compose(_resize(count, max(count // 2, 1), dtype), _blur(torch.arange(count), count))
    # Halves of an odd number drift by a pixel from one end of the line to the other.
    return banded(taps, count, _SHIFT // 2, _SHIFT, 2 + count % 2, dtype, device)


@constant
def _expanding(count: int, length: int, convention: Convention, dtype: torch.dtype, device: torch.device) -> Lines:
    """`pyrup` of lines of `count` pixels to `length`."""
    if convention == "opencv":
        # The blur of lines with zeros in between, mirrored before their first pixel and continued after their last.
        place = torch.arange(length)[:, None]
        half = place.div(2, rounding_mode="floor")
        index = torch.where(place % 2 == 0, half + torch.tensor([-1, 0, 1]), half + torch.tensor([0, 1, 1]))
        weight = torch.where(place % 2 == 0, torch.tensor([1 / 8, 6 / 8, 1 / 8]), torch.tensor([1 / 2, 1 / 2, 0]))
        taps = Taps(torch.where(index < 0, min(1, count - 1), index.clamp(max=count - 1)), weight.double())
    else:
        taps = _compose(_blur(torch.arange(length), length), _resize(count, length, dtype))
    drift = abs(length - 2 * count)
    return banded(taps, count, 2 * _SHIFT, _SHIFT if drift <= 1 else count, 2 + drift, dtype, device)


def _blur(place: Tensor, count: int) -> Taps:
    """Five taps at some pixels of a line of `count`, which is mirrored at its outermost pixels."""
    # A line of one or two pixels is mirrored to and fro, as `BORDER_REFLECT_101` of OpenCV does.
    index = (place[:, None] + torch.arange(-2, 3)).abs() % max(2 * count - 2, 1)
    return Taps(
        torch.minimum(index, 2 * count - 2 - index), torch.tensor(_BLUR, dtype=torch.float64).expand(len(place), 5)
    )


def _resize(count: int, length: int, dtype: torch.dtype) -> Taps:
    """Bilinear interpolation of a line of `count` pixels at `length`, pixels as areas, without antialiasing."""
    # Places are rounded as those of `torch.nn.functional.interpolate` are.
    place = torch.arange(length, dtype=torch.promote_types(dtype, torch.float32)) + 0.5
    place = (place * (torch.tensor(count).to(place) / length) - 0.5).clamp(0, count - 1).double()
    before = place.floor()
    index = before.long()[:, None] + torch.arange(2)
    return Taps(index.clamp(max=count - 1), torch.stack([1 - place + before, place - before], -1))


def _compose(outer: Taps, inner: Taps) -> Taps:
    """Taps of `outer` on what `inner` makes."""
    index, weight = inner.index[outer.index], outer.weight[..., None] * inner.weight[outer.index]
    return Taps(index.flatten(1), weight.flatten(1))

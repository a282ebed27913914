"""Gaussian and Laplacian pyramids in Kornia's and in OpenCV's convention, for images of any size."""

from dataclasses import dataclass, replace
from typing import Literal, Self, get_args

import torch
from torch import Tensor

from semfov.errors import check, check_shape, lookup, values_known
from semfov.precision import without_autocast
from semfov.sensor.constants import constant
from semfov.sensor.lines import Lines, Taps, banded, separable
from semfov.threads import one_thread_if_small

Convention = Literal["kornia", "opencv"]

# Devices where `python -m benchmarks.pyramid` measures the matrices of `lines` as faster than Kornia, also with
# gradients.
_AHEAD = frozenset({"cpu"})
_BLUR = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
# Input pixels that one tile covers, down and across: with fewer the products are slow, with more they multiply more
# zeros. Across they are slow sooner, and tiles that enlarge have four times as many output pixels.
_REDUCED = (8, 32)
_EXPANDED = (8, 16)


@dataclass(frozen=True)
class Bands:
    """A Laplacian pyramid: bands `L_0..L_{K-1}`, `(B, C, h_k, w_k)`, finest first, and the coarsest level `G_K`."""

    details: tuple[Tensor, ...]
    base: Tensor
    convention: Convention

    @property
    def shape(self) -> tuple[int, int]:
        """`(height, width)` of the image."""
        height, width = (self.details[0] if self.details else self.base).shape[-2:]
        return height, width

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """`(height, width)` of the bands, finest first."""
        return tuple((band.shape[-2], band.shape[-1]) for band in self.details)

    def __getitem__(self, images: slice) -> Self:
        """Select the bands of some of the images."""
        return replace(self, details=tuple(band[images] for band in self.details), base=self.base[images])

    def widened(self) -> Self:
        """Convert bands of half precision to float32 on a CPU (`widened`)."""
        return replace(self, details=tuple(widened(band) for band in self.details), base=widened(self.base))


def pyrdown(image: Tensor, convention: Convention = "kornia") -> Tensor:
    """Blur an image and halve its size.

    - `kornia`: `kornia.geometry.transform.pyrdown`. It blurs with the 5 taps [1 4 6 4 1] / 16 and reflected borders,
      then resizes bilinearly to half the size, rounded down (to at least 1 pixel).
    - `opencv`: `cv2.pyrDown`. It takes the same blur at every second pixel; half the size is rounded up.

    On accelerators Kornia itself computes its convention. On a CPU matrix products compute the same numbers faster
    (`benchmarks.pyramid`).

    Args:
        image: `(B, C, H, W)`.
        convention: `kornia` or `opencv`.

    Returns:
        The smaller image, `(B, C, H', W')`.

    >>> pyrdown(torch.rand(1, 3, 48, 65)).shape, pyrdown(torch.rand(1, 3, 48, 65), "opencv").shape
    (torch.Size([1, 3, 24, 32]), torch.Size([1, 3, 24, 33]))
    """
    _check(image, convention)
    return reduce(widened(image), convention).to(image.dtype)


def reduce(image: Tensor, convention: Convention) -> Tensor:
    """Compute `pyrdown` without its checks.

    This is the one place where a level is reduced, by Kornia or by the matrices of `semfov.sensor.lines`.

    Args:
        image: `(B, C, H, W)`, of half precision only where the device computes with it (`widened`).
        convention: `kornia` or `opencv`.

    Returns:
        `(B, C, H', W')`.
    """
    if _runs_in_kornia(image, convention):
        # Imported when first needed: Kornia takes a quarter of a second.
        from kornia.geometry import transform

        with without_autocast(image):
            return transform.pyrdown(image.contiguous())
    height, width = image.shape[-2:]
    down, across = _reducing(height, width, convention, image.dtype, image.device)
    with without_autocast(image):
        return separable(image, down, across)


def pyrup(image: Tensor, shape: tuple[int, int], convention: Convention = "kornia") -> Tensor:
    """Enlarge an image and blur it, the counterpart of `pyrdown`.

    - `kornia`: bilinear resizing, then a blur with the 5 taps and reflected borders. Where `shape` is twice the image's
      size, this is `kornia.geometry.transform.pyrup`.
    - `opencv`: `cv2.pyrUp` with `dstsize=shape[::-1]`.

    On accelerators Kornia itself computes the sizes that it defines. On a CPU matrix products compute the same numbers
    faster (`benchmarks.pyramid`).

    Args:
        image: `(B, C, H, W)`.
        shape: `(height, width)` of the result; with `opencv`, 2n or 2n - 1 for a side of n pixels.
        convention: `kornia` or `opencv`.

    Returns:
        The larger image, `(B, C, *shape)`.

    >>> pyrup(torch.rand(1, 3, 24, 32), (48, 65)).shape
    torch.Size([1, 3, 48, 65])
    """
    _check(image, convention)
    if convention == "opencv":
        for count, length in zip(image.shape[-2:], shape, strict=True):
            double = 2 * count
            check(length in (double, double - 1), "shape", f"{double} or {double - 1} for {count} pixels", length)
    return expand(widened(image), shape, convention).to(image.dtype)


def expand(image: Tensor, size: tuple[int, int], convention: Convention) -> Tensor:
    """Compute `pyrup` without its checks, the one place where a level is enlarged.

    Args:
        image: `(B, C, H, W)`, of half precision only where the device computes with it (`widened`).
        size: `(height, width)` of the result.
        convention: `kornia` or `opencv`.

    Returns:
        `(B, C, *size)`.
    """
    if _runs_in_kornia(image, convention, size):
        from kornia.geometry import transform

        with without_autocast(image):
            return transform.pyrup(image.contiguous())
    height, width = size
    before = (image.shape[-2], image.shape[-1])
    columns, rows = expanding(before, (height, width), convention, image.dtype, image.device)
    with without_autocast(image):
        return separable(image, columns, rows)


def gaussian_pyramid(image: Tensor, levels: int, convention: Convention = "kornia") -> tuple[Tensor, ...]:
    """Compute a Gaussian pyramid: an image and its coarser levels, each by `pyrdown` of the level before.

    Args:
        image: `(B, C, H, W)`.
        levels: K, how often the image is halved.
        convention: `kornia` or `opencv` (see `pyrdown`).

    Returns:
        Levels `G_0..G_K`, finest first; `G_0` is the image.

    >>> [tuple(level.shape[-2:]) for level in gaussian_pyramid(torch.rand(1, 3, 64, 48), 2)]
    [(64, 48), (32, 24), (16, 12)]
    """
    _check(image, convention)
    _check_levels(image, levels)
    pyramid = [widened(image)]
    for _ in range(levels):
        pyramid.append(reduce(pyramid[-1], convention))
    return tuple(level.to(image.dtype) for level in pyramid)


@one_thread_if_small
def laplacian_pyramid(image: Tensor, levels: int, convention: Convention = "kornia") -> Bands:
    r"""Split an image into bands of decreasing frequency (Burt and Adelson, 1983).

    .. math:: G_0 = I, \quad G_{k+1} = \mathrm{reduce}(G_k), \quad L_k = G_k - \mathrm{expand}(G_{k+1})

    Args:
        image: `(B, C, H, W)`.
        levels: number of bands, K; with 0 the base is the image.
        convention: `kornia` or `opencv` (see `pyrdown` and `pyrup`).

    Returns:
        The bands `L_0..L_{K-1}` and the base `G_K`.

    >>> bands = laplacian_pyramid(torch.rand(1, 3, 64, 48), 3)
    >>> [tuple(band.shape[-2:]) for band in bands.details], tuple(bands.base.shape[-2:])
    ([(64, 48), (32, 24), (16, 12)], (8, 6))
    """
    _check(image, convention)
    _check_levels(image, levels)
    bands = []
    level = widened(image)
    for _ in range(levels):
        coarser = reduce(level, convention)
        expanded = expand(coarser, (level.shape[-2], level.shape[-1]), convention)
        bands.append(_subtract(level, expanded))
        level = coarser
    return Bands(tuple(band.to(image.dtype) for band in bands), level.to(image.dtype), convention)


def _subtract(level: Tensor, expanded: Tensor) -> Tensor:
    """Compute `level - expanded`, which is written over: allocating memory costs more than the subtraction."""
    # A gradient or a graph needs the tensor as it is.
    if expanded.requires_grad or not values_known(expanded):
        return level - expanded
    return torch.sub(level, expanded, out=expanded)


def widened(image: Tensor) -> Tensor:
    """Convert an image of half precision to float32 on a CPU, which computes with it ten times faster."""
    is_slow = image.dtype in (torch.float16, torch.bfloat16) and image.device.type == "cpu"
    return image.float() if is_slow else image


def _runs_in_kornia(image: Tensor, convention: Convention, size: tuple[int, int] | None = None) -> bool:
    """Tell whether Kornia computes the next level of `image`, or enlarges it to `size`, instead of our matrices."""
    # Kornia computes its own convention on devices where `benchmarks.pyramid` does not measure ours as faster. Ours
    # computes what Kornia does not define (fewer than three pixels along an axis, other sizes than twice the image's),
    # and where Kornia would be less exact or not deterministic.
    if convention != "kornia" or image.device.type in _AHEAD:
        return False
    channels, height, width = image.shape[-3:]
    # With a single channel the convolution is not a depthwise one, and CUDA rounds such convolutions to ten bits by
    # default. The gradient of reflected borders has no deterministic algorithm on CUDA.
    if channels == 1 or torch.are_deterministic_algorithms_enabled():
        return False
    if size is None:
        return min(height, width) > 2
    return min(height, width) > 1 and tuple(size) == (2 * height, 2 * width)


def _check(image: Tensor, convention: Convention) -> None:
    """Raise `InputError` unless `image` is `(B, C, H, W)` of floats, and the convention is known."""
    check_shape(image, "image", None, None, None, None)
    check(image.is_floating_point(), "image", "floating-point numbers", image.dtype)
    lookup(convention, get_args(Convention), "pyramid convention")


def _check_levels(image: Tensor, levels: int) -> None:
    """Raise `InputError` unless a pyramid of so many levels can be made of `image`."""
    check(levels >= 0, "levels", "0 or more", levels)
    check(min(image.shape[-2:]) > 0, "image", "at least one pixel", tuple(image.shape))


@constant
def _reducing(
    height: int, width: int, convention: Convention, dtype: torch.dtype, device: torch.device
) -> tuple[Lines, Lines]:
    """Make the matrices of `pyrdown` for the columns and the rows of an image."""
    lines = []
    for count, shift in zip((height, width), _REDUCED, strict=True):
        if convention == "opencv":
            taps = _blur(torch.arange(0, count, 2), count)
        else:
            blur = _blur(torch.arange(count), count)
            taps = _compose(_resize(count, max(count // 2, 1), dtype), blur)
        # Halving an odd number of pixels shifts positions by one pixel from one end of the line to the other.
        lines.append(banded(taps, count, shift // 2, shift, 2 + count % 2, dtype, device))
    return lines[0], lines[1]


@constant
def expanding(
    before: tuple[int, int],
    after: tuple[int, int],
    convention: Convention,
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[Lines, Lines]:
    """Make the matrices of `pyrup` for the columns and the rows of an image.

    Args:
        before: `(height, width)` of the image.
        after: `(height, width)` of the result.
        convention: `kornia` or `opencv`.
        dtype: dtype of the matrices.
        device: device of the matrices.

    Returns:
        The matrix of the columns, and that of the rows.
    """
    lines = []
    for count, length, shift in zip(before, after, _EXPANDED, strict=True):
        if convention == "opencv":
            taps = _stuff_and_blur(count, length)
        else:
            taps = _compose(_blur(torch.arange(length), length), _resize(count, length, dtype))
        drift = abs(length - 2 * count)
        # A size that is far from twice the other has taps that advance unevenly, and no tiles.
        advance = shift if drift <= 1 else count
        lines.append(banded(taps, count, 2 * shift, advance, 2 + drift, dtype, device))
    return lines[0], lines[1]


def _stuff_and_blur(count: int, length: int) -> Taps:
    """Make the taps of OpenCV's enlargement: the blur of a line with zeros in between.

    The line is mirrored before its first pixel, and continued after its last one.
    """
    place = torch.arange(length)[:, None]
    half = place.div(2, rounding_mode="floor")
    # Between the zeros, a pixel at an even place sees itself and two neighbours, one at an odd place its neighbours.
    is_even = place % 2 == 0
    index_at_even = half + torch.tensor([-1, 0, 1])
    index_at_odd = half + torch.tensor([0, 1, 1])
    weight_at_even = torch.tensor([1 / 8, 6 / 8, 1 / 8])
    weight_at_odd = torch.tensor([1 / 2, 1 / 2, 0])
    index = torch.where(is_even, index_at_even, index_at_odd)
    weight = torch.where(is_even, weight_at_even, weight_at_odd)
    mirrored = torch.where(index < 0, min(1, count - 1), index.clamp(max=count - 1))
    return Taps(mirrored, weight.double())


def _blur(place: Tensor, count: int) -> Taps:
    """Make the five taps of the blur at some pixels of a line of `count` pixels, mirrored at its outermost pixels."""
    # A line of one or two pixels is mirrored repeatedly, as `BORDER_REFLECT_101` of OpenCV does: a mirrored line
    # repeats itself after a way to its last pixel and back.
    period = 2 * count - 2
    index = (place[:, None] + torch.arange(-2, 3)).abs() % max(period, 1)
    weight = torch.tensor(_BLUR, dtype=torch.float64).expand(len(place), 5)
    return Taps(torch.minimum(index, period - index), weight)


def _resize(count: int, length: int, dtype: torch.dtype) -> Taps:
    """Make the taps of linear interpolation from `count` pixels to `length`, as areas, without antialiasing."""
    # Positions are rounded in the same way as in `torch.nn.functional.interpolate`.
    centre = torch.arange(length, dtype=torch.promote_types(dtype, torch.float32)) + 0.5
    ratio = torch.tensor(count).to(centre) / length
    place = (centre * ratio - 0.5).clamp(0, count - 1).double()
    before = place.floor()
    index = before.long()[:, None] + torch.arange(2)  # (length, 2), the pixels on both sides
    weight = torch.stack([1 - place + before, place - before], -1)
    return Taps(index.clamp(max=count - 1), weight)


def _compose(outer: Taps, inner: Taps) -> Taps:
    """Make the taps of a filter `outer` of the result of a filter `inner`."""
    weight = outer.weight[..., None] * inner.weight[outer.index]  # (pixels, outer taps, inner taps)
    return Taps(inner.index[outer.index].flatten(1), weight.flatten(1))

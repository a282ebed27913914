"""Gaussian and Laplacian pyramids in Kornia's and in OpenCV's convention, for images of any size."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, wraps
from typing import Any, Literal, TypeVar, TypeVarTuple, get_args

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check, check_shape, lookup, values_known

Convention = Literal["kornia", "opencv"]

_BLUR = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
# Up to this many pixels lines are filtered by one dense matrix, beyond it by one for every block of `_BLOCK`.
_SMALL = 160
_BLOCK = 8
_REACH = 2

Constant = TypeVar("Constant")
Settings = TypeVarTuple("Settings")


def constant(function: Callable[[*Settings], Constant]) -> Callable[[*Settings], Constant]:
    """Remember the tensors that a function makes of sizes and settings alone; a compiled graph makes its own."""

    @lru_cache(maxsize=256)
    def remember(*settings: Any) -> Any:
        # What is made during inference must serve a later gradient too.
        with torch.inference_mode(False), torch.no_grad():
            return function(*settings)

    @wraps(function)
    def call(*settings: *Settings) -> Constant:
        if torch.compiler.is_compiling():
            return function(*settings)
        result: Constant = remember(*settings)
        return result

    return call


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
    return _reduce(_reduce(image.mT, convention).mT, convention)


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
    return _expand(_expand(image.mT, size[1], convention).mT, size[0], convention)


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
        expanded = pyrup(smaller, (image.shape[-2], image.shape[-1]), convention)
        # Fresh memory costs more than the difference itself, so it is taken only where a gradient or a graph needs it.
        fresh = expanded.requires_grad or not values_known()
        details.append(image - expanded if fresh else torch.sub(image, expanded, out=expanded))
        image = smaller
    return Bands(tuple(details), image, convention)


@constant
def _matrix(count: int, length: int | None, convention: Convention, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix that reduces a line of `count` pixels, or expands it to `length`.

    Levels of a few thousand pixels cost less as two matrix products than as many short passes.
    """
    lines = torch.eye(count, dtype=torch.float64)[None, None]
    lines = _reduce(lines, convention) if length is None else _expand(lines, length, convention)
    return lines[0, 0].to(dtype=dtype, device=device)


def _reduce(image: Tensor, convention: Convention) -> Tensor:
    """`pyrdown` along the height."""
    count = image.shape[-2]
    if _blocks(count) and (convention == "opencv" or count % 2 == 0):
        return _filter(image, (count + 1) // 2, convention)
    return _blur(image)[..., ::2, :] if convention == "opencv" else _resize(_blur(image), max(count // 2, 1))


def _expand(image: Tensor, length: int, convention: Convention) -> Tensor:
    """`pyrup` along the height."""
    count = image.shape[-2]
    if _blocks(count) and (convention == "opencv" or length == 2 * count):
        return _filter(image, length, convention)
    if convention == "kornia":
        return _blur(_resize(image, length))
    before = torch.cat([image[..., min(1, count - 1), None, :], image[..., :-1, :]], -2)
    after = torch.cat([image[..., 1:, :], image[..., -1:, :]], -2)
    pairs = torch.stack([(before + 6 * image + after) / 8, (image + after) / 2], -2)
    return pairs.flatten(-3, -2)[..., :length, :]


def _blur(image: Tensor) -> Tensor:
    """Five taps along the height, the image mirrored at its outermost pixels."""
    count = image.shape[-2]
    # A line of one or two pixels is mirrored to and fro, as `BORDER_REFLECT_101` of OpenCV does.
    place = torch.arange(-2, count + 2, device=image.device).abs() % max(2 * count - 2, 1)
    extended = image.index_select(-2, torch.minimum(place, 2 * count - 2 - place))
    result = extended[..., :count, :] * _BLUR[0]
    for i in range(1, 5):
        result.add_(extended[..., i : i + count, :], alpha=_BLUR[i])
    return result


def _resize(image: Tensor, length: int) -> Tensor:
    """Bilinear resizing along the height, without antialiasing."""
    return F.interpolate(image, (length, image.shape[-1]), mode="bilinear", align_corners=False)


def _blocks(count: int) -> bool:
    """Whether `_filter` serves for a line of `count` pixels."""
    return count >= 5 * _BLOCK and values_known()


def _filter(image: Tensor, length: int, convention: Convention) -> Tensor:
    """Halve or double the height: matrix products of overlapping blocks of lines, all but the outermost alike.

    A product reads a transposed image as quickly, so that two passes filter both axes without a copy.
    """
    planes = image.flatten(0, -3)
    first, middle, last = _block_matrices(image.shape[-2], length, convention, image.dtype, image.device)
    step, lines = middle.shape[-2], _BLOCK + 2 * _REACH
    count = (image.shape[-2] - last.shape[-1] + _REACH) // _BLOCK - 1
    matrices = middle.expand(count, -1, -1)
    blocks = planes[:, _BLOCK - _REACH :].unfold(-2, lines, _BLOCK)[:, :count].mT
    outermost = first @ planes[:, : first.shape[-1]], last @ planes[:, -last.shape[-1] :]
    if planes.requires_grad and torch.is_grad_enabled():
        inner = [torch.bmm(matrices, block).flatten(0, 1) for block in blocks]
        return torch.cat([outermost[0], torch.stack(inner), outermost[1]], -2).unflatten(0, image.shape[:-2])
    result = planes.new_empty(planes.shape[0], length, planes.shape[-1])
    result[:, :step], result[:, step * (count + 1) :] = outermost
    for block, out in zip(blocks, result[:, step : step * (count + 1)].unflatten(1, (count, step)), strict=True):
        torch.bmm(matrices, block, out=out)
    return result.unflatten(0, image.shape[:-2])


@constant
def _block_matrices(
    count: int, length: int, convention: Convention, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Matrices that reduce or expand the first block of a line, one in the middle, and the last with what remains."""
    # The blocks of a line of four, and what remains, are those of a long one.
    short = 4 * _BLOCK + count % _BLOCK
    halves = length < count
    step = _BLOCK // 2 if halves else 2 * _BLOCK
    pixels = torch.eye(short, dtype=torch.float64)[None, None]
    lines = _reduce(pixels, convention) if halves else _expand(pixels, 2 * short - (2 * count - length), convention)
    whole = lines[0, 0].to(dtype=dtype, device=device)
    middle = whole[step : 2 * step, _BLOCK - _REACH : 2 * _BLOCK + _REACH]
    return (
        whole[:step, : _BLOCK + _REACH].contiguous(),
        middle.contiguous(),
        whole[3 * step :, 3 * _BLOCK - _REACH :].contiguous(),
    )

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
# Kornia blurs and resizes bilinearly, which between even sizes is one filter too: halving averages two blurred
# pixels, doubling blurs pixels at 1/4 and 3/4 between two. The taps of `_DOUBLE` are for pixels with zeros between.
_HALVE = {"kornia": tuple(t / 32 for t in (1, 5, 10, 10, 5, 1)), "opencv": _BLUR}
_DOUBLE = {"kornia": tuple(t / 64 for t in (1, 7, 21, 35, 35, 21, 7, 1)), "opencv": tuple(2 * t for t in _BLUR)}

_SMALL = 128
_ONEDNN = torch.backends.mkldnn.is_available()

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
    return _reduce(_reduce(image, convention).mT, convention).mT


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
    # Copies for the sake of speed: the transposed convolution is quick in one memory layout only.
    across = _expand(image.mT.contiguous(), size[1], convention).mT.contiguous()
    return _expand(across, size[0], convention)


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
    if _convolves(image) and (convention == "opencv" or count % 2 == 0):
        return _convolve(image, (count + 1) // 2, convention)
    return _blur(image)[..., ::2, :] if convention == "opencv" else _resize(_blur(image), max(count // 2, 1))


def _expand(image: Tensor, length: int, convention: Convention) -> Tensor:
    """`pyrup` along the height."""
    count = image.shape[-2]
    if _convolves(image) and (convention == "opencv" or length == 2 * count):
        return _convolve(image, length, convention)
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


def _convolves(image: Tensor) -> bool:
    """Whether `_convolve` is fast and precise here: oneDNN's convolutions are, for single precision on a CPU."""
    fast = _ONEDNN and image.device.type == "cpu" and image.dtype == torch.float32
    return fast and image.shape[-2] >= 8 and values_known()


def _convolve(image: Tensor, length: int, convention: Convention) -> Tensor:
    """Halve or double the height in one pass: a depthwise convolution whose channels are the columns."""
    top, bottom = _borders(image.shape[-2], length, convention, image.dtype, image.device)
    planes = image.flatten(0, -3)
    result = _convolve_zeros(planes, length, convention)
    count = planes.shape[0]
    result[:, :3].baddbmm_(top.expand(count, 3, 3), planes[:, :3])
    result[:, -3:].baddbmm_(bottom.expand(count, 3, 3), planes[:, -3:])
    return result.unflatten(0, image.shape[:-2])


def _convolve_zeros(planes: Tensor, length: int, convention: Convention) -> Tensor:
    """`_convolve` of planes `(N, height, width)`, with zeros beyond their borders."""
    count, width = planes.shape[-2:]
    columns = planes[:, None].permute(0, 3, 1, 2)
    kernel = _kernel(length < count, width, convention, planes.dtype, planes.device)
    taps = kernel.shape[-1]
    padding = (0, (taps - 1) // 2)
    if length < count:
        result = F.conv2d(columns, kernel, None, (1, 2), padding, groups=width)
    else:
        rest = (0, length - 2 * count + taps % 2)
        result = F.conv_transpose2d(columns, kernel, None, (1, 2), padding, rest, groups=width)
    return result.permute(0, 2, 3, 1)[:, 0]


@constant
def _kernel(halve: bool, width: int, convention: Convention, dtype: torch.dtype, device: torch.device) -> Tensor:
    taps = (_HALVE if halve else _DOUBLE)[convention]
    return torch.tensor(taps, dtype=dtype, device=device).expand(width, 1, 1, -1).contiguous()


@constant
def _borders(
    count: int, length: int, convention: Convention, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """What zeros beyond the borders leave out: `(3, 3)`, of the first three pixels and of the last three."""
    # A line of 8 or 9 pixels has the borders of a long one.
    short = 8 + count % 2
    length += (short - count) // 2 if length < count else 2 * (short - count)
    lines = torch.eye(short, dtype=torch.float64)[None]
    exact = _reduce(lines[None], convention) if length < short else _expand(lines[None], length, convention)
    missing = (exact[0] - _convolve_zeros(lines, length, convention))[0].to(dtype=dtype, device=device)
    return missing[:3, :3], missing[-3:, -3:]

"""Separable filters of any kind as matrix products with the lines of an image.

A filter whose output pixels depend on few neighbours is a matrix that is zero far from its diagonal. The matrix is cut
into tiles along the diagonal. On a CPU the products of the tiles are several times faster than convolutions of few
channels. A product reads a transposed image equally fast, so two passes filter both axes without a copy.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, wraps
from typing import Any, NamedTuple, TypeVar, TypeVarTuple

import torch
from torch import Tensor

from semfov.errors import values_known

# Lines of up to this many pixels are computed by one dense matrix, longer lines tile by tile.
_SMALL = 160

# Pixels of planes that are filtered together.
_CACHED = 1 << 18

_Constant = TypeVar("_Constant")
_Settings = TypeVarTuple("_Settings")


def constant(function: Callable[[*_Settings], _Constant]) -> Callable[[*_Settings], _Constant]:
    """Cache the results of a function of sizes and settings; a compiled graph computes its own."""

    @lru_cache(maxsize=256)
    def remember(*settings: Any) -> Any:
        # A tensor that is made during inference must be usable with gradients later.
        with torch.inference_mode(False), torch.no_grad():
            return function(*settings)

    @wraps(function)
    def call(*settings: *_Settings) -> _Constant:
        if torch.compiler.is_compiling():
            return function(*settings)
        result: _Constant = remember(*settings)
        return result

    return call


@dataclass(frozen=True)
class Taps:
    """A linear filter of a line: each output pixel is a weighted sum of input pixels `(length, taps)`."""

    index: Tensor
    weight: Tensor


class Lines(NamedTuple):
    """A matrix from input to output lines: dense, or tiles `(tiles, tile, window)` between dense ends."""

    first: Tensor
    middle: Tensor | None = None
    last: Tensor | None = None
    start: int = 0
    shift: int = 0

    @property
    def length(self) -> int:
        """Number of pixels of an output line."""
        made = len(self.first)
        if self.middle is not None and self.last is not None:
            made += self.middle.shape[0] * self.middle.shape[1] + len(self.last)
        return made


def banded(
    taps: Taps, count: int, tile: int, shift: int, reach: int, dtype: torch.dtype, device: torch.device
) -> Lines:
    """The matrix of a filter; long lines are cut into tiles of `tile` pixels, each over `shift` and twice `reach`."""
    index, weight = taps.index, taps.weight
    length, window = len(index), shift + 2 * reach
    before = -(-reach // shift)
    tiles = min((count - reach) // shift, length // tile) - before
    if max(count, length) <= _SMALL or tiles < 1:
        return Lines(_dense(index, weight, count).to(device, dtype))
    start, rows, rest = before * shift - reach, before * tile, (before + tiles) * tile
    inner = index[rows:rest].reshape(tiles, tile, -1) - (start + shift * torch.arange(tiles)[:, None, None])
    behind = start + tiles * shift
    first = _dense(index[:rows], weight[:rows], start + 2 * reach).to(device, dtype)
    middle = _dense(inner, weight[rows:rest].reshape(inner.shape), window).to(device, dtype)
    last = _dense(index[rest:] - behind, weight[rest:], count - behind).to(device, dtype)
    if values_known(middle) and bool((middle == middle[0]).all()):
        # Usually all tiles are equal, and a single one stays in the fastest cache.
        middle = middle[:1].expand(tiles, -1, -1)
    return Lines(first, middle, last, start, shift)


def separable(image: Tensor, down: Lines, across: Lines) -> Tensor:
    """Filter the columns of an image `(..., h, w)` with `down` and its rows with `across`."""
    if not values_known(image) or (image.requires_grad and torch.is_grad_enabled()) or image.device.type != "cpu":
        return _product(_product(image.mT, across).mT, down)
    if down.middle is None and across.middle is None:
        return down.first @ (image @ across.first.mT)
    planes = image.reshape(image.shape[:-2].numel(), *image.shape[-2:])
    result = planes.new_empty(len(planes), down.length, across.length)
    # So many planes at a time that what is between the two passes stays in the cache.
    number = max(1, _CACHED // (planes.shape[1] * max(planes.shape[2], across.length)))
    between = planes.new_empty(min(number, len(planes)), planes.shape[1], across.length)
    for group, made in zip(planes.split(number), result.split(number), strict=True):
        _fill(between[: len(group)].flatten(0, 1).mT, group.reshape(-1, group.shape[-1]).mT, across)
        for plane, filtered in zip(between, made, strict=False):
            _fill(filtered, plane, down)
    return result.reshape(*image.shape[:-2], *result.shape[-2:])


def _dense(index: Tensor, weight: Tensor, count: int) -> Tensor:
    """The dense matrix `(..., count)` of some output pixels."""
    return torch.zeros(*index.shape[:-1], count, dtype=weight.dtype).scatter_add(-1, index, weight)


def _product(image: Tensor, lines: Lines) -> Tensor:
    """Filter the columns of an image."""
    if lines.middle is None or lines.last is None:
        return lines.first @ image
    top, bottom = (
        lines.first @ image[..., : lines.first.shape[1], :],
        lines.last @ image[..., image.shape[-2] - lines.last.shape[1] :, :],
    )
    return torch.cat([top, (lines.middle @ _windows(image, lines, lines.middle)).flatten(-3, -2), bottom], -2)


def _fill(result: Tensor, plane: Tensor, lines: Lines) -> None:
    """Filter the columns of a plane `(h, w)`, and write each part into its place."""
    if lines.middle is None or lines.last is None:
        torch.mm(lines.first, plane, out=result)
        return
    top, bottom = len(lines.first), lines.length - len(lines.last)
    torch.mm(lines.first, plane[: lines.first.shape[1]], out=result[:top])
    torch.mm(lines.last, plane[plane.shape[0] - lines.last.shape[1] :], out=result[bottom:])
    inner = result[top:bottom].unflatten(0, (len(lines.middle), -1))
    torch.bmm(lines.middle, _windows(plane, lines, lines.middle), out=inner)


def _windows(image: Tensor, lines: Lines, middle: Tensor) -> Tensor:
    """The overlapping input windows of the tiles, `(..., tiles, window, w)`."""
    tiles, _, window = middle.shape
    stop = lines.start + (tiles - 1) * lines.shift + window
    return image[..., lines.start : stop, :].unfold(-2, window, lines.shift).mT

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
_CACHED = 1 << 19

# The C library returns freed blocks of several MB to the system, and every look would request their pages again. Once
# a block of this size was freed, it keeps up to twice as much.
torch.empty(31 << 20, dtype=torch.uint8)

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
    """A matrix from input to output lines: dense, or tiles `(tiles, tile, window)` between ends `(2, edge, span)`."""

    length: int
    dense: Tensor | None
    ends: Tensor
    middle: Tensor
    rows: int = 0
    start: int = 0
    shift: int = 0


def banded(
    taps: Taps, count: int, tile: int, shift: int, reach: int, dtype: torch.dtype, device: torch.device
) -> Lines:
    """The matrix of a filter; long lines are cut into tiles of `tile` pixels, each over `shift` and twice `reach`."""
    index, weight = taps.index, taps.weight
    length, window = len(index), shift + 2 * reach
    before = -(-reach // shift)
    tiles = min((count - reach) // shift, length // tile) - before
    if max(count, length) <= _SMALL or tiles < 1:
        dense = _dense(index, weight, count).to(device, dtype)
        return Lines(length, dense, dense[None], dense[None])
    start, rows, rest = before * shift - reach, before * tile, (before + tiles) * tile
    inner = index[rows:rest].reshape(tiles, tile, -1) - (start + shift * torch.arange(tiles)[:, None, None])
    middle = _dense(inner, weight[rows:rest].reshape(inner.shape), window).to(device, dtype)
    if values_known(middle) and bool((middle == middle[0]).all()):
        # Usually all tiles are equal, and a single one stays in the fastest cache.
        middle = middle[:1].expand(tiles, -1, -1)
    # Both ends have the same size, so that one product computes them; the longer one decides.
    edge = max(rows, length - rest)
    span = min(count, max(-(-edge // tile) * shift, count - (length - edge) // tile * shift) + reach)
    head, tail = slice(edge), slice(length - edge, length)
    ends = _dense(index[head], weight[head], span), _dense(index[tail] - (count - span), weight[tail], span)
    return Lines(length, None, torch.stack(ends).to(device, dtype), middle, rows, start, shift)


def separable(image: Tensor, down: Lines, across: Lines) -> Tensor:
    """Filter the columns of an image `(..., h, w)` with `down` and its rows with `across`."""
    if not values_known(image) or (image.requires_grad and torch.is_grad_enabled()) or image.device.type != "cpu":
        return _product(_product(image.mT, across).mT, down)
    if down.dense is not None and across.dense is not None:
        return down.dense @ (image @ across.dense.mT)
    planes = image.reshape(image.shape[:-2].numel(), *image.shape[-2:])
    result = planes.new_empty(len(planes), down.length, across.length)
    # The pass with fewer pixels is the slower one, across, which takes all planes at once. So many planes are filtered
    # at a time that what is between the passes stays in the cache.
    shrinks = down.length < planes.shape[1]
    sides = (down.length, planes.shape[2]) if shrinks else (planes.shape[1], across.length)
    between = planes.new_empty(min(max(1, _CACHED // (sides[0] * sides[1])), len(planes)), *sides)
    for group, made in zip(planes.split(len(between)), result.split(len(between)), strict=True):
        part = between[: len(group)]
        if not shrinks:
            _fill(part.flatten(0, 1).mT, group.reshape(-1, group.shape[-1]).mT, across)
        for plane, filtered in zip(*((group, part) if shrinks else (part, made)), strict=True):
            _fill(filtered, plane, down)
        if shrinks:
            _fill(made.flatten(0, 1).mT, part.flatten(0, 1).mT, across)
    return result.reshape(*image.shape[:-2], *result.shape[-2:])


def _dense(index: Tensor, weight: Tensor, count: int) -> Tensor:
    """The dense matrix `(..., count)` of some output pixels."""
    return torch.zeros(*index.shape[:-1], count, dtype=weight.dtype).scatter_add(-1, index, weight)


def _product(image: Tensor, lines: Lines) -> Tensor:
    """Filter the columns of an image."""
    if lines.dense is not None:
        return lines.dense @ image
    _, edge, span = lines.ends.shape
    made = lines.rows + lines.middle.shape[:2].numel()
    top = lines.ends[0, : lines.rows] @ image[..., :span, :]
    inner = (lines.middle @ _windows(image, lines)).flatten(-3, -2)
    bottom = lines.ends[1, edge - lines.length + made :] @ image[..., image.shape[-2] - span :, :]
    return torch.cat([top, inner, bottom], -2)


def _fill(result: Tensor, plane: Tensor, lines: Lines) -> None:
    """Filter the columns of a plane `(h, w)`, and write each part into its place."""
    if lines.dense is not None:
        torch.mm(lines.dense, plane, out=result)
        return
    _, edge, span = lines.ends.shape
    torch.bmm(lines.ends, _both_ends(plane, span), out=_both_ends(result, edge))
    tiles, tile, window = lines.middle.shape
    inputs = _parts(plane, lines.start, lines.shift, (tiles, window))
    torch.bmm(lines.middle, inputs, out=_parts(result, lines.rows, tile, (tiles, tile)))


def _both_ends(plane: Tensor, rows: int) -> Tensor:
    """The first and the last rows of a plane, `(2, rows, w)`, which may overlap."""
    return _parts(plane, 0, plane.shape[0] - rows, (2, rows))


def _parts(plane: Tensor, first: int, apart: int, shape: tuple[int, int]) -> Tensor:
    """Parts `(n, rows, w)` of a plane that begin at rows `apart`, from a first one; they may overlap."""
    step, along = plane.stride()
    begin = plane.storage_offset() + first * step
    return plane.as_strided((*shape, plane.shape[1]), (apart * step, step, along), begin)


def _windows(image: Tensor, lines: Lines) -> Tensor:
    """The overlapping input windows of the tiles, `(..., tiles, window, w)`."""
    tiles, _, window = lines.middle.shape
    stop = lines.start + (tiles - 1) * lines.shift + window
    return image[..., lines.start : stop, :].unfold(-2, window, lines.shift).mT

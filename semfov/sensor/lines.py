"""Separable filters of any kind as matrix products with the lines of an image.

A filter whose output pixels depend on few neighbours is a matrix that is zero far from its diagonal. The matrix is cut
into tiles along the diagonal. On a CPU the products of the tiles are several times faster than convolutions of few
channels. A product reads a transposed image equally fast, so two passes filter both axes without a copy.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from semfov.errors import values_known

# Lines of up to this many pixels are computed by one dense matrix, longer lines tile by tile.
_SMALL = 112

# Pixels of planes that are filtered together.
_CACHED = 1 << 18

# The C library returns freed blocks of several MB to the system, and every look would request their pages again. Once
# a block of this size was freed, it keeps up to twice as much.
_KEPT = 31 << 20
torch.empty(_KEPT, dtype=torch.uint8)


def empty(like: Tensor, *shape: int) -> Tensor:
    """`like.new_empty(shape)`, on a CPU in large pages of memory where the C library would not keep it."""
    new = like.new_empty(shape)
    # NumPy asks for large pages, of which fewer are fetched when the tensor is written.
    large = new.nbytes > _KEPT and new.itemsize > 2 and new.device.type == "cpu"
    return torch.from_numpy(np.empty_like(new.numpy())) if large else new


_Part = tuple[tuple[int, int, int], tuple[int, int, int], int]  # size, strides and begin of rows of planes
_Product = tuple[Tensor, _Part, _Part]  # a matrix, what it multiplies, and where the product is written


@dataclass(frozen=True)
class Taps:
    """A linear filter of a line: each output pixel is a weighted sum of input pixels `(length, taps)`."""

    index: Tensor
    weight: Tensor


@dataclass(frozen=True, eq=False)
class Lines:
    """A matrix from input to output lines: dense, or tiles `(tiles, tile, window)` between ends `(2, edge, span)`."""

    count: int
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
        return Lines(count, length, dense, dense[None], dense[None])
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
    return Lines(count, length, None, torch.stack(ends).to(device, dtype), middle, rows, start, shift)


def separable(image: Tensor, down: Lines, across: Lines) -> Tensor:
    """Filter the columns of an image `(..., h, w)` with `down` and its rows with `across`."""
    if not values_known(image) or (image.requires_grad and torch.is_grad_enabled()) or image.device.type != "cpu":
        return _product(_product(image.mT, across).mT, down)
    if down.dense is not None and across.dense is not None:
        return down.dense @ (image @ across.dense.mT)
    planes = image.reshape(image.shape[:-2].numel(), *image.shape[-2:])
    shrinks = down.length < down.count
    if not shrinks:
        planes = planes.contiguous()
    number = planes.shape[0]
    result = empty(planes, number, down.length, across.length)
    # So many planes are filtered at a time that what is between the passes stays in the cache.
    sides = (down.length, across.count) if shrinks else (down.count, across.length)
    most = max(1, _CACHED // (sides[0] * sides[1]))
    between = planes.new_empty(min(most, number), *sides)
    for first in range(0, number, most):
        passes = _passes(down, across, min(most, number - first), planes.stride())
        _multiply(passes[0], planes, int(planes.storage_offset()) + first * planes.stride(0), between, 0)
        _multiply(passes[1], between, 0, result, first * down.length * across.length)
    return result.view(*image.shape[:-2], *result.shape[-2:])


def difference(
    one: Tensor, other: Tensor, down: Lines, across: Lines, weights: tuple[Tensor, Tensor], result: Tensor
) -> None:
    """Filter planes `(n, h, w)` of one image, minus those of another times the weights of rows and of columns.

    Neither line may be dense. The lines of both images alternate between the passes, so that one product subtracts.
    """
    rows, width = down.count, across.length
    between = one.new_empty(rows, 2, width)
    ends, middle = _weighted(across, weights[1])
    both = across, replace(across, ends=ends, middle=middle)
    first = [_products(lines, 1, rows, (0, 1, across.count), (0, 1, 2 * width)) for lines in both]
    pairs = zip((down.ends, down.middle), _weighted(down, -weights[0]), strict=True)
    ends, middle = (torch.stack([each.expand_as(minus), minus], -1).flatten(-2) for each, minus in pairs)
    last = Lines(2 * rows, down.length, None, ends, middle, down.rows, 2 * down.start, 2 * down.shift)
    second = _products(last, 1, width, (0, width, 1), (0, width, 1))
    for *planes, plane in zip(one, other, result, strict=True):
        for at, (products, each) in enumerate(zip(first, planes, strict=True)):
            _multiply(products, each, each.storage_offset(), between, at * width)
        _multiply(second, between, 0, plane, plane.storage_offset())


def _weighted(lines: Lines, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Ends and middle of lines with their output pixels times a weight `(length,)`."""
    tiles, tile, _ = lines.middle.shape
    edge, last = lines.ends.shape[1], lines.rows + tiles * tile
    ends = torch.stack([weight[:edge], weight[len(weight) - edge :]])[..., None] * lines.ends
    return ends, weight[lines.rows : last].view(tiles, tile, 1) * lines.middle


def _multiply(products: list[_Product], source: Tensor, begin: int, result: Tensor, into: int) -> None:
    """Compute products of planes in the memory of `source` from `begin` on, in that of the result from `into` on."""
    for matrix, (size, strides, offset), (sides, steps, place) in products:
        planes = source.as_strided(size, strides, begin + offset)
        torch.bmm(matrix, planes, out=result.as_strided(sides, steps, into + place))


@lru_cache(maxsize=256)
def _passes(
    down: Lines, across: Lines, number: int, strides: tuple[int, int, int]
) -> tuple[list[_Product], list[_Product]]:
    """Products of both passes over planes; to work them out takes as long as the products of a small plane."""
    height, width = down.length, across.length
    if down.length < down.count:
        # The pass with fewer pixels is the slower one, across, which takes all planes at once.
        between = (height * across.count, across.count, 1)
        return (
            _products(down, number, across.count, strides, between),
            _products(across, 1, number * height, (0, 1, across.count), (0, 1, width)),
        )
    between = (down.count * width, width, 1)
    return (
        _products(across, 1, number * down.count, (0, 1, across.count), (0, 1, width)),
        _products(down, number, width, between, (height * width, width, 1)),
    )


def _products(
    lines: Lines, number: int, width: int, source: tuple[int, int, int], target: tuple[int, int, int]
) -> list[_Product]:
    """Products that filter the columns of planes, given the strides of planes, rows and columns."""
    made: list[_Product] = []

    def at(row: int, other: int) -> tuple[int, int]:
        return row * source[1], other * target[1]

    def add(matrix: Tensor, apart: tuple[int, int], begin: tuple[int, int]) -> None:
        many, rows, window = matrix.shape
        read = (many, window, width), (apart[0], *source[1:]), begin[0]
        made.append((matrix, read, ((many, rows, width), (apart[1], *target[1:]), begin[1])))

    planes = source[0], target[0]
    if lines.dense is not None:
        add(lines.dense.expand(number, -1, -1), planes, (0, 0))
        return made
    tiles, tile, _ = lines.middle.shape
    step, first, along = at(lines.shift, tile), at(lines.start, lines.rows), lines.count // lines.shift
    alike = lines.middle.stride(0) == 0 and (lines.count, lines.length) == (along * lines.shift, along * tile)
    if number > 1 and alike and planes == at(lines.count, lines.length):
        # Tiles of all planes at once. Those that lie across two planes are written over by the ends.
        add(lines.middle[:1].expand(tiles + (number - 1) * along, -1, -1), step, first)
    else:
        for n in range(number):
            add(lines.middle, step, (first[0] + n * planes[0], first[1] + n * planes[1]))
    _, edge, span = lines.ends.shape
    last = at(lines.count - span, lines.length - edge)
    if number == 1:
        add(lines.ends, last, (0, 0))
        return made
    for end, begin in zip(lines.ends, ((0, 0), last), strict=True):
        add(end.expand(number, -1, -1), planes, begin)
    return made


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
    tiles, _, window = lines.middle.shape
    stop = lines.start + (tiles - 1) * lines.shift + window
    # The overlapping input windows of the tiles, `(..., tiles, window, w)`.
    windows = image[..., lines.start : stop, :].unfold(-2, window, lines.shift).mT
    inner = (lines.middle @ windows).flatten(-3, -2)
    bottom = lines.ends[1, edge - lines.length + made :] @ image[..., image.shape[-2] - span :, :]
    return torch.cat([top, inner, bottom], -2)

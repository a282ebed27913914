"""Separable filters of any kind as matrix products with the lines of an image.

A filter whose output pixels depend on few neighbours is a matrix that is zero far from its diagonal. The matrix is cut
into tiles along the diagonal, between two ends of one size:

                        input pixels, `count`
                  0     start
                  ┌───────────┐
          output  │ end       │
          pixels  │     ┌─────┴──┐
          `length`│     │ tile   │       `rows` output pixels are above the first tile,
                  └─────┴──┬─────┴──┐    whose window of input pixels begins at `start`;
                           │ tile   │    the next window begins `shift` pixels later
                           └──┬─────┴─────┐
                              │       end │
                              └───────────┘

On a CPU the products of the tiles are several times faster than convolutions of few channels. A product reads a
transposed image equally fast, so two passes filter both axes without a copy.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

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
    """Allocate `like.new_empty(shape)`, on a CPU in large pages of memory where the C library would not keep it."""
    tensor = like.new_empty(shape)
    # NumPy asks for large pages, of which fewer are fetched when the tensor is written. It has no bfloat16.
    large = tensor.nbytes > _KEPT and tensor.itemsize > 2 and tensor.device.type == "cpu"
    return torch.from_numpy(np.empty_like(tensor.numpy())) if large else tensor


class _Part(NamedTuple):
    """A stack of matrices in the memory of a tensor: what `Tensor.as_strided` takes."""

    size: tuple[int, int, int]
    strides: tuple[int, int, int]
    begin: int


class _Product(NamedTuple):
    """A product of matrices with parts of two tensors, `target = matrix @ source`."""

    matrix: Tensor
    source: _Part
    target: _Part


class _Offset(NamedTuple):
    """A distance in the memory that is read, and the one in the memory that is written meanwhile."""

    read: int
    written: int


class _Memory(NamedTuple):
    """Where planes lie that a filter reads and writes; strides are those of planes, rows and columns.

    Attributes:
        width: number of columns of a plane.
        source: strides in the memory that is read.
        target: strides in the memory that is written.
    """

    width: int
    source: tuple[int, int, int]
    target: tuple[int, int, int]

    @property
    def plane(self) -> _Offset:
        """From one plane to the next."""
        return _Offset(self.source[0], self.target[0])

    def rows(self, read: int, written: int) -> _Offset:
        """Find the offset of a number of rows that are read, and of rows that are written."""
        return _Offset(read * self.source[1], written * self.target[1])

    def product(self, matrix: Tensor, step: _Offset, begin: _Offset) -> _Product:
        """Make a stack of products `(stack, height, window)`, each a step after the one before, from an offset on."""
        stack, height, window = matrix.shape
        read = _Part((stack, window, self.width), (step.read, *self.source[1:]), begin.read)
        written = _Part((stack, height, self.width), (step.written, *self.target[1:]), begin.written)
        return _Product(matrix, read, written)


@dataclass(frozen=True)
class Taps:
    """A linear filter of a line: each output pixel is a weighted sum of input pixels `(length, taps)`."""

    index: Tensor
    weight: Tensor


@dataclass(frozen=True, eq=False)
class Lines:
    """A matrix from input to output lines, dense or in tiles, as the drawing in `semfov.sensor.lines` shows.

    Attributes:
        count: number of input pixels.
        length: number of output pixels.
        dense: the matrix `(length, count)`, of short lines; None of long ones.
        ends: `(2, edge, span)`, the first and last `edge` output pixels from the first and last `span` input pixels.
        middle: `(tiles, tile, window)`, the output pixels of each tile from the input pixels of its window.
        rows: number of output pixels above the first tile.
        start: number of input pixels before the window of the first tile.
        shift: number of input pixels from one window to the next.
    """

    count: int
    length: int
    dense: Tensor | None
    ends: Tensor
    middle: Tensor
    rows: int = 0
    start: int = 0
    shift: int = 0


def banded(
    taps: Taps,
    count: int,
    tile: int,
    shift: int,
    reach: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Lines:
    """Make the matrix of a filter.

    Args:
        taps: the filter.
        count: number of input pixels.
        tile: number of output pixels of a tile, of long lines.
        shift: number of input pixels that a tile advances.
        reach: number of input pixels that a tile needs beside these, on either side.
        dtype: dtype of the matrix.
        device: device of the matrix.

    Returns:
        The matrix.
    """
    index = taps.index
    weight = taps.weight
    length = len(index)
    skipped = -(-reach // shift)  # tiles that would reach beyond the first pixel
    tiles = min((count - reach) // shift, length // tile) - skipped
    if max(count, length) <= _SMALL or tiles < 1:
        dense = _dense(index, weight, count).to(device, dtype)
        return Lines(count, length, dense, dense[None], dense[None])

    start = skipped * shift - reach
    rows = skipped * tile
    stop = rows + tiles * tile
    first_pixels = start + shift * torch.arange(tiles)[:, None, None]
    index_in_window = index[rows:stop].reshape(tiles, tile, -1) - first_pixels
    weight_in_window = weight[rows:stop].reshape(index_in_window.shape)
    middle = _dense(index_in_window, weight_in_window, shift + 2 * reach).to(device, dtype)
    # A single tile stays in the fastest cache.
    if _are_equal(middle):
        middle = middle[:1].expand(tiles, -1, -1)

    # Both ends have the same size, so that one product computes them; the longer one decides.
    edge = max(rows, length - stop)
    span_of_head = -(-edge // tile) * shift
    span_of_tail = count - (length - edge) // tile * shift
    span = min(count, max(span_of_head, span_of_tail) + reach)
    ends = _ends(taps, count, edge, span).to(device, dtype)
    return Lines(count, length, None, ends, middle, rows, start, shift)


def _ends(taps: Taps, count: int, edge: int, span: int) -> Tensor:
    """Make the matrices of the first and the last `edge` output pixels from the first and the last `span` of `count`.

    Returns:
        `(2, edge, span)`.
    """
    first_of_tail = len(taps.index) - edge
    head = _dense(taps.index[:edge], taps.weight[:edge], span)
    tail = _dense(taps.index[first_of_tail:] - (count - span), taps.weight[first_of_tail:], span)
    return torch.stack([head, tail])


def _are_equal(tiles: Tensor) -> bool:
    """Tell whether all tiles `(tiles, tile, window)` are known to be equal, as they usually are."""
    # Tracers other than the compiler, which keeps the matrix as a constant, make tensors of another type, whose values
    # are not known.
    readable = type(tiles) is Tensor and not tiles.is_meta
    return readable and bool((tiles == tiles[0]).all())


def separable(image: Tensor, down: Lines, across: Lines) -> Tensor:
    """Filter the columns and the rows of images.

    Args:
        image: `(..., h, w)`.
        down: filter of the columns, for h input pixels.
        across: filter of the rows, for w input pixels.

    Returns:
        `(..., h', w')`, with the numbers of output pixels.
    """
    is_recorded = image.requires_grad and torch.is_grad_enabled()
    if is_recorded or image.device.type != "cpu" or not values_known(image):
        filtered_rows = _product(image.mT, across).mT
        return _product(filtered_rows, down)
    if down.dense is not None and across.dense is not None:
        return down.dense @ (image @ across.dense.mT)
    leading = image.shape[:-2]
    planes = image.reshape(leading.numel(), *image.shape[-2:])
    return _filter_planes(planes, down, across).view(*leading, down.length, across.length)


def _filter_planes(planes: Tensor, down: Lines, across: Lines) -> Tensor:
    """Filter planes `(n, h, w)` on a CPU, so many at a time that what is between the passes stays in the cache."""
    shrinks = down.length < down.count
    if not shrinks:
        planes = planes.contiguous()
    number = planes.shape[0]
    result = empty(planes, number, down.length, across.length)
    # The pass that makes fewer pixels goes first.
    height, width = (down.length, across.count) if shrinks else (down.count, across.length)
    together = max(1, _CACHED // (height * width))
    between = planes.new_empty(min(together, number), height, width)
    for first in range(0, number, together):
        first_pass, second_pass = _passes(down, across, min(together, number - first), planes.stride())
        begin = int(planes.storage_offset()) + first * planes.stride(0)
        _multiply(first_pass, planes, begin, between, 0)
        _multiply(second_pass, between, 0, result, first * down.length * across.length)
    return result


def difference(
    planes: Tensor,
    others: Tensor,
    down: Lines,
    across: Lines,
    weights: tuple[Tensor, Tensor],
    result: Tensor,
) -> None:
    """Filter planes of one image, minus those of another times the weights of rows and of columns.

    The lines of both images alternate between the passes, so that one product subtracts.

    Args:
        planes: `(n, h, w)`.
        others: `(n, h, w)`, the planes that are subtracted.
        down: filter of the columns, not dense.
        across: filter of the rows, not dense.
        weights: of the rows and of the columns of the result.
        result: memory for the result, `(n, h', w')`.
    """
    rows = down.count
    width = across.length
    weights_of_rows, weights_of_columns = weights
    # Between the passes, each line of the planes is followed by the line of the others.
    between = planes.new_empty(rows, 2, width)
    every_second_line = (0, 1, 2 * width)
    across_planes = _products(across, 1, rows, (0, 1, across.count), every_second_line)
    weighted_across = _weighted(across, weights_of_columns)
    across_others = _products(weighted_across, 1, rows, (0, 1, across.count), every_second_line)
    # The second pass adds a line of the planes, and subtracts one of the others.
    minus = _weighted(down, -weights_of_rows)
    alternating = Lines(
        count=2 * rows,
        length=down.length,
        dense=None,
        ends=_alternated(down.ends, minus.ends),
        middle=_alternated(down.middle, minus.middle),
        rows=down.rows,
        start=2 * down.start,
        shift=2 * down.shift,
    )
    down_both = _products(alternating, 1, width, (0, width, 1), (0, width, 1))
    for plane, other, target in zip(planes, others, result, strict=True):
        _multiply(across_planes, plane, plane.storage_offset(), between, 0)
        _multiply(across_others, other, other.storage_offset(), between, width)
        _multiply(down_both, between, 0, target, target.storage_offset())


def _alternated(matrix: Tensor, other: Tensor) -> Tensor:
    """Alternate the columns of two matrices `(..., rows, n)`: `(..., rows, 2 n)`."""
    return torch.stack([matrix.expand_as(other), other], -1).flatten(-2)


def _weighted(lines: Lines, weight: Tensor) -> Lines:
    """Multiply the output pixels of lines by weights `(length,)`."""
    tiles, tile, _ = lines.middle.shape
    edge = lines.ends.shape[1]
    stop = lines.rows + tiles * tile
    weight_of_ends = torch.stack([weight[:edge], weight[len(weight) - edge :]])  # (2, edge)
    weight_of_tiles = weight[lines.rows : stop].view(tiles, tile, 1)
    return replace(lines, ends=weight_of_ends[..., None] * lines.ends, middle=weight_of_tiles * lines.middle)


def _multiply(products: list[_Product], source: Tensor, read_from: int, target: Tensor, write_from: int) -> None:
    """Compute products of the memory of `source` from an offset on, into that of `target` from another one on."""
    for product in products:
        size, strides, begin = product.source
        planes = source.as_strided(size, strides, read_from + begin)
        size, strides, begin = product.target
        torch.bmm(product.matrix, planes, out=target.as_strided(size, strides, write_from + begin))


@lru_cache(maxsize=256)
def _passes(
    down: Lines, across: Lines, number: int, strides: tuple[int, int, int]
) -> tuple[list[_Product], list[_Product]]:
    """List the products of both passes over planes, which takes as long as the products of a small plane.

    Args:
        down: filter of the columns.
        across: filter of the rows.
        number: number of planes.
        strides: strides of planes, rows and columns.

    Returns:
        Products of the first pass, from the planes to what is between, and of the second one, to the result.
    """
    height = down.length
    width = across.length
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
    lines: Lines,
    number: int,
    width: int,
    source: tuple[int, int, int],
    target: tuple[int, int, int],
) -> list[_Product]:
    """List the products that filter the columns of planes.

    Args:
        lines: the filter.
        number: number of planes.
        width: number of columns of each.
        source: strides of planes, rows and columns in the memory that is read.
        target: the same strides in the memory that is written.

    Returns:
        The products, in the order in which they must be computed.
    """
    memory = _Memory(width, source, target)
    if lines.dense is not None:
        return [memory.product(lines.dense.expand(number, -1, -1), memory.plane, _Offset(0, 0))]
    # The ends come last: some write over what tiles have written.
    return [*_products_of_tiles(lines, number, memory), *_products_of_ends(lines, number, memory)]


def _products_of_tiles(lines: Lines, number: int, memory: _Memory) -> list[_Product]:
    """List the products of the tiles of a number of planes."""
    tiles, tile, _ = lines.middle.shape
    step = memory.rows(lines.shift, tile)
    first = memory.rows(lines.start, lines.rows)
    tiles_of_plane = lines.count // lines.shift
    divides = (lines.count, lines.length) == (tiles_of_plane * lines.shift, tiles_of_plane * tile)
    is_one_tile = lines.middle.stride(0) == 0
    follow_each_other = memory.plane == memory.rows(lines.count, lines.length)
    if number > 1 and is_one_tile and divides and follow_each_other:
        # Tiles of all planes at once. Those that lie across two planes are written over by the ends.
        tiles_of_all = tiles + (number - 1) * tiles_of_plane
        return [memory.product(lines.middle[:1].expand(tiles_of_all, -1, -1), step, first)]
    products = []
    for plane in range(number):
        begin = _Offset(first.read + plane * memory.plane.read, first.written + plane * memory.plane.written)
        products.append(memory.product(lines.middle, step, begin))
    return products


def _products_of_ends(lines: Lines, number: int, memory: _Memory) -> list[_Product]:
    """List the products of both ends of a number of planes."""
    edge, span = lines.ends.shape[1:]
    top = _Offset(0, 0)
    bottom = memory.rows(lines.count - span, lines.length - edge)
    if number == 1:
        return [memory.product(lines.ends, bottom, top)]
    head, tail = lines.ends
    return [
        memory.product(head.expand(number, -1, -1), memory.plane, top),
        memory.product(tail.expand(number, -1, -1), memory.plane, bottom),
    ]


def _dense(index: Tensor, weight: Tensor, count: int) -> Tensor:
    """Make the dense matrix `(..., count)` of some output pixels."""
    return torch.zeros(*index.shape[:-1], count, dtype=weight.dtype).scatter_add(-1, index, weight)


def _product(image: Tensor, lines: Lines) -> Tensor:
    """Filter the columns of an image by operations that can be recorded and traced."""
    if lines.dense is not None:
        return lines.dense @ image
    tiles, tile, window = lines.middle.shape
    edge, span = lines.ends.shape[1:]
    first_pixels = image[..., :span, :]
    last_pixels = image[..., image.shape[-2] - span :, :]
    top = lines.ends[0, : lines.rows] @ first_pixels

    # The overlapping input windows of the tiles, `(..., tiles, window, w)`.
    stop = lines.start + (tiles - 1) * lines.shift + window
    windows = image[..., lines.start : stop, :].unfold(-2, window, lines.shift).mT
    inner = (lines.middle @ windows).flatten(-3, -2)

    below = lines.length - lines.rows - tiles * tile  # output pixels after the last tile
    bottom = lines.ends[1, edge - below :] @ last_pixels
    return torch.cat([top, inner, bottom], -2)

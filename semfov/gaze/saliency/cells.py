"""Reduce a saliency map over the pixels to values of the cells of a grid."""

from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.errors import check, check_shape, lookup

Reduction = Literal["mean", "max"]


def cell_saliency(saliency: Tensor, columns: int, rows: int, reduction: Reduction = "mean") -> Tensor:
    """Compute the saliency of each of `columns` × `rows` equal cells of the image, numbered row by row.

    Args:
        saliency: `(B, H, W)`, of any size.
        columns: number of cells in a row, X.
        rows: number of cells in a column, Y.
        reduction: `mean` over the area of the cell, where a pixel on the border counts by the fraction inside; or
            `max` over the pixels that overlap the cell. With `max` the best cell not yet visited is the one of the
            most salient pixel outside visited cells, as Luzio, Bernardino and Moreno (2024, section IV-B) describe
            inhibition of return.

    Returns:
        `(B, Y·X)`.

    Raises:
        InputError: the map is empty or not `(B, H, W)` of floating-point numbers, there is no such `reduction`, or
            `columns` or `rows` is less than 1.

    >>> cell_saliency(torch.tensor([[[0.0, 2.0, 4.0]]]), 2, 1)
    tensor([[0.6667, 3.3333]])
    """
    check_shape(saliency, "saliency", None, None, None)
    check(saliency.ndim == 3, "saliency", "a tensor of shape (B, any, any)", tuple(saliency.shape))
    check(min(saliency.shape[-2:]) > 0, "saliency", "at least one pixel", tuple(saliency.shape))
    check(saliency.is_floating_point(), "saliency", "floating-point values", saliency.dtype)
    check(columns >= 1 and rows >= 1, "columns, rows", "at least 1", (columns, rows))
    lookup(reduction, get_args(Reduction), "reduction")
    if reduction == "max":
        return _maximum_along(_maximum_along(saliency, rows), columns).flatten(1)
    height, width = saliency.shape[-2:]
    vertical = _shares(height, rows, saliency)
    horizontal = _shares(width, columns, saliency)
    return (vertical @ saliency @ horizontal.mT).flatten(1)


def _maximum_along(saliency: Tensor, cells: int) -> Tensor:
    """Take the maximum of `(B, N, M)` over the pixels that overlap each of the cells along N: `(B, M, cells)`.

    The axes change places, so that two calls reduce both.
    """
    pixels = saliency.shape[1]
    maxima = []
    for cell in range(cells):
        start = cell * pixels // cells
        stop = -(-(cell + 1) * pixels // cells)  # rounded up
        maxima.append(saliency[:, start:stop].amax(1))
    return torch.stack(maxima, -1)


def _shares(pixels: int, cells: int, like: Tensor) -> Tensor:
    """Compute the fraction of each cell's length that each pixel covers, `(cells, pixels)`; rows sum to 1."""
    # Lengths are scaled so that the borders of both pixels and cells are whole numbers.
    pixel = torch.arange(pixels, device=like.device) * cells
    cell = torch.arange(cells, device=like.device)[:, None] * pixels
    overlap = torch.minimum(pixel + cells, cell + pixels) - torch.maximum(pixel, cell)
    return overlap.clamp(min=0).to(like.dtype) / pixels

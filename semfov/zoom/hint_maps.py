"""Maps of a look's hints, from which small networks predict how many objects smaller windows show."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.sensor.constants import constant

HINT_MAPS = 11  # number of maps of `hint_maps`
MEMORY_MAPS = 2  # number of maps of `memory_maps`
CROWD = 9  # side in cells of the square over which the networks read the mean of the strongest hints
LOWEST = -0.8  # about the feature of a score of 0

_FLOOR = 1e-4  # added to scores before their logarithm
_RINGS = 8  # cells of the closest window, for which the weights of the border are learned


def features(scores: Tensor) -> Tensor:
    """Compute the logarithms of scores, shifted and scaled to about [-1, 1.5], as inputs of a network.

    Args:
        scores: `(...)`, from 0 to 1.

    Returns:
        `(...)`.
    """
    return (scores + _FLOOR).log().mul_(0.25).add_(1.5)


def hint_maps(hints: Tensor, best: Tensor, detections: Tensor, size: Tensor, crowd: Tensor) -> list[Tensor]:
    """Compute the inputs of a network: hints, detections and object sizes in and around each cell.

    Args:
        hints: `(T, rows, columns)`, feature of the strongest hint of each class.
        best: `(rows, columns)`, feature of the strongest hint of any class.
        detections: `(T, rows, columns)`, 1 where a detection of the class lies, else 0.
        size: `(rows, columns)`, logarithm of the size of the strongest hint's box; 0 where there is no hint.
        crowd: `(rows, columns)`, mean of `best` over a square of `CROWD` cells.

    Returns:
        `HINT_MAPS` maps `(T, rows, columns)`.
    """
    # One call for the peaks of both: after a pass of the detector a call costs more than the work in it.
    peak, close_detections = neighbourhood_peak(torch.cat([hints, detections]), 3).chunk(2)
    maps = [
        hints,
        best,
        peak,
        neighbourhood_peak(peak, 7),
        neighbourhood_mean(hints, 5),
        crowd,
        size / 4 - 1,
        (size > 0).to(hints),
        detections,
        close_detections,
        hints.amax((-1, -2), keepdim=True),
    ]
    return [values.expand(hints.shape) for values in maps]


def memory_maps(like: Tensor, before: Tensor | None) -> list[Tensor]:
    """Make two inputs of a network: what an earlier, coarser look predicted for each cell, and whether there was one.

    Args:
        like: `(T, rows, columns)`, gives shape, type and device.
        before: `(T, rows, columns)`, logarithms of the rates that the earlier look gave; None without one.

    Returns:
        `MEMORY_MAPS` maps `(T, rows, columns)`.
    """
    prediction = torch.full_like(like, -1.0) if before is None else before / 4
    return [prediction, torch.full_like(like, float(before is not None))]


def neighbourhood_peak(values: Tensor, side: int) -> Tensor:
    """Find the largest value in the square of `side` cells about each cell of maps `(T, rows, columns)`."""
    # One axis after the other: fewer comparisons.
    peaks = F.max_pool1d(values, side, 1, side // 2)
    return F.max_pool1d(peaks.mT, side, 1, side // 2).mT


def neighbourhood_mean(values: Tensor, side: int) -> Tensor:
    """Average maps over the square about each cell; what lies beyond the map counts as 0.

    Args:
        values: `(T, rows, columns)`.
        side: of the square in cells, odd.

    Returns:
        `(T, rows, columns)`.
    """
    # Products with banded matrices take a tenth of the time of `avg_pool2d`.
    rows, columns = values.shape[-2:]
    down = _band(rows, side, values.dtype, values.device)
    across = _band(columns, side, values.dtype, values.device)
    return down @ values @ across


@constant
def _band(length: int, side: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Make the matrix `(length, length)` whose product with a line takes the mean over `side` neighbours."""
    place = torch.arange(length, device=device)
    return ((place[:, None] - place).abs() <= side // 2).to(dtype) / side


def tapered(border: Tensor, span: int) -> Tensor:
    """Interpolate the learned weights at a window's border over the cells along its side.

    Args:
        border: `(4,)`, weights before the logistic function, from the border to the middle.
        span: number of cells along the side.

    Returns:
        `(span,)`, from 0 to 1.
    """
    cell = torch.arange(span, device=border.device)
    ring = torch.minimum(cell, span - 1 - cell) * _RINGS // span
    return border.sigmoid()[ring.clamp(max=3)]


def through(network: nn.Sequential, values: Tensor) -> Tensor:
    """Apply a small network layer by layer, without the overhead of calling modules.

    Args:
        network: of linear layers and GELU.
        values: `(..., inputs)`.

    Returns:
        `(..., outputs)`.
    """
    for layer in network:
        values = F.linear(values, layer.weight, layer.bias) if isinstance(layer, nn.Linear) else _gelu(values)
    return values


def _gelu(values: Tensor) -> Tensor:
    """Apply GELU to values that are not contiguous: torch gives those that are to oneDNN, whose call is slow."""
    if values.ndim == 1:
        # A vector cannot be transposed, but rows that are one in memory are not contiguous either.
        return F.gelu(values.expand(2, -1))[0]
    return F.gelu(values.mT).mT

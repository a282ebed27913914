"""Small networks of the evidence by magnification, and the maps of hints that are their inputs."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.belief.evidence import neighbourhood_peak
from semfov.sensor.lines import constant

STEPS = 3
"""Largest number of octaves between a look and the closer looks that are predicted from it."""

CROWD = 9
"""Side in cells of the square over which the networks read the mean of the strongest hints."""

_FLOOR = 1e-4


def features(scores: Tensor) -> Tensor:
    """Logarithms of scores, shifted and scaled to about [-1, 1.5]."""
    return (scores + _FLOOR).log().mul_(0.25).add_(1.5)


def hint_maps(own: Tensor, best: Tensor, detections: Tensor, size: Tensor, crowd: Tensor) -> list[Tensor]:
    """List the maps of one look: hints, detections and sizes of objects in and around each cell.

    Args:
        own: `(T, rows, columns)`, features of the strongest hint of each target.
        best: `(rows, columns)`, the same of any class.
        detections: `(T, rows, columns)`, whether a detection of the target is centred in the cell.
        size: `(rows, columns)`, as in `semfov.zoom.gist.Gist`.
        crowd: `(rows, columns)`, means of `best` over the square of `CROWD` cells about each cell.

    Returns:
        Eleven maps `(T, rows, columns)`.
    """

    def wide(values: Tensor) -> Tensor:
        return values.expand(own.shape)

    # One call for the peaks of both: after a pass of the detector a call costs more than the work in it.
    peak, near = neighbourhood_peak(torch.cat([own, detections]), 3).chunk(2)
    return [
        own,
        wide(best),
        peak,
        neighbourhood_peak(peak, 7),
        neighbourhood_mean(own, 5),
        wide(crowd),
        wide(size / 4 - 1),
        wide((size > 0).to(own)),
        detections,
        near,
        wide(own.amax((-1, -2), keepdim=True)),
    ]


def memory_maps(own: Tensor, before: Tensor | None) -> list[Tensor]:
    """What an earlier, coarser look predicted for each cell, and whether there was one, two maps like `own`."""
    prediction = torch.full_like(own, -1.0) if before is None else before / 4
    return [prediction, torch.full_like(own, float(before is not None))]


def tapered(border: Tensor, span: int) -> Tensor:
    """Weights `(span,)` of the cells along a side of a window, from four learned ones `(4,)` from border to middle."""
    cell = torch.arange(span, device=border.device)
    ring = torch.minimum(cell, span - 1 - cell) * 8 // span
    return border.sigmoid()[ring.clamp(max=3)]


def neighbourhood_mean(values: Tensor, side: int) -> Tensor:
    """Mean of maps `(T, rows, columns)` over the square about each cell; what lies beyond the map counts as 0."""
    # Products with banded matrices take a tenth of the time of `avg_pool2d`.
    down, across = (_band(length, side, values.dtype, values.device) for length in values.shape[-2:])
    return down @ values @ across


@constant
def _band(length: int, side: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix `(length, length)` whose product with a line takes the mean over `side` neighbours."""
    place = torch.arange(length, device=device)
    return ((place[:, None] - place).abs() <= side // 2).to(dtype) / side


def through(network: nn.Sequential, values: Tensor, outputs: slice | None = None) -> Tensor:
    """Compute selected outputs of a network without calls of modules, which cost most of the time in one so small."""
    last = len(network) - 1
    for place, layer in enumerate(network):
        if isinstance(layer, nn.Linear):
            if outputs is None or place < last:
                values = F.linear(values, layer.weight, layer.bias)
            else:
                values = F.linear(values, layer.weight[outputs], layer.bias[outputs])
        elif isinstance(layer, nn.GELU):
            values = _gelu(values)
        elif layer.training:  # dropout
            values = layer(values)
    return values


def _gelu(values: Tensor) -> Tensor:
    """GELU of transposed matrices and repeated vectors: torch gives contiguous arrays to oneDNN, whose call is slow."""
    return F.gelu(values.expand(2, -1))[0] if values.ndim == 1 else F.gelu(values.mT).mT


def small_network(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """A network of two hidden layers."""
    return nn.Sequential(
        nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU(), nn.Linear(width, outputs)
    )

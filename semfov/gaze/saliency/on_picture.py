"""Where a picture lies on a detector's feature maps, and the values of the maps at its cells."""

from collections.abc import Mapping
from math import ceil, floor
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.detection import FeatureMaps, Placement
from semfov.sensor.constants import constant


class Side(NamedTuple):
    """Position of the picture along one side of a map of `length` pixels.

    Attributes:
        start: its first edge, in pixels of the map.
        end: its last edge.
        first: first pixel that its interpolation needs.
        stop: pixel after the last one.
        length: number of pixels of the map.
    """

    start: float
    end: float
    first: int
    stop: int
    length: int


def sides_of(features: FeatureMaps | Mapping[str, Tensor], shape: tuple[int, int]) -> tuple[Side, Side]:
    """Compute the position of the picture in feature maps.

    Args:
        features: as for `FixationDensity.forward`; plain maps are of the whole picture.
        shape: `(h, w)` of the maps.

    Returns:
        The picture along the rows and along the columns, in pixels of the maps.
    """
    height, width = shape
    if not isinstance(features, FeatureMaps):
        return Side(0, height, 0, height, height), Side(0, width, 0, width, width)
    placement: Placement = features.placement
    sides = []
    for axis, length in ((1, height), (0, width)):
        stride = features.canvas[axis] / length
        start = placement.offset[axis] / stride
        end = start + placement.size[axis] * placement.scale[axis] / stride
        # Between its pixels' centres a map is interpolated: half a pixel beyond the picture is read, too.
        first = max(floor(start - 0.5), 0)
        stop = min(ceil(end + 0.5), length)
        sides.append(Side(start, end, first, stop, length))
    vertical, horizontal = sides
    return vertical, horizontal


def on_picture(
    values: Tensor, features: FeatureMaps | Mapping[str, Tensor], shape: tuple[int, int], cells: tuple[int, int]
) -> Tensor:
    """Interpolate feature maps at the centres of the picture's cells.

    Args:
        values: `(B, U, h, w)`, where the picture is.
        features: as for `FixationDensity.forward`.
        shape: `(h, w)` of the whole maps.
        cells: rows and columns of cells.

    Returns:
        `(B, U, rows, columns)`.
    """
    rows, columns = cells
    vertical, horizontal = sides_of(features, shape)
    if _interpolates(vertical, rows):
        values = _line(vertical, rows, values) @ values
    if _interpolates(horizontal, columns):
        values = values @ _line(horizontal, columns, values).mT
    return values


def _interpolates(side: Side, cells: int) -> bool:
    """Tell whether the cells are others than the pixels of the map."""
    return (side.start, side.end) != (0, side.length) or side.length != cells


def _line(side: Side, cells: int, like: Tensor) -> Tensor:
    """Make the matrix of `interpolation` for the pixels that it needs."""
    matrix = interpolation(cells, side.start, side.end, side.length, like.dtype, like.device)
    return matrix[:, side.first : side.stop]


@constant
def interpolation(
    cells: int, start: float, end: float, length: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Make the matrix of linear interpolation at the centres of cells.

    Args:
        cells: number of cells.
        start: first edge of the cells, in pixels of the line that is interpolated.
        end: their last edge.
        length: number of pixels of the line.
        dtype: of the matrix.
        device: of the matrix.

    Returns:
        `(cells, length)`, whose rows sum to 1.
    """
    centres = torch.arange(cells, device=device, dtype=dtype) + 0.5
    step = (end - start) / cells
    place = (start + centres * step - 0.5).clamp(0, length - 1)
    pixels = torch.arange(length, device=device, dtype=dtype)
    distance = (place[:, None] - pixels).abs()  # (cells, length)
    return (1 - distance).clamp(min=0)

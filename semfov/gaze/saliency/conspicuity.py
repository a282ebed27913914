"""Fusion of many maps of several sizes into one."""

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.errors import check, check_shape, lookup
from semfov.gaze.saliency.blur import enlarge

Fusion = Literal["mean", "max"]


def combine_maps(maps: Sequence[Tensor], size: tuple[int, int], fusion: Fusion = "mean") -> Tensor:
    """Mean or maximum of all maps, each enlarged to `size` by cubic interpolation.

    Shapes: maps `(B, N, h, w)`, size `(height, width)` → `(B, height, width)`.
    """
    lookup(fusion, get_args(Fusion), "fusion")
    check(len(maps) > 0, "maps", "at least one tensor", 0)
    for layer in maps:
        check_shape(layer, "maps", maps[0].shape[0], maps[0].shape[1], None, None)
    if fusion == "mean":
        # Interpolation is linear, so the mean of each size can be taken before it is enlarged.
        enlarged = (enlarge(layer.mean(1), size) for layer in maps)
        return sum(enlarged, next(enlarged)) / len(maps)
    return torch.stack([enlarge(layer, size).amax(1) for layer in maps]).amax(0)


def rescale(saliency: Tensor, flat: float = 0.0) -> Tensor:
    """Shift and scale maps to [0, 1]; saliency `(..., H, W)`."""
    low, high = saliency.amin((-2, -1), keepdim=True), saliency.amax((-2, -1), keepdim=True)
    span = high - low
    # Division by infinity sets a flat map to 0, and its gradient too.
    return (saliency - low) / torch.where(span > flat, span, torch.inf)

"""Many maps of several sizes into one."""

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.errors import check, check_shape, lookup
from semfov.gaze.saliency.blur import enlarge

Fusion = Literal["mean", "max"]


def fuse(maps: Sequence[Tensor], size: tuple[int, int], fusion: Fusion = "mean") -> Tensor:
    """Arithmetic mean or largest value of all maps, each enlarged to `size` by cubic interpolation.

    Fusing within and then across features comes to the same, as every feature has as many maps.

    Args:
        maps: for each size of map `(B, N, h, w)`, with the same N.
        size: `(height, width)` of the result.
        fusion: `mean` or `max`.

    Returns:
        `(B, height, width)`.

    >>> fuse([torch.ones(1, 2, 4, 6), torch.zeros(1, 2, 2, 3)], (4, 6)).mean()
    tensor(0.5000)
    """
    lookup(fusion, get_args(Fusion), "fusion")
    check(len(maps) > 0, "maps", "at least one", 0)
    for layer in maps:
        check_shape(layer, "maps", maps[0].shape[0], maps[0].shape[1], None, None)
    if fusion == "mean":
        # Interpolation is linear: of each size only the mean is enlarged.
        enlarged = (enlarge(layer.mean(1), size) for layer in maps)
        return sum(enlarged, next(enlarged)) / len(maps)
    return torch.stack([enlarge(layer, size).amax(1) for layer in maps]).amax(0)


def rescale(saliency: Tensor, flat: float = 0.0) -> Tensor:
    """Shift and scale maps `(..., H, W)` to [0, 1]; a map whose range is at most `flat` gives 0.

    >>> rescale(torch.tensor([[1.0, 3.0], [2.0, 1.0]]))
    tensor([[0.0000, 1.0000],
            [0.5000, 0.0000]])
    """
    low, high = saliency.amin((-2, -1), keepdim=True), saliency.amax((-2, -1), keepdim=True)
    span = high - low
    # Infinity rather than 1: nothing is left of a flat map, nor of its gradient.
    return (saliency - low) / torch.where(span > flat, span, torch.inf)

"""Small networks of the evidence by magnification, the maps of hints that they read, and the survey of all objects."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.belief.evidence import neighbourhood_peak
from semfov.io.schema import Field, Number, Object, perceptron
from semfov.sensor.lines import constant
from semfov.zoom.hints import Gist

STEPS = 3
"""Largest number of octaves between a look and the closer looks that are predicted from it."""

CROWD = 9
"""Side in cells of the square over which the networks read the mean of the strongest hints."""

_FLOOR = 1e-4

_CHANNELS, _WIDTH = 8, 48
_HINTS, _MEMORY = 11, 2
_NEAR, _WIDE = 5, (CROWD, 17)
"""Sides in cells of the squares over which sums of hints are averaged: the neighbours, and the surroundings."""
_INPUTS = _HINTS + _MEMORY + 2 * _CHANNELS + len(_WIDE) * (_CHANNELS + 2)
_LOWEST = -0.8
"""About the feature of a score of 0."""
_LARGEST = 1e6


def features(scores: Tensor) -> Tensor:
    """Logarithms of scores, shifted and scaled to about [-1, 1.5]."""
    return (scores + _FLOOR).log().mul_(0.25).add_(1.5)


def hint_maps(own: Tensor, best: Tensor, detections: Tensor, size: Tensor, crowd: Tensor) -> list[Tensor]:
    """List the maps of one look: hints, detections and sizes of objects in and around each cell.

    Shapes: own `(T, rows, columns)`, best `(rows, columns)`, detections `(T, rows, columns)`, size `(rows, columns)`,
    crowd `(rows, columns)` → `(T, rows, columns)`.
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


class Survey(nn.Module):
    r"""Predicts how many objects of any class closer looks find that a look did not.

    The expected number in a part w of the window is a sum over its cells. Its weights fall off towards the border of w,
    which cuts objects that lie there:

    .. math:: E[n(w)] = \sum_{x \in w} r(x) \lambda(x)

    The rate λ is a network over the hints about a cell. Which classes these are matters, because some come in numbers.
    The network therefore reads, besides the strongest hint, a few sums over the hints of all classes with learned
    weights, in the cell itself and averaged over its neighbours.
    """

    def __init__(self, classes: int, *, foresight: float = 0.35) -> None:
        super().__init__()
        self.foresight = foresight
        self.mix = nn.Linear(classes, _CHANNELS, bias=False)
        nn.init.normal_(self.mix.weight, std=0.3)
        self.rate = small_network(_INPUTS, _WIDTH, STEPS)
        self.border = nn.Parameter(torch.tensor([0.0, 1.0, 2.0, 2.0]))

    def rates(self, look: Gist, targets: Tensor | None = None, before: Tensor | None = None) -> Tensor:
        """Predict how many objects centred in each cell closer looks find that this look did not.

        Shapes: targets `(1,)`, before `(1, rows, columns)` → `(1, 3, rows, columns)`.
        """
        hints, best = features(look.scores), features(look.best)
        # torch takes twice as long for `any` of booleans, and for a matrix of few columns on the right.
        detections = look.found.to(best).amax(-1)
        mix = self.mix.weight
        kinds = torch.addmm(-_LOWEST * mix.sum(1, keepdim=True), mix, hints.flatten(0, 1).mT).unflatten(1, best.shape)
        around = torch.cat([kinds, best[None], detections[None]])
        surroundings = [neighbourhood_mean(around, side) for side in _WIDE]
        crowd = surroundings[_WIDE.index(CROWD)][_CHANNELS]
        best_maps = [*hint_maps(best[None], best, detections[None], look.size, crowd), *memory_maps(best[None], before)]
        maps = torch.cat([*best_maps, kinds, neighbourhood_mean(kinds, _NEAR), *surroundings])
        value = through(self.rate, maps.movedim(0, -1)) - 6
        return value.clamp(max=3).movedim(-1, 0)[None]

    def taper(self, span: int) -> Tensor:
        """Weights r of the cells along a side of a window; objects at its border are cut; → `(span,)`."""
        return tapered(self.border, span)


def survey_fields() -> dict[str, Field]:
    """Tensors of a survey in a file, K classes."""
    return {
        "survey.mix.weight": Field((_CHANNELS, "K"), low=-_LARGEST, high=_LARGEST),
        **perceptron("survey.rate", _INPUTS, _WIDTH, STEPS),
        "survey.border": Field((4,), low=-1e3, high=1e3),
    }


SURVEY = Object({"foresight": Number(0, 1)})
"""Settings of a survey in a file."""

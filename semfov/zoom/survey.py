"""Survey of a picture: how many objects of any class closer looks find."""

import torch
from torch import Tensor, nn

from semfov.io.schema import Field, Number, Object, perceptron
from semfov.zoom.gist import Gist
from semfov.zoom.networks import (
    CROWD,
    STEPS,
    features,
    hint_maps,
    memory_maps,
    neighbourhood_mean,
    small_network,
    tapered,
    through,
)

_CHANNELS, _WIDTH = 8, 48
_HINTS, _MEMORY = 11, 2
_NEAR, _WIDE = 5, (CROWD, 17)
"""Sides in cells of the squares over which sums of hints are averaged: the neighbours, and the surroundings."""
_INPUTS = _HINTS + _MEMORY + 2 * _CHANNELS + len(_WIDE) * (_CHANNELS + 2)
_LOWEST = -0.8
"""About the feature of a score of 0."""
_LARGEST = 1e6


class Survey(nn.Module):
    r"""Predicts how many objects of any class closer looks find that a look did not.

    The expected number in a part w of the window is a sum over its cells. Its weights fall off towards the border of w,
    which cuts objects that lie there:

    .. math:: E[n(w)] = \sum_{x \in w} r(x) \lambda(x)

    The rate λ is a network over the hints about a cell. Which classes these are matters, because some come in numbers.
    The network therefore reads, besides the strongest hint, a few sums over the hints of all classes with learned
    weights, in the cell itself and averaged over its neighbours.

    Args:
        classes: number of classes of the detector, without background.
        foresight: share of what still closer looks would find in a window that counts towards its value.

    >>> survey = Survey(3)
    >>> look = Gist(0, (0, 0), 1, torch.rand(8, 8, 3), torch.rand(8, 8), torch.zeros(8, 8, 3, dtype=torch.bool))
    >>> survey.rates(look, torch.tensor([0])).shape
    torch.Size([1, 3, 8, 8])
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

        Args:
            look: the look.
            targets: `(1,)`, 0 for any class; there is no other.
            before: `(1, rows, columns)`, logarithms of the rates that an earlier, coarser look gave for looks one
                octave closer than this one; None for a first look.

        Returns:
            `(1, 3, rows, columns)`, logarithms of the expected numbers, for looks one, two and three octaves closer.
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
        """Weights r of the cells along a side of a window; objects at its border are cut.

        Args:
            span: number of cells along the side.

        Returns:
            `(span,)`, from 0 to 1.
        """
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

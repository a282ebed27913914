"""The survey: how many objects of any class looks at smaller windows find."""

import torch
from torch import Tensor, nn

from semfov.io.schema import Field, perceptron
from semfov.zoom.hint_maps import (
    CROWD,
    HINT_MAPS,
    LOWEST,
    MEMORY_MAPS,
    features,
    hint_maps,
    memory_maps,
    neighbourhood_mean,
    tapered,
    through,
)
from semfov.zoom.hints import Gist
from semfov.zoom.networks import network

STEPS = 3  # largest number of octaves between a look and the looks at smaller windows that are predicted from it

_CHANNELS = 8  # kinds of hints, learned mixtures of all classes
_WIDTH = 48
_CLOSE = 5  # side in cells of the square over which the kinds of hints of the neighbours are averaged
_SURROUNDINGS = (CROWD, 17)  # the same for the surroundings: kinds of hints, strongest hints and detections
_INPUTS = HINT_MAPS + MEMORY_MAPS + 2 * _CHANNELS + len(_SURROUNDINGS) * (_CHANNELS + 2)


class Survey(nn.Module):
    r"""Predicts how many objects of any class smaller windows show, :math:`E[n(w)] = \sum_{x \in w} r(x) \lambda(x)`.

    Args:
        classes: number of classes of the detector, without background.
        foresight: weight of the objects that smaller windows inside a window would show, in the value of the window.
    """

    def __init__(self, classes: int, *, foresight: float = 0.35) -> None:
        super().__init__()
        self.foresight = foresight
        self.mix = nn.Linear(classes, _CHANNELS, bias=False)
        nn.init.normal_(self.mix.weight, std=0.3)
        self.rate = network(_INPUTS, _WIDTH, STEPS)
        self.border = nn.Parameter(torch.tensor([0.0, 1.0, 2.0, 2.0]))

    @staticmethod
    def fields() -> dict[str, Field]:
        """List the requirements for the tensors in a file of the model, by name."""
        return {
            "mix.weight": Field((_CHANNELS, "K"), low=-1e6, high=1e6),
            **perceptron("rate", _INPUTS, _WIDTH, STEPS),
            "border": Field((4,), low=-1e3, high=1e3),
        }

    def rates(self, look: Gist, targets: Tensor | None = None, before: Tensor | None = None) -> Tensor:
        """Predict how many objects centred in each cell only smaller windows show.

        Args:
            look: the look.
            targets: not used; objects of any class count.
            before: `(1, rows, columns)`, logarithms of the rates that an earlier, coarser look gave for looks one
                octave closer than this one; None for a first look.

        Returns:
            `(1, 3, rows, columns)`, logarithms of the expected numbers, for looks one, two and three octaves closer.
        """
        hints = features(look.scores)
        best = features(look.best)
        # torch takes twice as long for `any` of booleans, and for a matrix of few columns on the right.
        detections = look.found.to(best).amax(-1)
        mix = self.mix.weight
        # Counted from the feature of a score of 0: cells without hints are nearly 0, as those beyond the map.
        kinds = torch.addmm(-LOWEST * mix.sum(1, keepdim=True), mix, hints.flatten(0, 1).mT).unflatten(1, best.shape)
        around = torch.cat([kinds, best[None], detections[None]])
        surroundings = [neighbourhood_mean(around, side) for side in _SURROUNDINGS]
        crowd = surroundings[_SURROUNDINGS.index(CROWD)][_CHANNELS]  # the mean of `best`
        maps = [
            *hint_maps(best[None], best, detections[None], look.size, crowd),
            *memory_maps(best[None], before),
            kinds,
            neighbourhood_mean(kinds, _CLOSE),
            *surroundings,
        ]
        value = through(self.rate, torch.cat(maps).movedim(0, -1)) - 6
        return value.clamp(max=3).movedim(-1, 0)[None]

    def taper(self, span: int) -> Tensor:
        """Weigh the cells along a side of a window, r; objects at its border are cut.

        Args:
            span: number of cells along the side.

        Returns:
            `(span,)`, from 0 to 1.
        """
        return tapered(self.border, span)

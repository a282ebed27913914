"""Learned evidence: what one look says of a class in a cell, and what all looks together say."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.belief.look_features import FEATURES, nothing_seen
from semfov.io.pretrained import PretrainedForEye

READOUT = 14
"""What the looks say of a cell, as numbers for a network."""

# Looks from farther than this, in longer sides of the image, count e times less in the mean of all.
_REACH = 1 / 6


@dataclass(frozen=True)
class Gathered:
    """What all looks of an episode so far say of a class.

    Attributes:
        nearest: `(B, X·Y)`, evidence of the closest look at each cell.
        best: `(B, X·Y)`, strongest evidence of any look.
        mean: `(B, X·Y)`, mean evidence of all looks, those from near counting more.
        distance: `(B, X·Y)`, of the closest look, in longer sides of the image.
        score: `(B,)`, highest score of the class in any detection.
        looks: `(B,)`, how many there were.
        visited: `(B, X·Y)` boolean, cells that were fixated.
        target: `(B,)`, the class.
    """

    nearest: Tensor
    best: Tensor
    mean: Tensor
    distance: Tensor
    score: Tensor
    looks: Tensor
    visited: Tensor
    target: Tensor


class Evidence(PretrainedForEye):
    r"""Base of learned evidence for a class: a network for one look, and one that reads several.

    Kaplan's rule takes looks for independent. Looks at a static scene are not: a blurred, wrong
    detection repeats itself and buries an object for good. Here a cell keeps the evidence of its closest look, and
    a small network weighs it together with the strongest evidence of any look, with the mean of all, and with what
    stands around the cell. A look that shows nothing is evidence too: much at the fovea, little far out.

    .. math:: e_f(x) = g(\phi_f(x)), \qquad
              \operatorname{logit} P(k \in x \mid f_1 \ldots f_n) = e_{f^*(x)}(x) + h(\cdot), \qquad
              f^*(x) = \arg\min_i d(x, f_i)

    with φ of `look_features`, and g and h networks of two hidden layers. The evidence depends on the class through its
    score and through a prior, one number for each class.

    Args:
        look_width: hidden units of g.
        readout_width: hidden units of h.
        components: classes of the detector, background included.
        more: numbers that h reads beyond `READOUT`.
        metadata: JSON values kept with the model: `detector` and `sensor` (settings it was trained for).
    """

    def __init__(
        self,
        look_width: int,
        readout_width: int,
        *,
        components: int,
        more: int = 0,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.widths = look_width, readout_width
        self.metadata = dict(metadata or {})
        self.look = network(FEATURES, look_width)
        self.read = network(READOUT + more, readout_width)
        self.prior = nn.Parameter(torch.zeros(components))

    def evidence(self, features: Tensor) -> Tensor:
        """Evidence `(...)` from features `(..., 10)`."""
        value: Tensor = self.look(features)
        return value[..., 0]

    def unseen(self, like: Tensor) -> Tensor:
        """Evidence `()` of a look from a whole longer side away that shows nothing; dtype and device as `like`."""
        return self.evidence(nothing_seen(like.new_ones(1)))[0]

    def read_out(self, reader: nn.Module, nearest: Tensor, gathered: Gathered, columns: int, *more: Tensor) -> Tensor:
        """`nearest` corrected by a network that reads all that was gathered, `(B, X·Y)`."""
        odds = nearest.sigmoid()
        rows = nearest.shape[-1] // columns
        row = torch.linspace(-1, 1, rows).to(nearest).repeat_interleave(columns) if rows > 1 else nearest.new_zeros(1)
        column = torch.linspace(-1, 1, columns).to(nearest).repeat(rows) if columns > 1 else nearest.new_zeros(1)
        inputs = [
            nearest / 2 + 1,
            gathered.best / 2 + 1,
            gathered.mean / 2 + 1,
            4 * gathered.distance,
            logarithm(blur(odds, columns, 0.6)),
            logarithm(blur(odds, columns, 1.5)),
            _peak(nearest, columns) / 2 + 1,
            nearest.amax(-1, keepdim=True) / 2,
            gathered.best.amax(-1, keepdim=True) / 2,
            logarithm(odds.sum(-1, keepdim=True)),
            row.square() + column.square(),
            row,
            gathered.looks[:, None].log() / 2,
            self.prior[gathered.target, None],
            *more,
        ]
        value: Tensor = reader(torch.stack([each.expand_as(nearest) for each in inputs], -1))
        return nearest + value[..., 0]


def network(inputs: int, width: int) -> nn.Sequential:
    """Two hidden layers, one number out."""
    return nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1))


def nearness(distance: Tensor) -> Tensor:
    """How much looks from a distance, in longer sides of the image, count in the mean of all."""
    return (-distance / _REACH).exp()


def farther(keep: float) -> float:
    """How much farther away a look is, in longer sides of the image, whose nearness is `keep` times as great."""
    return -math.log(keep) * _REACH


def logarithm(odds: Tensor) -> Tensor:
    """Of probabilities or odds, kept finite and scaled to about unit size."""
    return (odds + 1e-3).log() / 2 + 1


def blur(values: Tensor, columns: int, sigma: float) -> Tensor:
    """Gaussian average over the neighbourhood, σ in cells; what lies outside the grid counts as 0."""
    steps = torch.arange(-3, 4).to(values)
    kernel = (-steps.square() / (2 * sigma**2)).exp()
    kernel = kernel / kernel.sum()
    grid = values.unflatten(-1, (-1, columns))[:, None]
    across = F.conv2d(grid, kernel[None, None, None], padding=(0, 3))
    return F.conv2d(across, kernel[None, None, :, None], padding=(3, 0))[:, 0].flatten(1)


def _peak(values: Tensor, columns: int) -> Tensor:
    """Largest value within one cell's distance."""
    return F.max_pool2d(values.unflatten(-1, (-1, columns))[:, None], 3, 1, 1)[:, 0].flatten(1)

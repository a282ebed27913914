"""Learned evidence for a class in a cell: a network for a single look, and one for all looks together."""

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.belief.look_features import LOOK_FEATURES, nothing_seen
from semfov.io.pretrained import PretrainedForEye
from semfov.sensor.constants import constant

READOUT = 14  # number of inputs that describe a cell after several looks

# Distance between fixation and cell, in longer sides of the image, over which the weight of a look falls by a factor e.
_REACH = 1 / 6


class Gathered(NamedTuple):
    """Evidence about one class from all looks so far: score, looks and target `(B,)`, the others `(B, X·Y)`."""

    nearest: Tensor
    best: Tensor
    mean: Tensor
    distance: Tensor
    score: Tensor
    looks: Tensor
    visited: Tensor
    target: Tensor


class Evidence(PretrainedForEye):
    r"""Base of learned evidence for a class: one network g for a single look, and one h for all looks together.

    Looks at a static scene are not independent, as Kaplan's rule takes them. A cell keeps the evidence of its closest
    look, corrected by that of all looks and of its neighbourhood. φ are the features of `look_features`.

    .. math:: e_f(x) = g(\phi_f(x)), \qquad
              \operatorname{logit} P(k \in x \mid f_1 \ldots f_n) = e_{f^*(x)}(x) + h(\cdot), \qquad
              f^*(x) = \arg\min_i d(x, f_i)
    """

    def __init__(
        self,
        look_width: int,
        readout_width: int,
        *,
        components: int,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.widths = look_width, readout_width
        self.metadata = dict(metadata or {})
        self.look = network(LOOK_FEATURES, look_width)
        self.read = network(READOUT, readout_width)
        self.prior = nn.Parameter(torch.zeros(components))

    def _record(self) -> dict[str, Any]:
        """List what a file holds beside tensors."""
        return {"widths": self.widths, "components": len(self.prior)}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """Make the model of a file."""
        model = cls(*record["widths"], components=record["components"], metadata=record["metadata"])
        model.load_state_dict(tensors)
        return model

    def evidence(self, features: Tensor) -> Tensor:
        """Compute the evidence of looks, log odds `(...)`, from their features `(..., 10)` (`look_features`)."""
        return self.look(features)[..., 0]

    def unseen(self, like: Tensor) -> Tensor:
        """Compute the evidence of a look from one longer side away without detections, log odds `()`."""
        return self.evidence(nothing_seen(like.new_ones(1)))[0]

    def read_out(self, reader: nn.Module, nearest: Tensor, gathered: Gathered, columns: int, *more: Tensor) -> Tensor:
        """Correct the evidence of the closest looks by a network that reads all gathered evidence.

        Args:
            reader: the network, of `READOUT` inputs and those in `more`.
            nearest: `(B, X·Y)`, log odds of each cell from its closest look.
            gathered: evidence of all looks.
            columns: X, cells in a row.
            more: further inputs, `(B, X·Y)` or `(B, 1)`.

        Returns:
            `(B, X·Y)`, log odds.
        """
        # Sums over a neighbourhood are of probabilities: log odds far below 0 would drown a likely cell.
        odds = nearest.sigmoid()
        eccentricity, row = _places(columns, nearest.shape[-1] // columns, nearest.dtype, nearest.device)
        # Each input has about unit size, with which the network is trained from its usual random start.
        inputs = [
            nearest / 2 + 1,
            gathered.best / 2 + 1,
            gathered.mean / 2 + 1,
            4 * gathered.distance,
            logarithm(blur(odds, columns, 0.6)),
            logarithm(blur(odds, columns, 1.5)),
            neighbourhood_peak(nearest.unflatten(-1, (-1, columns)), 3).flatten(1) / 2 + 1,
            nearest.amax(-1, keepdim=True) / 2,
            gathered.best.amax(-1, keepdim=True) / 2,
            logarithm(odds.sum(-1, keepdim=True)),
            eccentricity,
            row,
            gathered.looks[:, None].log() / 2,
            self.prior[gathered.target, None],
            *more,
        ]
        return nearest + apply_network(reader, inputs, nearest.shape)


def apply_network(network: nn.Module, inputs: Sequence[Tensor], shape: torch.Size) -> Tensor:
    """Apply a network with one output to its inputs, one tensor each, broadcast to `shape`."""
    # Each input is copied in one piece, and the matrix product reads the table transposed. To interleave the inputs
    # takes longer than the product.
    table = torch.stack([values.expand(shape) for values in inputs]).flatten(1)
    return network(table.mT).view(shape)


def network(inputs: int, width: int, outputs: int = 1) -> nn.Sequential:
    """Make a network with two hidden layers of `width` units."""
    hidden = nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU()
    return nn.Sequential(*hidden, nn.Linear(width, outputs))


def nearness(distance: Tensor) -> Tensor:
    """Weight a look from a distance d, in longer sides of the image, in the mean of all looks: e^(-d/R)."""
    return (-distance / _REACH).exp()


def farther(keep: float) -> float:
    """Compute the increase of the distance, in longer sides of the image, that multiplies `nearness` by `keep`."""
    # Evidence that has faded to nothing is very far away, not infinitely: a distance of infinity is no look at all.
    return -math.log(max(keep, sys.float_info.min)) * _REACH


def logarithm(odds: Tensor) -> Tensor:
    """Take the logarithm of probabilities or odds, kept finite and scaled to about unit size."""
    return (odds + 1e-3).log() / 2 + 1


def blur(values: Tensor, columns: int, sigma: float) -> Tensor:
    """Average maps over the neighbourhood of each cell, with Gaussian weights; cells outside the grid count as 0.

    Args:
        values: `(B, X·Y)`.
        columns: X, cells in a row.
        sigma: σ of the weights, in cells.

    Returns:
        `(B, X·Y)`.
    """
    rows = values.shape[-1] // columns
    along_rows = _averages(columns, sigma, values.dtype, values.device)
    along_columns = _averages(rows, sigma, values.dtype, values.device)
    # One product for the lines of all maps: a convolution of one channel takes eight times as long.
    blurred = along_rows.mT @ values.reshape(-1, columns).mT
    lines = blurred.unflatten(-1, (-1, rows)).transpose(0, 1).reshape(-1, rows)
    return (along_columns.mT @ lines.mT).unflatten(-1, (-1, columns)).transpose(0, 1).flatten(1)


@constant
def _averages(length: int, sigma: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Make the matrix `(length, length)` whose product with a line is its Gaussian average over seven cells."""
    steps = torch.arange(-3, 4, device=device).to(dtype)
    kernel = (-steps.square() / (2 * sigma**2)).exp()
    kernel = kernel / kernel.sum()
    cell = torch.arange(length, device=device)
    step = cell - cell[:, None]
    return torch.where(step.abs() <= 3, kernel[(step + 3).clamp(0, 6)], 0.0)


@constant
def _places(columns: int, rows: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Place the cells where both sides run from -1 to 1.

    Args:
        columns: X, cells in a row.
        rows: Y, cells in a column.
        dtype: dtype of the results.
        device: device of the results.

    Returns:
        Squared distance of each cell from the centre, and its height, `(X·Y,)`.
    """
    x = _line(columns, dtype, device).repeat(rows)
    y = _line(rows, dtype, device).repeat_interleave(columns)
    return y.square() + x.square(), y


def _line(length: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Place cells evenly from -1 to 1, a single one at 0, `(length,)`."""
    if length == 1:
        return torch.zeros(1, dtype=dtype, device=device)
    return torch.linspace(-1, 1, length).to(device, dtype)


def neighbourhood_peak(values: Tensor, side: int) -> Tensor:
    """Find the largest value in the square of `side` cells about each cell of maps `(T, rows, columns)`."""
    # One axis after the other: fewer comparisons.
    peaks = F.max_pool1d(values, side, 1, side // 2)
    return F.max_pool1d(peaks.mT, side, 1, side // 2).mT

"""Learned evidence for a target: what one look says of a cell, and what all looks so far say together."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.belief.look_features import FEATURES, look_features
from semfov.detection.detections import Detections
from semfov.errors import check_shape
from semfov.io.pretrained import PretrainedForEye

_READOUT = 11


class TargetEvidence(PretrainedForEye):
    r"""Log odds that a cell holds the target, learned from looks at photographs with boxes.

    Kaplan's rule takes looks for independent. Looks at a static scene are not: a blurred, wrong
    detection repeats itself and buries the target for good. Here a cell keeps the evidence of its closest look, and a
    small network, trained on whole series of looks, weighs it together with the strongest evidence of any look and with
    the neighbouring cells. A look that shows nothing is evidence too: much at the fovea, little far out.

    .. math:: e_f(x) = g(\phi_f(x)), \qquad
              \operatorname{logit} P(t \in x \mid f_1 \ldots f_n) = e_{f^*(x)}(x) + h\bigl(e_{f^*}, \max_i e_{f_i},
              d(x, f^*)\bigr), \quad f^*(x) = \arg\min_i d(x, f_i)

    with φ of `look_features`, and g and h networks of two hidden layers; h also sees what stands around the cell.

    The evidence depends on the class only through its score, so one model serves all classes of a detector.

    Args:
        look_width: hidden units of g.
        readout_width: hidden units of h.
        metadata: JSON values kept with the model: `detector` and `sensor` (settings it was trained for).
    """

    kind: ClassVar[str] = "target-evidence"
    title: ClassVar[str] = "model of target evidence"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"

    def __init__(
        self, look_width: int = 48, readout_width: int = 16, *, metadata: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        self.widths = look_width, readout_width
        self.metadata = dict(metadata or {})
        self.look = _network(FEATURES, look_width)
        self.read = _network(_READOUT, readout_width)

    def forward(self, detections: Detections, fixation: Tensor, grid: Grid, target: int) -> Tensor:
        """Evidence of each look, `(B, X·Y)`; arguments as for `look_features`."""
        return self.evidence(look_features(detections, fixation, grid, target))

    def evidence(self, features: Tensor) -> Tensor:
        """Evidence `(...)` from features `(..., 10)`."""
        value: Tensor = self.look(features)
        return value[..., 0]

    def log_odds(self, nearest: Tensor, best: Tensor, distance: Tensor, visited: Tensor, columns: int) -> Tensor:
        """Log odds of the target in each cell after several looks, `(B, X·Y)`.

        Args:
            nearest: `(B, X·Y)`, evidence of the closest look at each cell.
            best: `(B, X·Y)`, strongest evidence of any look.
            distance: `(B, X·Y)`, of the closest look.
            visited: `(B, X·Y)` boolean, cells that were fixated: the search would have ended there on the target.
            columns: cells in a row.
        """
        check_shape(best, "best", *nearest.shape)
        nearest = nearest.masked_fill(visited, -8.0)
        odds = nearest.sigmoid()
        rows = nearest.shape[-1] // columns
        row = torch.linspace(-1, 1, rows).to(nearest).repeat_interleave(columns) if rows > 1 else nearest.new_zeros(1)
        column = torch.linspace(-1, 1, columns).to(nearest).repeat(rows) if columns > 1 else nearest.new_zeros(1)
        inputs = [
            nearest / 2 + 1,
            best / 2 + 1,
            4 * distance,
            _log(_blur(odds, columns, 0.6)),
            _log(_blur(odds, columns, 1.5)),
            _peak(nearest, columns) / 2 + 1,
            nearest.amax(-1, keepdim=True).expand_as(nearest) / 2,
            _log(odds.sum(-1, keepdim=True)).expand_as(nearest),
            _blur(visited.to(nearest), columns, 0.6),
            (row.square() + column.square()).expand_as(nearest),
            row.expand_as(nearest),
        ]
        value: Tensor = self.read(torch.stack(inputs, -1))
        return nearest + value[..., 0]

    def _record(self) -> dict[str, Any]:
        """Widths of both networks."""
        return {"widths": self.widths}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The networks from what was kept."""
        model = cls(*record["widths"], metadata=record["metadata"])
        model.load_state_dict(tensors)
        return model


def _network(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1))


def _log(odds: Tensor) -> Tensor:
    return (odds + 1e-3).log() / 2 + 1


def _peak(values: Tensor, columns: int) -> Tensor:
    """Largest value within one cell's distance."""
    return F.max_pool2d(values.unflatten(-1, (-1, columns))[:, None], 3, 1, 1)[:, 0].flatten(1)


def _blur(values: Tensor, columns: int, sigma: float) -> Tensor:
    """Gaussian average over the neighbourhood, σ in cells; what lies outside the grid counts as 0."""
    steps = torch.arange(-3, 4).to(values)
    kernel = (-steps.square() / (2 * sigma**2)).exp()
    kernel = kernel / kernel.sum()
    grid = values.unflatten(-1, (-1, columns))[:, None]
    across = F.conv2d(grid, kernel[None, None, None], padding=(0, 3))
    return F.conv2d(across, kernel[None, None, :, None], padding=(3, 0))[:, 0].flatten(1)

"""Learned evidence for a target: what one look says of a cell, what all looks say of it, and of the whole image."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.belief.look_features import FEATURES, look_features
from semfov.detection.detections import Detections
from semfov.io.pretrained import PretrainedForEye

_READOUT = 14
_PRESENCE = 9
# Log odds of a cell that does not hold the target.
_EMPTY = -8.0


@dataclass(frozen=True)
class Thresholds:
    """Probabilities at which a search decides.

    Attributes:
        confirm: that the image holds the target, from which on it is found, once the most probable cell was fixated.
        give_up: that a cell not fixated yet holds the target; where none reaches it, no look is worth its price.
    """

    confirm: float
    give_up: float


@dataclass(frozen=True)
class Gathered:
    """What all looks of an episode so far say of a target.

    Attributes:
        nearest: `(B, X·Y)`, evidence of the closest look at each cell.
        best: `(B, X·Y)`, strongest evidence of any look.
        mean: `(B, X·Y)`, mean evidence of all looks, those from near counting more.
        distance: `(B, X·Y)`, of the closest look, in longer sides of the image.
        score: `(B,)`, highest score of the target in any detection.
        looks: `(B,)`, how many there were.
        visited: `(B, X·Y)` boolean, cells that were fixated.
        target: `(B,)`, class that is searched for.
    """

    nearest: Tensor
    best: Tensor
    mean: Tensor
    distance: Tensor
    score: Tensor
    looks: Tensor
    visited: Tensor
    target: Tensor


class TargetEvidence(PretrainedForEye):
    r"""Probability that a cell, and the image, holds the target: learned from looks at photographs with boxes.

    Kaplan's rule takes looks for independent. Looks at a static scene are not: a blurred, wrong
    detection repeats itself and buries the target for good. Here a cell keeps the evidence of its closest look, and
    small networks, trained on the looks of whole searches, weigh it together with the strongest evidence of any look,
    with the mean of all, and with what stands around the cell. A look that shows nothing is evidence too: much at the
    fovea, little far out.

    .. math:: e_f(x) = g(\phi_f(x)), \qquad
              \operatorname{logit} P(t \in x \mid f_1 \ldots f_n) = e_{f^*(x)}(x) + h(\cdot), \qquad
              \operatorname{logit} P(t \mid f_1 \ldots f_n) = \max_x \operatorname{logit} P(t \in x) + j(\cdot),
              \quad f^*(x) = \arg\min_i d(x, f_i)

    with φ of `look_features`, and g, h and j networks of two hidden layers. All looks count, those at the target and
    those at cells that do not hold it: what is fixated is known best. Where to look next is another question: a search
    goes on because no fixated cell holds the target, and a network like h tells the odds of that case (`chance`).

    The evidence depends on the class through its score and through a prior, one number for each class.

    Args:
        look_width: hidden units of g.
        readout_width: hidden units of h and of j.
        components: classes of the detector, background included.
        thresholds: at which searches decide; None where none were chosen.
        metadata: JSON values kept with the model: `detector` and `sensor` (settings it was trained for).
    """

    kind: ClassVar[str] = "target-evidence"
    title: ClassVar[str] = "model of target evidence"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"

    def __init__(
        self,
        look_width: int = 48,
        readout_width: int = 24,
        *,
        components: int = 81,
        thresholds: Thresholds | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.widths = look_width, readout_width
        self.thresholds = thresholds
        self.metadata = dict(metadata or {})
        self.look = _network(FEATURES, look_width)
        self.read = _network(_READOUT, readout_width)
        self.guide = _network(_READOUT + 1, readout_width)
        self.judge = _network(_PRESENCE, readout_width)
        self.prior = nn.Parameter(torch.zeros(components))

    def forward(self, detections: Detections, fixation: Tensor, grid: Grid, target: int) -> Tensor:
        """Evidence of each look, `(B, X·Y)`; arguments as for `look_features`."""
        return self.evidence(look_features(detections, fixation, grid, target))

    def evidence(self, features: Tensor) -> Tensor:
        """Evidence `(...)` from features `(..., 10)`."""
        value: Tensor = self.look(features)
        return value[..., 0]

    def log_odds(self, gathered: Gathered, columns: int) -> Tensor:
        """Log odds of the target in each cell after several looks, `(B, X·Y)`.

        Args:
            gathered: what the looks say.
            columns: cells in a row.
        """
        return self._read(self.read, gathered.nearest, gathered, columns)

    def chance(self, gathered: Gathered, columns: int) -> Tensor:
        """Log odds of the target in each cell if no fixated cell holds it, `(B, X·Y)`; arguments as for `log_odds`."""
        visited = gathered.visited
        beside = _blur(visited.to(gathered.nearest), columns, 0.6)
        return self._read(self.guide, gathered.nearest.masked_fill(visited, _EMPTY), gathered, columns, beside)

    def _read(self, network: nn.Module, nearest: Tensor, gathered: Gathered, columns: int, *more: Tensor) -> Tensor:
        odds = nearest.sigmoid()
        rows = nearest.shape[-1] // columns
        row = torch.linspace(-1, 1, rows).to(nearest).repeat_interleave(columns) if rows > 1 else nearest.new_zeros(1)
        column = torch.linspace(-1, 1, columns).to(nearest).repeat(rows) if columns > 1 else nearest.new_zeros(1)
        inputs = [
            nearest / 2 + 1,
            gathered.best / 2 + 1,
            gathered.mean / 2 + 1,
            4 * gathered.distance,
            _log(_blur(odds, columns, 0.6)),
            _log(_blur(odds, columns, 1.5)),
            _peak(nearest, columns) / 2 + 1,
            nearest.amax(-1, keepdim=True) / 2,
            gathered.best.amax(-1, keepdim=True) / 2,
            _log(odds.sum(-1, keepdim=True)),
            row.square() + column.square(),
            row,
            gathered.looks[:, None].log() / 2,
            self.prior[gathered.target, None],
            *more,
        ]
        value: Tensor = network(torch.stack([each.expand_as(nearest) for each in inputs], -1))
        return nearest + value[..., 0]

    def presence(self, log_odds: Tensor, gathered: Gathered) -> Tensor:
        """Log odds that the target is anywhere in the image, `(B,)`.

        Args:
            log_odds: `(B, X·Y)`, of `log_odds`.
            gathered: what the looks say.
        """
        peak = log_odds.amax(-1)
        inputs = [
            peak / 3,
            log_odds.logsumexp(-1) / 3,
            log_odds.topk(min(5, log_odds.shape[-1])).values[..., -1] / 3,
            gathered.best.amax(-1) / 3,
            gathered.nearest.amax(-1) / 3,
            4 * gathered.distance.mean(-1),
            gathered.looks.log() / 2,
            self.prior[gathered.target],
            _log(gathered.score),
        ]
        value: Tensor = self.judge(torch.stack(inputs, -1))
        return peak + value[..., 0]

    def _record(self) -> dict[str, Any]:
        """Widths of the networks, number of classes, and thresholds."""
        thresholds = None if self.thresholds is None else asdict(self.thresholds)
        return {"widths": self.widths, "components": len(self.prior), "thresholds": thresholds}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The networks from what was kept."""
        thresholds = None if record["thresholds"] is None else Thresholds(**record["thresholds"])
        model = cls(
            *record["widths"], components=record["components"], thresholds=thresholds, metadata=record["metadata"]
        )
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

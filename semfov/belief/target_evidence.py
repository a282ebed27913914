"""Learned evidence for a target: in a cell from one look, in a cell from all looks, and in the whole image."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from semfov.belief.evidence import READOUT, Evidence, Gathered, blur, logarithm, network
from semfov.belief.grid import Grid
from semfov.belief.look_features import LOOK_FEATURES, look_features
from semfov.belief.prior import SHARES
from semfov.detection.detections import Detections
from semfov.io.schema import Array, Field, Maybe, Number, Object, Schema, perceptron

_PRESENCE = 9
# Log odds for a cell that is assumed not to hold the target.
_EMPTY = -8.0


@dataclass(frozen=True)
class Thresholds:
    """Thresholds on probabilities at which a search decides.

    Attributes:
        confirm: least probability of the picture, or of a place after a closer look, for `found`.
        stop_below: probability of a cell or a place below which it is not worth a look.
        place: least probability of the place of a target that is found, or of one that is worth a closer look.
    """

    confirm: float
    stop_below: float
    place: float = 0.0

    def changed(
        self, confirm: float | None = None, stop_below: float | None = None, place: float | None = None
    ) -> "Thresholds":
        """Copy with other values; None keeps a value."""
        values = {"confirm": confirm, "stop_below": stop_below, "place": place}
        return replace(self, **{name: value for name, value in values.items() if value is not None})


THRESHOLDS = Maybe(
    Object({"confirm": Number(0, 1), "give_up": Number(0, 1), "place": Number(0, 1)}, required=("confirm", "give_up"))
)
"""Schema of thresholds in the file of a model, which keeps the earlier name of `stop_below`: all files are alike."""


def thresholds_record(thresholds: Thresholds | None) -> dict[str, float] | None:
    """Write thresholds as values of a file (`THRESHOLDS`).

    Args:
        thresholds: the thresholds; None for none.

    Returns:
        The values by name.

    >>> thresholds_record(Thresholds(0.7, stop_below=0.1))
    {'confirm': 0.7, 'give_up': 0.1, 'place': 0.0}
    """
    if thresholds is None:
        return None
    return {"confirm": thresholds.confirm, "give_up": thresholds.stop_below, "place": thresholds.place}


def thresholds_of(record: Mapping[str, float] | None) -> Thresholds | None:
    """Read thresholds from values of a file.

    Args:
        record: the values by name, as `thresholds_record` writes them.

    Returns:
        The thresholds; None for none.
    """
    if record is None:
        return None
    return Thresholds(record["confirm"], record["give_up"], record.get("place", 0.0))


class TargetEvidence(Evidence):
    r"""Probability that a cell, and that the image, holds the target; learned from looks at photographs with boxes.

    `Evidence` gives the probability for every cell. This model adds the probability that the image holds the target:

    .. math:: \operatorname{logit} P(t \mid f_1 \ldots f_n) = \max_x \operatorname{logit} P(t \in x) + j(\cdot)

    All looks count, at the target and elsewhere; the belief is most certain about fixated cells. The choice of the next
    fixation needs another probability: a search continues only if no fixated cell holds the target. A further network,
    of the same form as h, gives the odds for this case (`chance`). In half of the searches that the model was trained
    on, the photograph did not hold the target.

    Args:
        look_width: hidden units of g.
        readout_width: hidden units of h and of j.
        components: K + 1, number of classes of the detector with background.
        thresholds: thresholds at which searches decide; None if none were chosen.
        shares: `(K,)`, by class, shares of the searches that it was trained on whose target was there; None: not known.
        metadata: JSON values saved with the model: `detector` and `sensor` (the settings it was trained for).

    >>> model = TargetEvidence(8, 4, components=3)  # not trained yet
    >>> seen = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 3), torch.zeros(1, 0, dtype=torch.bool))
    >>> model(seen, torch.zeros(1, 2), Grid(4, 4, (80, 80)), target=1).shape
    torch.Size([1, 16])
    """

    shares: Tensor | None

    kind: ClassVar[str] = "target-evidence"
    title: ClassVar[str] = "model of target evidence"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"
    schema: ClassVar[Schema] = Schema(
        {
            **perceptron("look", LOOK_FEATURES, "L"),
            **perceptron("read", READOUT, "R"),
            **perceptron("guide", READOUT + 1, "R"),
            **perceptron("judge", _PRESENCE, "R"),
            "prior": Field(("K+1",), low=-1e3, high=1e3),
            "shares": SHARES,
        },
        {
            "widths": Array((Number(size="L"), Number(size="R"))),
            "components": Number(size="K+1"),
            "thresholds": THRESHOLDS,
        },
    )

    def __init__(
        self,
        look_width: int = 48,
        readout_width: int = 24,
        *,
        components: int = 81,
        thresholds: Thresholds | None = None,
        shares: Tensor | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(look_width, readout_width, components=components, metadata=metadata)
        self.thresholds = thresholds
        self.register_buffer("shares", shares)
        self.guide = network(READOUT + 1, readout_width)
        self.judge = network(_PRESENCE, readout_width)

    def forward(self, detections: Detections, fixation: Tensor, grid: Grid, target: int) -> Tensor:
        """Compute the evidence of each look for the target in every cell.

        Args:
            detections: a batch `(B, L)` of looks, boxes in pixels of the grid's image.
            fixation: `(B, 2)`, as `(x, y)` in pixels.
            grid: the cells of one image.
            target: class 1..K.

        Returns:
            `(B, X·Y)`, log odds.
        """
        return self.evidence(look_features(detections, fixation, grid, target))

    def log_odds(self, gathered: Gathered, columns: int) -> Tensor:
        """Compute the log odds of the target in each cell after several looks.

        Args:
            gathered: evidence of the looks.
            columns: X, cells in a row.

        Returns:
            `(B, X·Y)`.
        """
        return self.read_out(self.read, gathered.nearest, gathered, columns)

    def chance(self, gathered: Gathered, columns: int) -> Tensor:
        """Compute the log odds of the target in each cell, given that no fixated cell holds it.

        Args:
            gathered: evidence of the looks.
            columns: X, cells in a row.

        Returns:
            `(B, X·Y)`; the values of fixated cells have no meaning.
        """
        visited = gathered.visited
        fixated_nearby = blur(visited.to(gathered.nearest), columns, 0.6)
        nearest = gathered.nearest.masked_fill(visited, _EMPTY)
        return self.read_out(self.guide, nearest, gathered, columns, fixated_nearby)

    def presence(self, log_odds: Tensor, gathered: Gathered) -> Tensor:
        """Compute the log odds that the target is anywhere in the image.

        Args:
            log_odds: `(B, X·Y)`, log odds of the cells (`log_odds`).
            gathered: evidence of the looks.

        Returns:
            `(B,)`.
        """
        peak = log_odds.amax(-1)
        # Of about unit size, as those of `Evidence.read_out`. The largest, the fifth largest and the sum of the cells
        # tell one sure place from many doubtful ones.
        inputs = [
            peak / 3,
            log_odds.logsumexp(-1) / 3,
            log_odds.topk(min(5, log_odds.shape[-1])).values[..., -1] / 3,
            gathered.best.amax(-1) / 3,
            gathered.nearest.amax(-1) / 3,
            4 * gathered.distance.mean(-1),
            gathered.looks.log() / 2,
            self.prior[gathered.target],
            logarithm(gathered.score),
        ]
        correction: Tensor = self.judge(torch.stack(inputs, -1))
        return peak + correction[..., 0]

    def _record(self) -> dict[str, Any]:
        """List what a file holds beside tensors."""
        return {**super()._record(), "thresholds": thresholds_record(self.thresholds)}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """Make the model of a file."""
        model = cls(
            *record["widths"],
            components=record["components"],
            thresholds=thresholds_of(record["thresholds"]),
            shares=tensors.get("shares"),
            metadata=record["metadata"],
        )
        model.load_state_dict(tensors)
        return model

"""Learned evidence for a target: what one look says of a cell, what all looks say of it, and of the whole image."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from semfov.belief.evidence import READOUT, Evidence, Gathered, blur, logarithm, network
from semfov.belief.grid import Grid
from semfov.belief.look_features import FEATURES, look_features
from semfov.detection.detections import Detections
from semfov.io.schema import Field, Maybe, Number, Object, Pair, Schema, perceptron

_PRESENCE = 9
# Log odds of a cell that does not hold the target.
_EMPTY = -8.0


@dataclass(frozen=True)
class Thresholds:
    """Probabilities at which a search decides.

    Attributes:
        confirm: that the image holds the target, from which on it is found, once a cell about as probable as any was
            fixated.
        give_up: that a cell not fixated yet holds the target if no fixated cell does; where none reaches it, no look is
            worth its price.
        place: that the fixated cell itself holds the target: where it is less, the image may well hold it, but it was
            not seen where.
    """

    confirm: float
    give_up: float
    place: float = 0.0

    def changed(
        self, confirm: float | None = None, give_up: float | None = None, place: float | None = None
    ) -> "Thresholds":
        """The same with those that are given instead."""
        given = {"confirm": confirm, "give_up": give_up, "place": place}
        return replace(self, **{name: value for name, value in given.items() if value is not None})


THRESHOLDS = Maybe(
    Object({"confirm": Number(0, 1), "give_up": Number(0, 1), "place": Number(0, 1)}, required=("confirm", "give_up"))
)
"""As a file keeps them."""


class TargetEvidence(Evidence):
    r"""Probability that a cell, and the image, holds the target: learned from looks at photographs with boxes.

    To what `Evidence` says of every cell comes whether the image holds the target at all:

    .. math:: \operatorname{logit} P(t \mid f_1 \ldots f_n) = \max_x \operatorname{logit} P(t \in x) + j(\cdot)

    All looks count, those at the target and those at cells that do not hold it: what is fixated is known best. Where
    to look next is another question: a search goes on because no fixated cell holds the target, and a network like h
    tells the odds of that case (`chance`). Half of the searches that it was trained on had no target to find.

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
    schema: ClassVar[Schema] = Schema(
        {
            **perceptron("look", FEATURES, "L"),
            **perceptron("read", READOUT, "R"),
            **perceptron("guide", READOUT + 1, "R"),
            **perceptron("judge", _PRESENCE, "R"),
            "prior": Field(("C",), low=-1e3, high=1e3),
        },
        {
            "widths": Pair((Number(size="L"), Number(size="R"))),
            "components": Number(size="C"),
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
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(look_width, readout_width, components=components, metadata=metadata)
        self.thresholds = thresholds
        self.guide = network(READOUT + 1, readout_width)
        self.judge = network(_PRESENCE, readout_width)

    def forward(self, detections: Detections, fixation: Tensor, grid: Grid, target: int) -> Tensor:
        """Evidence of each look, `(B, X·Y)`; arguments as for `look_features`."""
        return self.evidence(look_features(detections, fixation, grid, target))

    def log_odds(self, gathered: Gathered, columns: int) -> Tensor:
        """Log odds of the target in each cell after several looks, `(B, X·Y)`.

        Args:
            gathered: what the looks say.
            columns: cells in a row.
        """
        return self.read_out(self.read, gathered.nearest, gathered, columns)

    def chance(self, gathered: Gathered, columns: int) -> Tensor:
        """Log odds of the target in each cell if no fixated cell holds it, `(B, X·Y)`; arguments as for `log_odds`."""
        visited = gathered.visited
        beside = blur(visited.to(gathered.nearest), columns, 0.6)
        return self.read_out(self.guide, gathered.nearest.masked_fill(visited, _EMPTY), gathered, columns, beside)

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
            logarithm(gathered.score),
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

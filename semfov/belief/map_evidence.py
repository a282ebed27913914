"""Learned evidence for a map: the probability of every class, and of none, in every cell."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from semfov.belief.evidence import READOUT, Evidence, Gathered, blur, logarithm, network
from semfov.belief.grid import Grid
from semfov.belief.look_features import FEATURES, class_features
from semfov.detection.detections import Detections
from semfov.errors import check_whole
from semfov.io.schema import Field, Number, Pair, Schema, perceptron

_EMPTINESS = 9
_GAIN = 7

# Of a distance in float32, in longer sides of the image.
_ROUNDING = 1e-6


class MapEvidence(Evidence):
    r"""Probability of every class in every cell, learned from looks at photographs with boxes.

    Each class is weighed as in `Evidence`, with the strongest evidence :math:`r` of the other classes in the cell
    beside it. Several classes can share a cell: their probabilities need not sum to 1. That a cell holds none, the
    background, is told by a network of its own,

    .. math:: \operatorname{logit} P(\emptyset \in x) = \operatorname{logit} \prod_k (1 - P(k \in x)) + v(\cdot)

    and another one learns how many more cells a look will name right:

    .. math:: E[\Delta \mid f] = \sum_x w\bigl(p_{(1)}(x), p_{(2)}(x), P(\emptyset \in x), d^*(x), d(x, f), n\bigr)

    with the two greatest probabilities of the cell, the distance of its closest look and of the next, and the number of
    looks. Classes are as frequent as in the photographs that it was trained on.

    Args:
        look_width: hidden units of g.
        readout_width: hidden units of h, v and w.
        components: classes of the detector, background included.
        metadata: JSON values kept with the model: `detector` and `sensor` (settings it was trained for).
    """

    kind: ClassVar[str] = "map-evidence"
    title: ClassVar[str] = "model of map evidence"
    shipped: ClassVar[Path] = Path(__file__).parent / "models" / "maps"

    schema: ClassVar[Schema] = Schema(
        {
            **perceptron("look", FEATURES, "L"),
            **perceptron("read", READOUT + 1, "R"),
            **perceptron("void", _EMPTINESS, "R"),
            **perceptron("worth", _GAIN, "R"),
            "prior": Field(("C",), low=-1e3, high=1e3),
        },
        {"widths": Pair((Number(size="L"), Number(size="R"))), "components": Number(size="C", low=3)},
    )

    def __init__(
        self,
        look_width: int = 48,
        readout_width: int = 24,
        *,
        components: int = 81,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        for name, value, least in (
            ("look_width", look_width, 1),
            ("readout_width", readout_width, 1),
            ("components", components, 3),
        ):
            check_whole(value, name, least, 10_000)
        super().__init__(look_width, readout_width, components=components, more=1, metadata=metadata)
        self.void = network(_EMPTINESS, readout_width)
        self.worth = network(_GAIN, readout_width)

    def forward(self, detections: Detections, fixation: Tensor, grid: Grid, targets: Tensor) -> Tensor:
        """Evidence of each look for classes `(T,)`, `(B, T, X·Y)`; arguments as for `class_features`."""
        return self.evidence(class_features(detections, fixation, grid, targets))

    def log_odds(self, gathered: Gathered, columns: int, classes: int) -> Tensor:
        """Log odds of each class in each cell after several looks, `(B, T, X·Y)`.

        Args:
            gathered: what the looks say, a row for each episode and class, `(B·T, ...)`.
            columns: cells in a row.
            classes: T, 2 or more.
        """
        nearest = gathered.nearest.unflatten(0, (-1, classes))
        greatest = nearest.topk(2, 1)
        leads = torch.arange(classes, device=nearest.device)[:, None] == greatest.indices[:, :1]
        rival = torch.where(leads, greatest.values[:, 1:], greatest.values[:, :1]).flatten(0, 1)
        read = self.read_out(self.read, gathered.nearest, gathered, columns, rival / 2 + 1)
        return read.unflatten(0, (-1, classes))

    def emptiness(
        self, log_odds: Tensor, distance: Tensor, looks: Tensor, columns: int, stands_for: Tensor | None = None
    ) -> Tensor:
        """Log odds that a cell holds nothing, `(B, X·Y)`.

        Args:
            log_odds: `(B, T, X·Y)`.
            distance: `(B, X·Y)`, of the closest look.
            looks: `(B,)`, how many there were.
            columns: cells in a row.
            stands_for: `(B, T)`, how many classes each one stands for, where not all are given; None: one.
        """
        each = torch.nn.functional.logsigmoid(-log_odds)
        none = (each if stands_for is None else each * stands_for[..., None]).sum(1)
        anything = -torch.expm1(none)
        first, second = log_odds.topk(2, 1).values.unbind(1)
        inputs = [
            none / 2,
            logarithm(anything),
            first / 3,
            second / 3,
            logarithm(blur(anything, columns, 0.6)),
            logarithm(blur(anything, columns, 1.5)),
            logarithm(anything.mean(-1, keepdim=True)),
            4 * distance,
            looks[:, None].log() / 2,
        ]
        value: Tensor = self.void(torch.stack([each.expand_as(first) for each in inputs], -1))
        return none - anything.clamp(min=1e-6).log() + value[..., 0]

    def gain(self, probabilities: Tensor, closest: Tensor, looks: Tensor, distance: Tensor) -> Tensor:
        """How many more cells a look is expected to name right, by cell, `(B, F, X·Y)`.

        Args:
            probabilities: `(B, X·Y, K+1)`, of a map.
            closest: `(B, X·Y)`, distance of the closest look so far.
            looks: `(B,)`, how many there were.
            distance: `(B, F, X·Y)`, from each of F possible fixations to every cell, or `(F, X·Y)`.
        """
        objects, nothing = probabilities[..., 1:].topk(2, -1).values, probabilities[..., 0]
        nearer = (closest[:, None] - distance).clamp(min=0)
        inputs = [
            logarithm(objects[..., 0])[:, None],
            logarithm(objects[..., 1])[:, None],
            logarithm(nothing)[:, None],
            4 * closest[:, None],
            4 * torch.minimum(closest[:, None], distance),
            4 * nearer,
            looks[:, None, None].log() / 2,
        ]
        value: Tensor = self.worth(torch.stack([each.expand_as(nearer) for each in inputs], -1))
        # As far is no nearer, however the two distances were rounded.
        return value[..., 0] * (nearer > _ROUNDING)

    def _record(self) -> dict[str, Any]:
        """Widths of the networks and number of classes."""
        return {"widths": self.widths, "components": len(self.prior)}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The networks from what was kept."""
        model = cls(*record["widths"], components=record["components"], metadata=record["metadata"])
        model.load_state_dict(tensors)
        return model

"""Learned evidence for a map: the probability of every class, and of background, in every cell."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from semfov.belief.evidence import READOUT, Evidence, Gathered, apply_network, blur, logarithm, network
from semfov.belief.grid import Grid
from semfov.belief.look_features import LOOK_FEATURES, class_features
from semfov.detection.detections import Detections
from semfov.errors import check_whole
from semfov.io.schema import Array, Field, Number, Schema, perceptron

_EMPTINESS = 9
_GAIN = 7

# Rounding error of a distance in float32, in longer sides of the image.
_ROUNDING = 1e-6


class MapEvidence(Evidence):
    r"""Probability of every class in every cell, learned from looks at photographs with boxes.

    Each class is treated as in `Evidence`, with one more input: the strongest evidence :math:`r` of the other classes
    in the cell. Several classes can share a cell, so their probabilities need not sum to 1. A second network gives the
    probability that a cell holds no object (background):

    .. math:: \operatorname{logit} P(\emptyset \in x) = \operatorname{logit} \prod_k (1 - P(k \in x)) + v(\cdot)

    A third network predicts how many more cells will be classified correctly after a look at f:

    .. math:: E[\Delta \mid f] = \sum_x w\bigl(p_{(1)}(x), p_{(2)}(x), P(\emptyset \in x), d^*(x), d(x, f), n\bigr)

    where :math:`p_{(1)}` and :math:`p_{(2)}` are the two largest class probabilities of the cell, :math:`d^*` is the
    distance to its closest fixation, and n is the number of looks. The class frequencies are those of the photographs
    that the model was trained on.

    Args:
        look_width: hidden units of g.
        readout_width: hidden units of h, v and w.
        components: K + 1, number of classes of the detector with background.
        metadata: JSON values saved with the model: `detector` and `sensor` (the settings it was trained for).

    Raises:
        InputError: a width or the number of classes is out of range.

    >>> model = MapEvidence(8, 4, components=3)  # not trained yet
    >>> seen = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 3), torch.zeros(1, 0, dtype=torch.bool))
    >>> model(seen, torch.zeros(1, 2), Grid(4, 4, (80, 80)), torch.tensor([1, 2])).shape
    torch.Size([1, 2, 16])
    """

    kind: ClassVar[str] = "map-evidence"
    title: ClassVar[str] = "model of map evidence"
    shipped: ClassVar[Path] = Path(__file__).parent / "models" / "maps"

    schema: ClassVar[Schema] = Schema(
        {
            **perceptron("look", LOOK_FEATURES, "L"),
            **perceptron("read", READOUT + 1, "R"),
            **perceptron("void", _EMPTINESS, "R"),
            **perceptron("worth", _GAIN, "R"),
            "prior": Field(("C",), low=-1e3, high=1e3),
        },
        {"widths": Array((Number(size="L"), Number(size="R"))), "components": Number(size="C", low=3)},
    )

    def __init__(
        self,
        look_width: int = 48,
        readout_width: int = 24,
        *,
        components: int = 81,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        check_whole(look_width, "look_width", 1, 10_000)
        check_whole(readout_width, "readout_width", 1, 10_000)
        check_whole(components, "components", 3, 10_000)
        super().__init__(look_width, readout_width, components=components, more=1, metadata=metadata)
        self.void = network(_EMPTINESS, readout_width)
        self.worth = network(_GAIN, readout_width)

    def forward(self, detections: Detections, fixation: Tensor, grid: Grid, targets: Tensor) -> Tensor:
        """Compute the evidence of each look for several classes in every cell.

        Args:
            detections: a batch `(B, L)` of looks, boxes in pixels of the grid's image.
            fixation: `(B, 2)`, as `(x, y)` in pixels.
            grid: the cells of one image.
            targets: `(T,)`, classes 1..K.

        Returns:
            `(B, T, X·Y)`, log odds.
        """
        return self.evidence(class_features(detections, fixation, grid, targets))

    def log_odds(self, gathered: Gathered, columns: int, classes: int) -> Tensor:
        """Compute the log odds of each class in each cell after several looks.

        Args:
            gathered: evidence of the looks, one row for each episode and class, `(B·T, ...)`.
            columns: X, cells in a row.
            classes: T, 2 or more.

        Returns:
            `(B, T, X·Y)`.
        """
        nearest = gathered.nearest.unflatten(0, (-1, classes))
        # The strongest rival of the class that leads in a cell is the second one, and that of the others is the first.
        strongest = nearest.topk(2, 1)
        leads = torch.arange(classes, device=nearest.device)[:, None] == strongest.indices[:, :1]
        rival = torch.where(leads, strongest.values[:, 1:], strongest.values[:, :1]).flatten(0, 1)
        read = self.read_out(self.read, gathered.nearest, gathered, columns, rival / 2 + 1)
        return read.unflatten(0, (-1, classes))

    def emptiness(
        self, log_odds: Tensor, distance: Tensor, looks: Tensor, columns: int, stands_for: Tensor | None = None
    ) -> Tensor:
        """Compute the log odds that a cell holds no object.

        Args:
            log_odds: `(B, T, X·Y)`, log odds of the classes (`log_odds`).
            distance: `(B, X·Y)`, from each cell to its closest fixation, in longer sides of the image.
            looks: `(B,)`, number of looks.
            columns: X, cells in a row.
            stands_for: `(B, T)`, number of classes that each given class represents, where T < K; None is 1 for each.

        Returns:
            `(B, X·Y)`.
        """
        not_class = torch.nn.functional.logsigmoid(-log_odds)
        # In logarithms: the product of 80 probabilities near 1 keeps its digits.
        none = (not_class if stands_for is None else not_class * stands_for[..., None]).sum(1)
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
        # The first two terms are the log odds of Π (1 - P).
        return none - anything.clamp(min=1e-6).log() + apply_network(self.void, inputs, first.shape)

    def gain(self, probabilities: Tensor, closest: Tensor, looks: Tensor, distance: Tensor) -> Tensor:
        """Predict how many more cells will be classified correctly after one more look, cell by cell.

        Args:
            probabilities: `(B, X·Y, K+1)`, class probabilities of a map, background first.
            closest: `(B, X·Y)`, from each cell to its closest fixation so far, in longer sides of the image.
            looks: `(B,)`, number of looks so far.
            distance: `(B, F, X·Y)` or `(F, X·Y)`, from each of F possible fixations to every cell.

        Returns:
            `(B, F, X·Y)`; the sum over the cells is the expected increase for a fixation.
        """
        objects = probabilities[..., 1:].topk(2, -1).values
        nothing = probabilities[..., 0]
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
        # Two equal distances may differ by rounding; such a look is not closer.
        return apply_network(self.worth, inputs, nearer.shape) * (nearer > _ROUNDING)

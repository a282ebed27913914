"""The observer that learned to tell what is where: every class, and none, in every cell."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief, pick
from semfov.belief.evidence import Gathered
from semfov.belief.grid import Grid
from semfov.belief.look_features import highest_score
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers.base import Look, own
from semfov.belief.observers.gathering import EvidenceLook, GatheredBelief, Gatherer
from semfov.detection.detections import Detections


@dataclass(frozen=True)
class MapLook(EvidenceLook):
    """What looks say about T classes in every cell; attributes as for T classes in `EvidenceLook`, and:

    Attributes:
        stands_for: `(B, T)`, how many classes each one stands for; 1 where all are given.
    """

    stands_for: Tensor


@dataclass(frozen=True)
class MapBelief(GatheredBelief):
    """Belief about all classes, as marginal probabilities; attributes as for K classes in `GatheredBelief`, and:

    Several classes can share a cell.

    Attributes:
        probabilities: `(B, X·Y, K+1)`, that a cell holds each class; the first is that it holds none.
    """

    probabilities: Tensor

    def class_probabilities(self) -> Tensor:
        """Probabilities of all classes; they need not sum to 1."""
        return self.probabilities

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability that each cell holds the target, `(B, X·Y)`."""
        return pick(self.probabilities, torch.as_tensor(target))


class LearnedMap(Gatherer):
    """Gathers evidence for all classes as `MapEvidence` learned to: the closest look at each cell counts most.

    Args:
        model: the learned evidence.
        together: compute all episodes of a batch at once: faster, but how figures are rounded depends on the batch.
    """

    model: MapEvidence

    def __init__(self, model: MapEvidence, *, together: bool = False) -> None:
        super().__init__(together)
        self.model = model

    def start(self, batch: int, grid: Grid, like: Tensor) -> MapBelief:
        """The same for every class in every cell, and nothing gathered."""
        classes = len(self.model.prior) - 1
        even = like.new_full((batch, len(grid), classes + 1), 1 / (classes + 1))
        # One row for all classes: it broadcasts over those that the first look tells of.
        return MapBelief(**self.nothing(batch, grid, like, 1), probabilities=even)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> MapLook:
        """What looks from `fixation` `(B, 2)` say about all classes, whatever `target` is."""
        targets = torch.arange(1, len(self.model.prior), device=fixation.device)

        def evidence(boxes: Tensor, scores: Tensor, mask: Tensor, point: Tensor) -> Tensor:
            return self.model(Detections(boxes, scores, mask), point, grid, targets)

        rows = detections.boxes, detections.scores, detections.mask, fixation
        said = self.each(evidence, *rows)
        every = targets.expand(len(fixation), -1)
        where = grid.distance(fixation), highest_score(detections, targets), grid.cell_of(fixation)
        return MapLook(said, *where, every, grid.columns, torch.ones_like(every))

    def update(self, belief: Belief, look: Look) -> MapBelief:
        """Belief after a look in each episode."""
        known, said = own(belief, MapBelief, "belief"), own(look, MapLook, "look")
        all_looks = self.gather(known, said)
        gathered = *self.read(all_looks), said.target, said.stands_for
        probabilities = self.each(lambda *rows: self._read(*rows, columns=said.columns), *gathered)
        return MapBelief(**all_looks, probabilities=probabilities)

    def _read(
        self,
        nearest: Tensor,
        best: Tensor,
        mean: Tensor,
        closest: Tensor,
        score: Tensor,
        looks: Tensor,
        visited: Tensor,
        targets: Tensor,
        stands_for: Tensor,
        *,
        columns: int,
    ) -> Tensor:
        """Probabilities `(B, X·Y, T+1)` from what was gathered."""
        classes = nearest.shape[1]

        def of_class(values: Tensor) -> Tensor:
            return values.repeat_interleave(classes, 0)

        rows = Gathered(
            nearest.flatten(0, 1),
            best.flatten(0, 1),
            mean.flatten(0, 1),
            of_class(closest),
            score.flatten(),
            of_class(looks),
            of_class(visited),
            targets.flatten(),
        )
        cells = self.model.log_odds(rows, columns, classes)
        nothing = self.model.emptiness(cells, closest, looks, columns, stands_for)
        return torch.cat([nothing[:, None], cells], 1).sigmoid().transpose(1, 2)

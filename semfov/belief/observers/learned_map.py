"""The observer that learned to tell what is where: every class, and none, in every cell."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief, pick
from semfov.belief.evidence import Gathered, nearness
from semfov.belief.grid import Grid
from semfov.belief.look_features import highest_score
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers.base import Gatherer, Look, own
from semfov.detection.detections import Detections


@dataclass(frozen=True)
class MapLook(Look):
    """What looks say about T classes in every cell.

    Attributes:
        evidence: `(B, T, X·Y)`, log odds.
        distance: `(B, X·Y)`, from the fixation, in longer sides of the image.
        score: `(B, T)`, highest score of each class in any detection.
        fixated: `(B,)`, cell that holds the fixation.
        targets: `(B, T)`, the classes.
        columns: cells in a row.
        stands_for: `(B, T)`, how many classes each one stands for; 1 where all are given.
    """

    evidence: Tensor
    distance: Tensor
    score: Tensor
    fixated: Tensor
    targets: Tensor
    columns: int
    stands_for: Tensor

    def __getitem__(self, index: Tensor | slice) -> "MapLook":
        """Some of the looks."""
        said = self.evidence[index], self.distance[index], self.score[index], self.fixated[index], self.targets[index]
        return MapLook(*said, self.columns, self.stands_for[index])

    @classmethod
    def join(cls, looks: Sequence["MapLook"]) -> "MapLook":
        """All looks of several batches."""
        names = ("evidence", "distance", "score", "fixated", "targets", "stands_for")
        tensors = {name: torch.cat([getattr(look, name) for look in looks]) for name in names}
        return cls(**tensors, columns=looks[0].columns)


@dataclass(frozen=True)
class MapBelief(Belief):
    """Belief about all classes, as marginal probabilities: several classes can share a cell.

    Attributes:
        probabilities: `(B, X·Y, K+1)`, that a cell holds each class; the first is that it holds none.
        closest: `(B, X·Y)`, see `Belief`.
        nearest: `(B, K, X·Y)`, evidence of the closest look at each cell.
        best: `(B, K, X·Y)`, strongest evidence of any look.
        total: `(B, K, X·Y)`, evidence of all looks, each counted by its nearness.
        weight: `(B, X·Y)`, sum of the nearness of all looks.
        score: `(B, K)`, highest score of each class in any detection.
        looks: `(B,)`, number of looks.
        visited: `(B, X·Y)` boolean, cells that were fixated.
    """

    probabilities: Tensor
    closest: Tensor
    nearest: Tensor
    best: Tensor
    total: Tensor
    weight: Tensor
    score: Tensor
    looks: Tensor
    visited: Tensor

    def class_probabilities(self) -> Tensor:
        """Probabilities of all classes; they need not sum to 1."""
        return self.probabilities

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability that each cell holds the target, `(B, X·Y)`."""
        return pick(self.probabilities, torch.as_tensor(target))

    def map(self, function: Callable[[Tensor], Tensor]) -> "MapBelief":
        """The belief with all tensors replaced."""
        gathered = self.nearest, self.best, self.total, self.weight, self.score, self.looks, self.visited
        return MapBelief(*map(function, (self.probabilities, self.closest, *gathered)))


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
        cells, episodes = like.new_zeros(batch, len(grid)), like.new_zeros(batch)
        # One row for all classes: it broadcasts over those that the first look tells of.
        each, never = like.new_zeros(batch, 1, len(grid)), cells + torch.inf
        even = like.new_full((batch, len(grid), classes + 1), 1 / (classes + 1))
        gathered = each, each - torch.inf, each, cells, like.new_zeros(batch, 1), episodes, cells.bool()
        return MapBelief(even, never, *gathered)

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
        nearest = torch.where((said.distance < known.closest)[:, None], said.evidence, known.nearest)
        best = torch.maximum(said.evidence, known.best)
        closest = torch.minimum(said.distance, known.closest)
        near = self.each(nearness, said.distance)
        total, weight = known.total + near[:, None] * said.evidence, known.weight + near
        score, looks = torch.maximum(said.score, known.score), known.looks + 1
        visited = known.visited.scatter(-1, said.fixated[:, None], True)
        mean = total / weight[:, None]
        gathered = nearest, best, mean, closest, score, looks, visited, said.targets, said.stands_for
        probabilities = self.each(lambda *rows: self._read(*rows, columns=said.columns), *gathered)
        return MapBelief(probabilities, closest, nearest, best, total, weight, score, looks, visited)

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

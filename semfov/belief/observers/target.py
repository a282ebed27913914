"""The observer of a searcher that knows what it wants: only where the target is."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.evidence import Gathered, nearness
from semfov.belief.grid import Grid
from semfov.belief.look_features import highest_score
from semfov.belief.observers.base import Gatherer, Look, own
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.detection.detections import Detections
from semfov.errors import InputError


@dataclass(frozen=True)
class TargetLook(Look):
    """What looks say about the target in every cell.

    Attributes:
        evidence: `(B, X·Y)`, log odds.
        distance: `(B, X·Y)`, from the fixation, in longer sides of the image.
        score: `(B,)`, highest score of the target in any detection.
        fixated: `(B,)`, cell that holds the fixation.
        target: `(B,)`, class that is searched for.
        columns: cells in a row.
    """

    evidence: Tensor
    distance: Tensor
    score: Tensor
    fixated: Tensor
    target: Tensor
    columns: int

    def __getitem__(self, index: Tensor | slice) -> "TargetLook":
        """Some of the looks."""
        evidence, distance = self.evidence[index], self.distance[index]
        which = self.fixated[index], self.target[index]
        return TargetLook(evidence, distance, self.score[index], *which, self.columns)

    @classmethod
    def join(cls, looks: Sequence["TargetLook"]) -> "TargetLook":
        """All looks of several batches."""
        names = ("evidence", "distance", "score", "fixated", "target")
        tensors = {name: torch.cat([getattr(look, name) for look in looks]) for name in names}
        return cls(**tensors, columns=looks[0].columns)


@dataclass(frozen=True)
class TargetBelief(Belief):
    """Belief about one target alone.

    Attributes:
        present: `(B, X·Y)`, probability that a cell holds the target.
        following: `(B, X·Y)`, the same if no fixated cell holds it.
        anywhere: `(B,)`, probability that the image holds it.
        closest: `(B, X·Y)`, see `Belief`.
        nearest: `(B, X·Y)`, evidence of the closest look at each cell.
        best: `(B, X·Y)`, strongest evidence of any look.
        total: `(B, X·Y)`, evidence of all looks, each counted by its nearness.
        weight: `(B, X·Y)`, sum of the nearness of all looks.
        score: `(B,)`, highest score of the target in any detection.
        looks: `(B,)`, number of looks.
        visited: `(B, X·Y)` boolean, cells that were fixated.
    """

    present: Tensor
    following: Tensor
    anywhere: Tensor
    closest: Tensor
    nearest: Tensor
    best: Tensor
    total: Tensor
    weight: Tensor
    score: Tensor
    looks: Tensor
    visited: Tensor

    def chance(self, target: int | Tensor) -> Tensor:
        """As for `probability`, if no fixated cell holds the target."""
        return self.following

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability of the target that was searched for, `(B, X·Y)`, whatever `target` is."""
        return self.present

    def presence(self, target: int | Tensor) -> Tensor:
        """Probability that the target that was searched for is anywhere, `(B,)`, whatever `target` is."""
        return self.anywhere

    def map(self, function: Callable[[Tensor], Tensor]) -> "TargetBelief":
        """The belief with all tensors replaced."""
        told = self.present, self.following, self.anywhere
        gathered = self.closest, self.nearest, self.best, self.total, self.weight, self.score, self.looks, self.visited
        return TargetBelief(*map(function, (*told, *gathered)))


class Target(Gatherer):
    """Gathers evidence for the target as `TargetEvidence` learned to: the closest look at each cell counts most.

    Args:
        model: the learned evidence.
        together: compute all episodes of a batch at once: faster, but how figures are rounded depends on the batch.
    """

    model: TargetEvidence
    by_target = True

    def __init__(self, model: TargetEvidence, *, together: bool = False) -> None:
        super().__init__(together)
        self.model = model

    @property
    def thresholds(self) -> Thresholds | None:
        """Those of the model."""
        return self.model.thresholds

    def start(self, batch: int, grid: Grid, like: Tensor) -> TargetBelief:
        """Even odds in every cell, and nothing gathered."""
        cells, episodes = like.new_zeros(batch, len(grid)), like.new_zeros(batch)
        even, never = cells + 0.5, cells + torch.inf
        gathered = never, cells, -never, cells, cells, episodes, episodes, cells.bool()
        return TargetBelief(even, even, episodes + 0.5, *gathered)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> TargetLook:
        """What looks from `fixation` `(B, 2)` say about the target."""
        if target is None:
            raise InputError("target: expected a class to search for, got None")
        evidence = self.model(detections, fixation, grid, target)
        score = highest_score(detections, target)
        wanted = torch.full((len(fixation),), target, device=fixation.device)
        return TargetLook(evidence, grid.distance(fixation), score, grid.cell_of(fixation), wanted, grid.columns)

    def update(self, belief: Belief, look: Look) -> TargetBelief:
        """Belief after a look in each episode."""
        known, said = own(belief, TargetBelief, "belief"), own(look, TargetLook, "look")
        closer = said.distance < known.closest
        nearest = torch.where(closer, said.evidence, known.nearest)
        best = torch.maximum(said.evidence, known.best)
        closest = torch.minimum(said.distance, known.closest)
        near = self.each(nearness, said.distance)
        total, weight = known.total + near * said.evidence, known.weight + near
        score, looks = torch.maximum(said.score, known.score), known.looks + 1

        visited = known.visited.scatter(-1, said.fixated[:, None], True)
        columns = said.columns

        def probabilities(*gathered: Tensor) -> Tensor:
            what = Gathered(*gathered)
            cells = self.model.log_odds(what, columns)
            image = self.model.presence(cells, what)[:, None]
            return torch.cat([cells, self.model.chance(what, columns), image], -1).sigmoid()

        gathered = nearest, best, total / weight, closest, score, looks, visited, said.target
        told = self.each(probabilities, *gathered)
        number = nearest.shape[-1]
        present, following, anywhere = told[:, :number], told[:, number:-1], told[:, -1]
        return TargetBelief(present, following, anywhere, closest, nearest, best, total, weight, score, looks, visited)

"""The observer of a searcher that knows what it wants: only where the target is."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer, own
from semfov.belief.target_evidence import TargetEvidence
from semfov.detection.detections import Detections
from semfov.errors import InputError


@dataclass(frozen=True)
class TargetLook(Look):
    """What looks say about the target in every cell.

    Attributes:
        evidence: `(B, X·Y)`, log odds.
        distance: `(B, X·Y)`, from the fixation, in longer sides of the image.
        fixated: `(B, X·Y)` boolean, the cell that holds the fixation.
        columns: cells in a row.
    """

    evidence: Tensor
    distance: Tensor
    fixated: Tensor
    columns: int

    def __getitem__(self, index: Tensor | slice) -> "TargetLook":
        """Some of the looks."""
        return TargetLook(self.evidence[index], self.distance[index], self.fixated[index], self.columns)

    @classmethod
    def join(cls, looks: Sequence["TargetLook"]) -> "TargetLook":
        """All looks of several batches."""
        return cls(
            torch.cat([look.evidence for look in looks]),
            torch.cat([look.distance for look in looks]),
            torch.cat([look.fixated for look in looks]),
            looks[0].columns,
        )


@dataclass(frozen=True)
class TargetBelief(Belief):
    """Belief about one target alone.

    Attributes:
        present: `(B, X·Y)`, probability that a cell holds the target.
        closest: `(B, X·Y)`, see `Belief`.
        nearest: `(B, X·Y)`, evidence of the closest look at each cell.
        best: `(B, X·Y)`, strongest evidence of any look.
        visited: `(B, X·Y)` boolean, cells that were fixated.
    """

    present: Tensor
    closest: Tensor
    nearest: Tensor
    best: Tensor
    visited: Tensor

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability of the target that was searched for, `(B, X·Y)`, whatever `target` is."""
        return self.present

    def map(self, function: Callable[[Tensor], Tensor]) -> "TargetBelief":
        """The belief with all tensors replaced."""
        tensors = self.present, self.closest, self.nearest, self.best, self.visited
        return TargetBelief(*map(function, tensors))


class Target(Observer):
    """Gathers evidence for the target as `TargetEvidence` learned to: the closest look at each cell counts most.

    Args:
        model: the learned evidence.
    """

    by_target = True

    def __init__(self, model: TargetEvidence) -> None:
        super().__init__()
        self.model = model

    def start(self, batch: int, grid: Grid, like: Tensor) -> TargetBelief:
        """Even odds in every cell."""
        zeros = like.new_zeros(batch, len(grid))
        return TargetBelief(zeros + 0.5, zeros + torch.inf, zeros, zeros - torch.inf, zeros.bool())

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> TargetLook:
        """What looks from `fixation` `(B, 2)` say about the target."""
        if target is None:
            raise InputError("target: expected a class to search for, got None")
        fixated = grid.cell_of(fixation)[:, None] == torch.arange(len(grid), device=fixation.device)
        evidence = self.model(detections, fixation, grid, target)
        return TargetLook(evidence, grid.distance(fixation), fixated, grid.columns)

    def update(self, belief: Belief, look: Look) -> TargetBelief:
        """Belief after a look in each episode."""
        known, said = own(belief, TargetBelief, "belief"), own(look, TargetLook, "look")
        closer = said.distance < known.closest
        nearest = torch.where(closer, said.evidence, known.nearest)
        best = torch.maximum(said.evidence, known.best)
        closest = torch.minimum(said.distance, known.closest)
        visited = known.visited | said.fixated

        def probability(nearest: Tensor, best: Tensor, closest: Tensor, visited: Tensor) -> Tensor:
            return self.model.log_odds(nearest, best, closest, visited, said.columns).sigmoid()

        present = one_by_one(probability, nearest, best, closest, visited)
        return TargetBelief(present, closest, nearest, best, visited)

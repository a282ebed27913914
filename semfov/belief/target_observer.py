"""The observer of a searcher that knows what it wants: only where the target is."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.belief.target_evidence import TargetEvidence
from semfov.detection.detections import Detections
from semfov.errors import InputError


@dataclass(frozen=True)
class TargetLook:
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
    def join(cls, looks: list["TargetLook"]) -> "TargetLook":
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

    def __getitem__(self, index: Tensor | slice) -> "TargetBelief":
        """Beliefs of some of the episodes."""
        return TargetBelief(
            self.present[index], self.closest[index], self.nearest[index], self.best[index], self.visited[index]
        )


class TargetObserver:
    """Gathers evidence for the target as `TargetEvidence` learned to: the closest look at each cell counts most.

    Args:
        model: the learned evidence.
    """

    by_target = True

    def __init__(self, model: TargetEvidence) -> None:
        self.model = model

    def start(self, batch: int, grid: Grid, like: Tensor) -> TargetBelief:
        """Even odds in every cell."""
        zeros = like.new_zeros(batch, len(grid))
        return TargetBelief(zeros + 0.5, zeros + torch.inf, zeros, zeros - torch.inf, zeros.bool())

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> TargetLook:
        """What looks from `fixation` `(B, 2)` say about the target."""
        if target is None:
            raise InputError("target: expected a class to search for, got None")
        offset = grid.centres.to(fixation) - fixation[:, None]
        distance = torch.linalg.vector_norm(offset, dim=-1) / grid.extent.amax().to(fixation)
        fixated = grid.cell_of(fixation)[:, None] == torch.arange(len(grid), device=fixation.device)
        return TargetLook(self.model(detections, fixation, grid, target), distance, fixated, grid.columns)

    def update(self, belief: TargetBelief, evidence: TargetLook) -> TargetBelief:
        """Belief after a look in each episode."""
        closer = evidence.distance < belief.closest
        nearest = torch.where(closer, evidence.evidence, belief.nearest)
        best = torch.maximum(evidence.evidence, belief.best)
        closest = torch.minimum(evidence.distance, belief.closest)
        visited = belief.visited | evidence.fixated

        def probability(nearest: Tensor, best: Tensor, closest: Tensor, visited: Tensor) -> Tensor:
            return self.model.log_odds(nearest, best, closest, visited, evidence.columns).sigmoid()

        present = one_by_one(probability, nearest, best, closest, visited)
        return TargetBelief(present, closest, nearest, best, visited)

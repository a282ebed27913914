"""The observer of a searcher that knows what it wants: only where the target is."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.evidence import Gathered
from semfov.belief.grid import Grid
from semfov.belief.look_features import highest_score
from semfov.belief.observers.base import Look, own
from semfov.belief.observers.gathering import EvidenceLook, GatheredBelief, Gatherer
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.detection.detections import Detections
from semfov.errors import InputError


@dataclass(frozen=True)
class TargetLook(EvidenceLook):
    """What looks say about the target in every cell; attributes as for one class in `EvidenceLook`."""


@dataclass(frozen=True)
class TargetBelief(GatheredBelief):
    """Belief about one target alone; attributes as for one class in `GatheredBelief`, and:

    Attributes:
        present: `(B, X·Y)`, probability that a cell holds the target.
        following: `(B, X·Y)`, the same if no fixated cell holds it.
        anywhere: `(B,)`, probability that the image holds it.
    """

    present: Tensor
    following: Tensor
    anywhere: Tensor

    def chance(self, target: int | Tensor) -> Tensor:
        """As for `probability`, if no fixated cell holds the target."""
        return self.following

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability of the target that was searched for, `(B, X·Y)`, whatever `target` is."""
        return self.present

    def presence(self, target: int | Tensor) -> Tensor:
        """Probability that the target that was searched for is anywhere, `(B,)`, whatever `target` is."""
        return self.anywhere


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
        even, anywhere = like.new_full((batch, len(grid)), 0.5), like.new_full((batch,), 0.5)
        return TargetBelief(**self.nothing(batch, grid, like), present=even, following=even, anywhere=anywhere)

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
        all_looks = self.gather(known, said)

        def probabilities(*gathered: Tensor) -> Tensor:
            what = Gathered(*gathered)
            cells = self.model.log_odds(what, said.columns)
            image = self.model.presence(cells, what)[:, None]
            return torch.cat([cells, self.model.chance(what, said.columns), image], -1).sigmoid()

        told = self.each(probabilities, *self.read(all_looks), said.target)
        number = all_looks["closest"].shape[-1]
        present, following, anywhere = told[:, :number], told[:, number:-1], told[:, -1]
        return TargetBelief(**all_looks, present=present, following=following, anywhere=anywhere)

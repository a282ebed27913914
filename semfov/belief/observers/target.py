"""The observer of a search for one target, with learned evidence."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.evidence import Gathered
from semfov.belief.grid import Grid
from semfov.belief.look_features import highest_score
from semfov.belief.observers.base import Look, own
from semfov.belief.observers.gathering import EvidenceLook, GatheredBelief, Gatherer
from semfov.belief.prior import Prior
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.detection.detections import Detections
from semfov.errors import InputError


@dataclass(frozen=True)
class TargetLook(EvidenceLook):
    """Evidence of looks about one class, which is not a row of a map."""


@dataclass(frozen=True)
class TargetBelief(GatheredBelief):
    """Belief about a single target.

    Attributes:
        present: probability that each cell holds it, `(B, X·Y)`.
        following: the same if no fixated cell holds it, `(B, X·Y)`.
        anywhere: probability that the image holds it, `(B,)`.
    """

    present: Tensor
    following: Tensor
    anywhere: Tensor

    def chance(self, target: int | Tensor) -> Tensor:
        return self.following

    def probability(self, target: int | Tensor) -> Tensor:
        return self.present

    def presence(self, target: int | Tensor) -> Tensor:
        return self.anywhere


class Target(Gatherer[TargetEvidence]):
    """Observer with learned evidence for a target (`TargetEvidence`), in which the closest look at a cell counts most.

    Args:
        model: the learned evidence.
        together: compute all episodes of a batch at once; faster, but the rounding then depends on the batch.
        prior: how often the target is there; None: as often as in the searches that the model was trained on.

    >>> observer, grid = Target(TargetEvidence(8, 4, components=3)), Grid(4, 4, (80, 80))  # not trained yet
    >>> seen = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 3), torch.zeros(1, 0, dtype=torch.bool))
    >>> belief = observer(observer.start(1, grid, torch.zeros(1)), seen, torch.tensor([[30.0, 10.0]]), grid, target=1)
    >>> belief.probability(1).shape, belief.visited.nonzero().tolist()
    (torch.Size([1, 16]), [[0, 1]])
    """

    by_target = True

    def __init__(self, model: TargetEvidence, *, together: bool = False, prior: Prior | None = None) -> None:
        super().__init__(model, together=together)
        self.prior = Prior() if prior is None else prior

    @property
    def thresholds(self) -> Thresholds | None:
        """Thresholds of the model."""
        return self.model.thresholds

    def start(self, batch: int, grid: Grid, like: Tensor) -> TargetBelief:
        """Begin with even odds in every cell, and no evidence."""
        even = like.new_full((batch, len(grid)), 0.5)
        anywhere = like.new_full((batch,), 0.5)
        return TargetBelief(**self.nothing(batch, grid, like), present=even, following=even, anywhere=anywhere)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> TargetLook:
        """Weigh the evidence for the target, which must be given."""
        if target is None:
            raise InputError("target: expected a class to search for, got None")
        evidence = self.model(detections, fixation, grid, target)
        score = highest_score(detections, target)
        targets = torch.full((len(fixation),), target, device=fixation.device)
        return TargetLook(evidence, grid.distance(fixation), score, grid.cell_of(fixation), targets, grid.columns)

    def update(self, belief: Belief, look: Look) -> TargetBelief:
        """Gather the evidence of one more look, and compute the probabilities from all of it."""
        target_look = own(look, TargetLook, "look")
        columns = target_look.columns
        all_looks, inputs = self.gather(own(belief, TargetBelief, "belief"), target_look)

        def probabilities(*rows: Tensor) -> Tensor:
            """Compute the fields of the belief from the gathered evidence, side by side, `(B, 2 X·Y + 1)`."""
            gathered = Gathered(*rows)
            cells = self.model.log_odds(gathered, columns)
            image = self.model.presence(cells, gathered)[:, None]
            return torch.cat([cells, self.model.chance(gathered, columns), image], -1).sigmoid()

        # One tensor for all of them, so that a batch is computed row by row in one pass.
        values = self.each(probabilities, *inputs, target_look.target)
        cells = all_looks["closest"].shape[-1]
        present, following = values[:, :-1].split(cells, -1)
        anywhere = values[:, -1]
        return TargetBelief(
            **all_looks,
            present=self.prior.place(present, anywhere[:, None]),
            following=self.prior(following),
            anywhere=self.prior(anywhere),
        )

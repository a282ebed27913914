"""The observer with a learned map: the probability of every class, and of background, in every cell."""

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
    """Evidence of looks about T classes; each stands for `(B, T)` classes: 1, or in training more."""

    stands_for: Tensor


@dataclass(frozen=True)
class MapBelief(GatheredBelief):
    """Belief about all classes `(B, X·Y, K+1)`, as marginal probabilities: several classes can share a cell."""

    probabilities: Tensor

    def class_probabilities(self) -> Tensor:
        return self.probabilities

    def probability(self, target: int | Tensor) -> Tensor:
        return pick(self.probabilities, torch.as_tensor(target))


class LearnedMap(Gatherer[MapEvidence]):
    """Observer with learned evidence for all classes (`MapEvidence`), in which the closest look at a cell counts most.

    Args:
        model: the learned evidence.
        together: compute all episodes of a batch at once; faster, but the rounding then depends on the batch.

    >>> observer, grid = LearnedMap(MapEvidence(8, 4, components=3)), Grid(4, 4, (80, 80))  # not trained yet
    >>> seen = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 3), torch.zeros(1, 0, dtype=torch.bool))
    >>> belief = observer(observer.start(1, grid, torch.zeros(1)), seen, torch.tensor([[30.0, 10.0]]), grid)
    >>> belief.class_probabilities().shape, belief.visited.nonzero().tolist()
    (torch.Size([1, 16, 3]), [[0, 1]])
    """

    def start(self, batch: int, grid: Grid, like: Tensor) -> MapBelief:
        """Begin with the same probability for every class in every cell, and no evidence."""
        classes = len(self.model.prior) - 1
        even = like.new_full((batch, len(grid), classes + 1), 1 / (classes + 1))
        # One row for all classes; it broadcasts over the classes of the first look.
        return MapBelief(**self.nothing(batch, grid, like, 1), probabilities=even)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> MapLook:
        """Weigh the evidence for all classes, the same for every target."""
        classes = torch.arange(1, len(self.model.prior), device=fixation.device)

        def evidence(boxes: Tensor, scores: Tensor, mask: Tensor, point: Tensor) -> Tensor:
            return self.model(Detections(boxes, scores, mask), point, grid, classes)

        targets = classes.expand(len(fixation), -1)
        return MapLook(
            evidence=self.each(evidence, detections.boxes, detections.scores, detections.mask, fixation),
            distance=grid.distance(fixation),
            score=highest_score(detections, classes),
            fixated=grid.cell_of(fixation),
            target=targets,
            columns=grid.columns,
            stands_for=torch.ones_like(targets),
        )

    def update(self, belief: Belief, look: Look) -> MapBelief:
        """Gather the evidence of one more look, and compute the probabilities from all of it."""
        map_look = own(look, MapLook, "look")
        columns = map_look.columns
        all_looks, inputs = self.gather(own(belief, MapBelief, "belief"), map_look)

        def probabilities(*gathered: Tensor) -> Tensor:
            """Compute probabilities `(B, X·Y, T+1)` from the gathered evidence, whose rows are of T classes each."""
            nearest, best, mean, closest, score, looks, visited, targets, stands_for = gathered
            classes = nearest.shape[1]
            rows = Gathered(
                nearest.flatten(0, 1),
                best.flatten(0, 1),
                mean.flatten(0, 1),
                closest.repeat_interleave(classes, 0),
                score.flatten(),
                looks.repeat_interleave(classes, 0),
                visited.repeat_interleave(classes, 0),
                targets.flatten(),
            )
            cells = self.model.log_odds(rows, columns, classes)
            nothing = self.model.emptiness(cells, closest, looks, columns, stands_for)
            return torch.cat([nothing[:, None], cells], 1).sigmoid().transpose(1, 2)

        values = self.each(probabilities, *inputs, map_look.target, map_look.stands_for)
        return MapBelief(**all_looks, probabilities=values)

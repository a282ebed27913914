"""The observer that keeps where eyes land on the objects that were detected, rather than where the objects are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one, pick
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer, own
from semfov.detection.detections import Detections
from semfov.errors import check

HEAD = 0.18
"""Where a head is in a person's box, in heights from its top."""


@dataclass(frozen=True)
class LandingLook(Look):
    """What looks say about where eyes land.

    Attributes:
        evidence: `(B, X·Y, K)`, of each class.
        distance: `(B, X·Y)`, from the fixation, in longer sides of the image.
    """

    evidence: Tensor
    distance: Tensor

    def __getitem__(self, index: Tensor | slice) -> LandingLook:
        """Some of the looks."""
        return LandingLook(self.evidence[index], self.distance[index])

    @classmethod
    def join(cls, looks: Sequence[LandingLook]) -> LandingLook:
        """All looks of several batches."""
        return cls(torch.cat([look.evidence for look in looks]), torch.cat([look.distance for look in looks]))


@dataclass(frozen=True)
class LandingBelief(Belief):
    """Evidence, from 0 to 1, that eyes land in each cell for an object of each class; no probability to decide by.

    Attributes:
        evidence: `(B, X·Y, K)`, strongest of any look.
        closest: `(B, X·Y)`, see `Belief`.
    """

    evidence: Tensor
    closest: Tensor

    def class_probabilities(self) -> Tensor:
        """The evidence as it is, and before it, for background, what the strongest of a cell leaves."""
        return torch.cat([1 - self.evidence.amax(-1, keepdim=True), self.evidence], -1)

    def probability(self, target: int | Tensor) -> Tensor:
        """The evidence for the target."""
        return pick(self.class_probabilities(), torch.as_tensor(target))

    def map(self, function: Callable[[Tensor], Tensor]) -> LandingBelief:
        """The belief with all tensors replaced."""
        return LandingBelief(function(self.evidence), function(self.closest))


class Landing(Observer):
    r"""Where eyes land: near the centres of detected objects, at the heads of persons, small objects above large ones.

    A detection with box centre :math:`(x_b, y_b)`, size :math:`(w, h)` and scores s is evidence for class k

    .. math:: e_k(x) = s_k \, \frac{r}{\sqrt{\sigma_x \sigma_y}}
              \exp\left( -\frac{(x - x_b)^2}{2\sigma_x^2} - \frac{(y - y_b)^2}{2\sigma_y^2} \right)

    with :math:`\sigma = \max(r, a\,(w, h))`. The strongest evidence of any detection and look is kept. Saccades land
    near the centres of objects (Nuthmann and Henderson, 2010): a is 1/4. Of persons people look at the head (Yarbus,
    1967; Cerf et al., 2009): there :math:`y_b` is 0.18 heights below the box's top, and a is 0.15. With the factor,
    what an object draws in all grows with its side, not with its area.

    Args:
        classes: K.
        person: class of persons; None where the detector has none.
        reach: r in longer sides of the image: how narrow a landing place may be.

    >>> grid = Grid(4, 4, (80, 80))
    >>> boxes, scores = torch.tensor([[[0.0, 0.0, 20.0, 40.0]]]), torch.tensor([[[0.2, 0.8]]])
    >>> seen = Detections(boxes, scores, torch.ones(1, 1).bool())
    >>> belief = (observer := Landing(1))(observer.start(1, grid, torch.zeros(1)), seen, torch.zeros(1, 2), grid)
    >>> belief.probability(1).argmax().item()
    0
    """

    def __init__(self, classes: int, person: int | None = 1, reach: float = 15 / 800) -> None:
        super().__init__()
        check(classes >= 1, "classes", "at least 1", classes)
        check(person is None or 1 <= person <= classes, "person", f"a class from 1 to {classes}, or None", person)
        check(0 < reach <= 1, "reach", "longer sides above 0, up to 1", reach)
        self.classes, self.person, self.reach = classes, person, reach

    def start(self, batch: int, grid: Grid, like: Tensor) -> LandingBelief:
        """No evidence."""
        none = like.new_zeros(batch, len(grid), self.classes)
        return LandingBelief(none, like.new_full((batch, len(grid)), torch.inf))

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> LandingLook:
        """What looks from `fixation` `(B, 2)` say, whatever `target` is."""
        centres = grid.centres.to(detections.scores)
        floor = self.reach * grid.extent.max().to(centres)

        def evidence(boxes: Tensor, scores: Tensor, mask: Tensor) -> Tensor:
            scores = torch.where(mask[..., None], scores[..., 1:], 0.0)
            x1, y1, x2, y2 = boxes.unbind(-1)
            person = torch.zeros_like(mask) if self.person is None else scores.argmax(-1) == self.person - 1
            share = torch.where(person, 0.15, 0.25).to(scores)
            across, down = ((share * side).clamp(min=floor) for side in (x2 - x1, y2 - y1))
            height = y1 + torch.where(person, HEAD, 0.5).to(scores) * (y2 - y1)
            # Box edges are half a pixel off pixel centres.
            x = (centres[:, 0] + 0.5 - ((x1 + x2) / 2)[..., None]) / across[..., None]
            y = (centres[:, 1] + 0.5 - height[..., None]) / down[..., None]
            kernel = (-(x.square() + y.square()) / 2).exp() * (floor / (across * down).sqrt())[..., None]
            strongest = kernel.new_zeros(*kernel.shape[:-2], len(grid), self.classes)
            # One detection at a time: all at once would be detections × cells × classes.
            for place, score in zip(kernel.unbind(-2), scores.unbind(-2), strict=True):
                strongest = torch.maximum(strongest, place[..., None] * score[..., None, :])
            return strongest

        said = one_by_one(evidence, detections.boxes, detections.scores, detections.mask)
        return LandingLook(said, grid.distance(fixation))

    def update(self, belief: Belief, look: Look) -> LandingBelief:
        """Belief after a look in each episode."""
        known, said = own(belief, LandingBelief, "belief"), own(look, LandingLook, "look")
        closest = torch.minimum(said.distance, known.closest)
        return LandingBelief(torch.maximum(said.evidence, known.evidence), closest)

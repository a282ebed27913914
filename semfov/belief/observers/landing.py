"""The observer of landing places: where human eyes land on detected objects, instead of where the objects are."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one, pick
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer, own
from semfov.detection.detections import Detections
from semfov.errors import check

_HEAD = 0.18
"""Height of a person's head below the top of the box, in heights of the box."""


@dataclass(frozen=True)
class LandingLook(Look):
    """Evidence of looks about landing places.

    Attributes:
        evidence: `(B, X·Y, K)`, evidence of each class, from 0 to 1.
        distance: `(B, X·Y)`, from the fixation to every cell, in longer sides of the image.

    >>> LandingLook(torch.zeros(2, 4, 1), torch.zeros(2, 4))[:1].evidence.shape
    torch.Size([1, 4, 1])
    """

    evidence: Tensor
    distance: Tensor


@dataclass(frozen=True)
class LandingBelief(Belief):
    """Evidence, from 0 to 1, that eyes land in each cell on an object of each class; not a calibrated probability.

    Attributes:
        evidence: `(B, X·Y, K)`, strongest evidence of any look.
        closest: `(B, X·Y)`, see `Belief`.

    >>> belief = LandingBelief(torch.tensor([[[0.7, 0.2]]]), torch.zeros(1, 1))  # one cell, two classes
    >>> belief.class_probabilities()
    tensor([[[0.3000, 0.7000, 0.2000]]])
    """

    evidence: Tensor
    closest: Tensor

    def class_probabilities(self) -> Tensor:
        """The evidence of every class, and for background one minus the strongest evidence of the cell."""
        return torch.cat([1 - self.evidence.amax(-1, keepdim=True), self.evidence], -1)

    def probability(self, target: int | Tensor) -> Tensor:
        """The evidence for the target in each cell, `(B, X·Y)`."""
        return pick(self.class_probabilities(), torch.as_tensor(target))


class Landing(Observer):
    r"""Observer of landing places: near the centres of detected objects, and on the heads of persons.

    A detection with box centre :math:`(x_b, y_b)`, size :math:`(w, h)` and scores s gives the evidence for class k

    .. math:: e_k(x) = s_k \, \frac{r}{\sqrt{\sigma_x \sigma_y}}
              \exp\left( -\frac{(x - x_b)^2}{2\sigma_x^2} - \frac{(y - y_b)^2}{2\sigma_y^2} \right)

    where :math:`\sigma = \max(r, a\,(w, h))`. A cell keeps the strongest evidence of any detection and look. Saccades
    land near the centres of objects (Nuthmann and Henderson, 2010), so a is 1/4. On persons people look at the head
    (Yarbus, 1967; Cerf et al., 2009): there :math:`y_b` is 0.18 heights below the top of the box, and a is 0.15. The
    factor before the exponential makes the total evidence of an object grow with its side length, not with its area.

    Args:
        classes: K, number of classes without background.
        person: class index of persons; None if the detector has no such class.
        reach: r, smallest standard deviation of a landing place, in longer sides of the image.

    Raises:
        InputError: an argument is out of range.

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
        check(0 < reach <= 1, "reach", "a number above 0, up to 1, in longer sides of the image", reach)
        self.classes, self.person, self.reach = classes, person, reach

    def start(self, batch: int, grid: Grid, like: Tensor) -> LandingBelief:
        """No evidence."""
        none = like.new_zeros(batch, len(grid), self.classes)
        return LandingBelief(none, like.new_full((batch, len(grid)), torch.inf))

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> LandingLook:
        """Evidence of all classes, the same for every target."""
        centres = grid.centres.to(detections.scores)
        floor = self.reach * grid.extent.max().to(centres)

        def evidence(boxes: Tensor, scores: Tensor, mask: Tensor) -> Tensor:
            scores = torch.where(mask[..., None], scores[..., 1:], 0.0)
            x1, y1, x2, y2 = boxes.unbind(-1)
            person = torch.zeros_like(mask) if self.person is None else scores.argmax(-1) == self.person - 1
            share = torch.where(person, 0.15, 0.25).to(scores)
            across, down = ((share * side).clamp(min=floor) for side in (x2 - x1, y2 - y1))
            height = y1 + torch.where(person, _HEAD, 0.5).to(scores) * (y2 - y1)
            # Coordinates of boxes and of pixel centres differ by half a pixel.
            x = (centres[:, 0] + 0.5 - ((x1 + x2) / 2)[..., None]) / across[..., None]
            y = (centres[:, 1] + 0.5 - height[..., None]) / down[..., None]
            kernel = (-(x.square() + y.square()) / 2).exp() * (floor / (across * down).sqrt())[..., None]
            strongest = kernel.new_zeros(*kernel.shape[:-2], len(grid), self.classes)
            # One detection at a time: all at once would need memory for detections × cells × classes.
            for place, score in zip(kernel.unbind(-2), scores.unbind(-2), strict=True):
                strongest = torch.maximum(strongest, place[..., None] * score[..., None, :])
            return strongest

        by_class = one_by_one(evidence, detections.boxes, detections.scores, detections.mask)
        return LandingLook(by_class, grid.distance(fixation))

    def update(self, belief: Belief, look: Look) -> LandingBelief:
        """Keep the strongest evidence of each cell."""
        belief, look = own(belief, LandingBelief, "belief"), own(look, LandingLook, "look")
        closest = torch.minimum(look.distance, belief.closest)
        return LandingBelief(torch.maximum(look.evidence, belief.evidence), closest)

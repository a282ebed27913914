"""Closer looks of a search in a large picture, at places that seem to hold its target."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification, closer_features
from semfov.decision import SAME, CloserLook, surely, verified
from semfov.observation.matching import box_iou
from semfov.sensor.glimpse import window_around
from semfov.zoom.gist import FOUND
from semfov.zoom.glances import Glance, Glances, Window, around
from semfov.zoom.lattice import Lattice

CONTEXT = 3.0
"""Side of the window of a closer look, in longer sides of the examined box."""

_SMALLEST = 1e-4


@dataclass(frozen=True)
class Suspect:
    """A place that seems to hold the target.

    Attributes:
        box: `(4,)`, box of the detection.
        score: its score for the target.
        probability: probability that the target is there.
    """

    box: Tensor
    score: float
    probability: float


def closer_window(lattice: Lattice, box: Tensor) -> Window:
    """The window that shows a box closely, with its surroundings.

    It is three times as large as the longer side of the box (`semfov.sensor.glimpse.window_around`), but its
    magnification is at most one octave above that of the last level: pictures show no more beyond it.

    Args:
        lattice: lattice of the picture.
        box: `(4,)`, as `(x1, y1, x2, y2)` in picture pixels.

    Returns:
        The window.

    >>> lattice = Lattice.over((2560, 1920), (416, 416))
    >>> closer_window(lattice, torch.tensor([600.0, 600.0, 800.0, 700.0])).within
    (400.0, 350.0, 1000.0, 950.0)
    >>> x1, _, x2, _ = closer_window(lattice, torch.tensor([600.0, 600.0, 610.0, 620.0])).within
    >>> x2 - x1, 416 / (2 * lattice.magnifications[-1])
    (320.0, 320.0)
    """
    smallest = min(lattice.canvas) / (2 * lattice.magnifications[-1])
    window = window_around(box.double(), lattice.size, context=CONTEXT, least=smallest / max(lattice.size))
    x1, y1, x2, y2 = window.tolist()
    return around(lattice, (x1, y1, x2, y2))


class Suspects:
    r"""Places that seem to hold the target of one search, the most evident first, each listed once.

    The next one is the detection with the highest score s of the target that does not overlap an examined place by
    half. The probability that the target is there is taken from the probability P that the picture holds the target,
    which follows from the highest score :math:`s^*` of the search:

    .. math:: \operatorname{logit} p = \operatorname{logit} P + \operatorname{logit} s - \operatorname{logit} s^*

    Args:
        glances: source of looks at the picture.
        target: class 1..K.
    """

    def __init__(self, glances: Glances, target: int) -> None:
        self.glances, self.target = glances, target
        self._boxes, self._scores = torch.zeros(0, 4), torch.zeros(0)
        self._examined: list[Tensor] = []

    def see(self, glance: Glance) -> None:
        """Add the detections of a look."""
        scores = glance.detections.scores[0, :, self.target]
        shown = glance.detections.mask[0] & (scores >= FOUND)
        self._boxes = torch.cat([self._boxes, glance.detections.boxes[0][shown]])
        self._scores = torch.cat([self._scores, scores[shown]])

    def next(self, presence: float, best: float) -> Suspect | None:
        """Find the place that is to be examined next.

        Args:
            presence: probability that the picture holds the target.
            best: highest score of the target in any look.

        Returns:
            The place; None if no detection is left.
        """
        scores = self._scores
        if self._examined:
            again = (box_iou(self._boxes, torch.stack(self._examined)) >= SAME).any(-1)
            scores = scores.masked_fill(again, 0)
        if not len(scores) or float(scores.max()) <= 0:
            return None
        number = int(scores.argmax())
        picture, place, top = torch.tensor([presence, float(scores[number]), best]).logit(_SMALLEST)
        return Suspect(self._boxes[number], float(scores[number]), float((picture + place - top).sigmoid()))

    def examine(self, suspect: Suspect, presence: float) -> tuple[Glance, Tensor, Tensor]:
        """Look closely at a place, and do not list it again.

        Args:
            suspect: the place.
            presence: probability that the picture holds the target.

        Returns:
            The look, its features `(7,)`, and the box of the target in it `(4,)` (`semfov.belief.verification`).
        """
        glance = self.glances.see([closer_window(self.glances.lattice, suspect.box)], hints=False)[0]
        features, box = closer_features(
            presence, suspect.probability, suspect.score, glance.detections, suspect.box, self.target
        )
        self._examined += [suspect.box, box]
        return glance, features, box


class ZoomVerifier:
    """Looks closely at places of a large picture before a search decides (small ones: `semfov.decision.Verifier`).

    A place is examined if the target is there with a probability of `likely`, or of the threshold `place` when no other
    look follows. The search ends at once if a closer look shows the target with a probability halfway between `confirm`
    and 1, or more. Otherwise it goes on until no look is worth a pass, or `most` closer looks were made. Then it has
    found the target at the best of the examined places, if that is probable enough.

    Args:
        model: gives the probabilities after closer looks.
        glances: source of looks at the picture.
        target: class 1..K.
        thresholds: thresholds for the probability of a place (`semfov.belief.Verification`).
        likely: probability from which on a place is examined at once: without closer looks the search would end with
            `found`.
        most: largest number of closer looks.

    Attributes:
        looks: closer looks so far.
    """

    def __init__(
        self, model: Verification, glances: Glances, target: int, thresholds: Thresholds, likely: float, most: int
    ) -> None:
        self.model, self.thresholds, self.likely, self.most = model, thresholds, likely, most
        self.suspects = Suspects(glances, target)
        self.looks: list[CloserLook] = []

    def __call__(
        self, presence: float, best: float, number: int, room: int, *, over: bool
    ) -> list[tuple[Glance, float]]:
        """Make the closer looks that are due after a look.

        Args:
            presence: probability that the picture holds the target.
            best: highest score of the target in any look.
            number: number of looks so far.
            room: number of passes that are left.
            over: whether no other look follows.

        Returns:
            The looks, each with the probability of its place before it.
        """
        made: list[tuple[Glance, float]] = []
        least = self.thresholds.place if over else self.likely
        while len(self.looks) < self.most and len(made) < room:
            suspect = self.suspects.next(presence, best)
            if suspect is None or suspect.probability < least:
                break
            glance, features, box = self.suspects.examine(suspect, presence)
            with torch.no_grad():
                place, after = self.model(features).sigmoid().tolist()
            self.looks.append(
                CloserLook(None, self.suspects.target, None, box, place, after, number=number + len(made))
            )
            made.append((glance, suspect.probability))
            if place >= surely(self.thresholds.confirm):
                break
        return made

    def outcome(self, presence: float, *, over: bool) -> int:
        """Decide.

        Args:
            presence: probability that the picture holds the target, from all looks but the closer ones.
            over: whether no further look follows.

        Returns:
            0 for a search that continues, otherwise the number of its outcome in `semfov.decision.OUTCOMES`.
        """
        over = over or len(self.looks) >= self.most
        places = [look.place for look in self.looks]
        return verified(places, self.presence(presence), self.thresholds.confirm, over=over)

    def presence(self, presence: float) -> float:
        """Probability that the picture holds the target: the largest after a closer look, or the one that is given."""
        return max((look.presence for look in self.looks), default=presence)

    def best(self) -> CloserLook:
        """The closer look with the largest probability of the place; there must be one."""
        return max(self.looks, key=lambda look: look.place)

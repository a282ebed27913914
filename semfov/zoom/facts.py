"""Facts about the looks of a search, from which the presence of the target in the picture is predicted."""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.gist import DETECTION_SCORE
from semfov.zoom.glances import Glance
from semfov.zoom.lattice import CELLS, Lattice
from semfov.zoom.networks import features


class LookFacts(NamedTuple):
    """What one look of a search shows of the target.

    Attributes:
        score: highest score of the target in any hint.
        closest: the same for a look of the last level; 0 for others.
        named: highest score of the target in a detection whose best class it is; 0 without one.
        found: highest score of the target in any detection; 0 without one.
        box: `(4,)`, box of that detection; None if there is none.
    """

    score: float
    closest: float
    named: float
    found: float
    box: Tensor | None

    @classmethod
    def of(cls, glance: Glance, target: int, lattice: Lattice) -> Self:
        """The facts of a look."""
        score = float(glance.show[target - 1])
        closest = score if glance.window.level == lattice.levels - 1 else 0.0
        detections = glance.detections
        scores = detections.scores[0, :, target].detach().float().numpy()
        if not len(scores):
            return cls(score, closest, 0.0, 0.0, None)
        named = scores[detections.labels[0].numpy() == target].max(initial=0)
        place = int(scores.argmax())
        return cls(score, closest, float(named), float(scores[place]), detections.boxes[0, place])


class SearchFacts:
    """What the looks of a search have shown of the target, and what is left to see.

    Args:
        belief: belief of the search; it is updated with each look before these facts are.

    Attributes:
        looks: the facts of each look.
    """

    def __init__(self, belief: ZoomBelief) -> None:
        self.belief = belief
        self.looks: list[LookFacts] = []

    def see(self, looks: Sequence[Glance]) -> None:
        """Take the looks that count after another look; those of earlier ones that are missing were forgotten."""
        if len(looks) != len(self.looks) + 1:
            self.looks = []
        for glance in looks[len(self.looks) :]:
            self.add(glance)

    def add(self, glance: Glance) -> None:
        """Add the facts of a look."""
        self.looks.append(LookFacts.of(glance, self.belief.target, self.belief.lattice))

    @property
    def best(self) -> float:
        """Highest score of the target in any look."""
        return max(look.score for look in self.looks)

    @property
    def box(self) -> Tensor | None:
        """Box `(4,)` of the detection with the highest score of the target; None if there is none."""
        best = max(self.looks, key=lambda look: look.found)
        return best.box if best.found > 0 else None

    @property
    def detected(self) -> bool:
        """Whether a detection shows the target, so that a search can name a box as found."""
        return any(look.found >= DETECTION_SCORE for look in self.looks)

    def case(self, ahead: float) -> Tensor:
        """Facts about the search for `GlimpseEvidence.anywhere`.

        As features of scores: the highest and the second highest score of the target in a look, the highest in a look
        of the last level, the score in the overview, the highest of a detection whose best class is the target, and the
        value of the best look that is left. As a logarithm: the number of looks of the last level, side by side over
        the picture, that are still expected to show the target. Then the share of the picture that is left to see. As
        logarithms: the number of looks with a score of 0.1 or more, and the number of looks.

        Args:
            ahead: value of the best look that is left.

        Returns:
            `(10,)`.
        """
        looks = self.looks
        best, second, *_ = sorted([*(look.score for look in looks), 0.0], reverse=True)
        closest, named = max(look.closest for look in looks), max(look.named for look in looks)
        hints = features(torch.tensor([best, second, closest, looks[0].score, named, ahead], dtype=torch.float32))
        left = [math.log(self._left() + 1e-3) / 4, float(self.belief.left.mean())]
        counts = [math.log1p(sum(look.score >= DETECTION_SCORE for look in looks)) / 2, math.log(len(looks)) / 2]
        return torch.cat([hints, torch.tensor([*left, *counts])])

    def _left(self) -> float:
        """Number of looks of the last level, side by side over the picture, that are expected to show the target."""
        last = self.belief.lattice.levels - 1
        # Windows start at every cell: this is the mean over all ways to lay them side by side.
        return float(self.belief.chances(last).sum()) / CELLS**2 if last else 0.0

    @torch.no_grad()
    def presence(self, ahead: float) -> float:
        """Predict whether the picture holds the target.

        Args:
            ahead: value of the best look that is left.

        Returns:
            The probability.
        """
        odds = self.belief.evidence.anywhere(torch.tensor(self.best), self.case(ahead))
        return float(odds.sigmoid())

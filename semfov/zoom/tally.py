"""What the looks of a search tell, taken together: whether the picture holds the target at all."""

import math

import torch
from torch import Tensor

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.evidence import features
from semfov.zoom.gist import FOUND
from semfov.zoom.glances import Glance


class Tally:
    """What has been seen of a class in a picture, and what is left to see.

    Args:
        belief: of the search, which takes account of every look before the tally does.

    Attributes:
        best: highest score of the class in any look.
        box: `(4,)`, of the detection that says most of it; None where none does.
    """

    def __init__(self, belief: ZoomBelief) -> None:
        self.belief = belief
        self.best, self.box = 0.0, None
        self._second = self._closest = self._first = self._named = self._found = 0.0
        self._looks = self._seen = 0
        self._expected = 0.0

    box: Tensor | None

    def add(self, glance: Glance) -> None:
        """Count a look."""
        target = self.belief.target
        score = float(glance.show[target - 1])
        self.best, self._second = max(self.best, score), max(min(self.best, score), self._second)
        if glance.window.level == self.belief.lattice.levels - 1:
            self._closest = max(self._closest, score)
        if not self._looks:
            self._first, self._expected = score, self._left()
        self._looks += 1
        self._seen += score >= FOUND
        detections = glance.detections
        if detections.scores.shape[1]:
            told = detections.scores[0, :, target]
            place = int(told.argmax())
            if float(told[place]) > self._found:
                self._found, self.box = float(told[place]), detections.boxes[0, place]
            named = told[detections.labels[0] == target]
            self._named = max([self._named, *named.tolist()])

    @property
    def looked(self) -> bool:
        """Whether a detection shows the class, so that there is something to be named as found."""
        return self._found >= FOUND

    def case(self, ahead: float) -> Tensor:
        """What the looks tell of the class, `(11,)`, for `GlimpseEvidence.anywhere`.

        The highest and the second highest score of a look; the highest of the closest looks, of the overview, and of a
        detection that is rather of this class than of another; how many looks showed it with a score of 0.1. What
        another look is worth; how many objects closest looks are expected to find still, and were after the overview;
        what share of the picture is left to see; and how many looks there were.

        Args:
            ahead: what the best look that is left is worth.
        """
        scores = [self.best, self._second, self._closest, self._first, self._named, ahead]
        hints = features(torch.tensor(scores, dtype=torch.float32))
        left = [math.log(expected + 1e-3) / 4 for expected in (self._left(), self._expected)]
        counts = [math.log1p(self._seen) / 2, math.log(self._looks) / 2]
        return torch.cat([hints, torch.tensor([*left, float(self.belief.left.mean()), *counts])])

    def _left(self) -> float:
        """Objects that closest looks are expected to find."""
        return float(self.belief.expected(self.belief.lattice.levels - 1).sum())

    @torch.no_grad()
    def presence(self, ahead: float) -> float:
        """Probability that the picture holds the class; arguments as for `case`."""
        odds = self.belief.evidence.anywhere(torch.tensor(self.best), self.case(ahead))
        return float(odds.sigmoid())

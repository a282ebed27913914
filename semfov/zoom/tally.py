"""Summary of all looks of a search, from which the presence of the target in the picture is predicted."""

import math

import torch
from torch import Tensor

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.gist import FOUND
from semfov.zoom.glances import Glance
from semfov.zoom.lattice import CELLS
from semfov.zoom.networks import features


class Tally:
    """What the looks of a search have shown of the target, and what is left to see.

    Args:
        belief: belief of the search; it is updated with each look before the tally is.

    Attributes:
        best: highest score of the target in any look.
        box: `(4,)`, box of the detection with the highest score of the target; None if there is none.
    """

    def __init__(self, belief: ZoomBelief) -> None:
        self.belief = belief
        self.best, self.box = 0.0, None
        self._second = self._closest = self._first = self._named = self._found = 0.0
        self._looks = self._seen = 0

    box: Tensor | None

    def add(self, glance: Glance) -> None:
        """Update the summary with the result of a look."""
        target = self.belief.target
        score = float(glance.show[target - 1])
        self.best, self._second = max(self.best, score), max(min(self.best, score), self._second)
        if glance.window.level == self.belief.lattice.levels - 1:
            self._closest = max(self._closest, score)
        if not self._looks:
            self._first = score
        self._looks += 1
        self._seen += score >= FOUND
        detections = glance.detections
        told = detections.scores[0, :, target].detach().float().numpy()
        if not len(told):
            return
        place = int(told.argmax())
        if told[place] > self._found:
            self._found, self.box = float(told[place]), detections.boxes[0, place]
        if told[place] > self._named:
            named = told[detections.labels[0].numpy() == target]
            self._named = max([self._named, *named.tolist()])

    @property
    def looked(self) -> bool:
        """Whether a detection shows the target, so that a search can name a box as found."""
        return self._found >= FOUND

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
        scores = [self.best, self._second, self._closest, self._first, self._named, ahead]
        hints = features(torch.tensor(scores, dtype=torch.float32))
        left = [math.log(self._left() + 1e-3) / 4, float(self.belief.left.mean())]
        counts = [math.log1p(self._seen) / 2, math.log(self._looks) / 2]
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

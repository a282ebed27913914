"""Verification of the target by closer looks, before a search decides."""

from collections.abc import Callable

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.any_of import class_meant
from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification
from semfov.decision.candidates import CandidatePlace, CandidatePlaces
from semfov.decision.closer_look import CloserLook
from semfov.decision.evidence import cell_of
from semfov.decision.rule import OUTCOMES, Decision, place_known, surely, verified
from semfov.detection.detections import Detections
from semfov.episode import Forgetting, Step
from semfov.errors import check, check_whole

MOST = 2
"""Default for the largest number of closer looks in a search."""


class Examiner:
    """Looks closely at the places of one search that seem to hold the target.

    `Verifier` does it in a picture, and `semfov.decision.LiveVerifier` in a stream of frames.

    Args:
        model: gives the probabilities after closer looks.
        grid: the cells.
        target: class 1..K.
        thresholds: see `Verification`; None takes those of the model.
        most: largest number of closer looks.
        forgetting: forgetting between frames; None forgets nothing.

    Raises:
        InputError: no thresholds are given and the model has none, or `most` is out of range.
    """

    def __init__(
        self,
        model: Verification,
        grid: Grid,
        target: int,
        thresholds: Thresholds | None,
        most: int,
        forgetting: Forgetting | None = None,
    ) -> None:
        thresholds = model.thresholds if thresholds is None else thresholds
        check(thresholds is not None, "thresholds", "thresholds, since the model has none", None)
        assert thresholds is not None
        self.model, self.target, self.thresholds = model, target, thresholds
        check_whole(most, "most", 1, 100)
        self.most = most
        self.candidates = CandidatePlaces(grid, forgetting)

    def over(self, step: Step) -> bool:
        """Whether no cell is worth a further fixation after a step of one search."""
        left = step.belief.chance(self.target).masked_fill(step.visited, 0).amax()
        return float(left) < self.thresholds.give_up

    def due(self, step: Step, *, over: bool) -> CandidatePlace | None:
        """Find the place that is to be looked at closely after a step.

        Args:
            step: a step of one search.
            over: whether no further fixation follows. Otherwise the most probable place must have been fixated.

        Returns:
            The place; None if none is probable enough.
        """
        cells, least = step.belief.probability(self.target)[0], self.thresholds.place
        if not (over or bool(place_known(self.candidates.open(cells), step.visited[0], least))):
            return None
        candidate = self.candidates.next(cells, class_meant(step.belief, self.target))
        return None if candidate is None or candidate.probability < least else candidate

    def examine(self, step: Step, candidate: CandidatePlace, close_up: Callable[[Tensor], Detections]) -> CloserLook:
        """Look closely at a place.

        Args:
            step: the last step of the search.
            candidate: the place.
            close_up: looks closely at a box `(4,)` (`semfov.Eye.close_up`).

        Returns:
            The closer look.
        """
        presence, target = float(step.belief.presence(self.target)), class_meant(step.belief, self.target)
        features, box = self.candidates.examine(candidate, presence, close_up, target)
        place, presence = self.model(features.to(self.model.linear.weight)).sigmoid().tolist()
        return CloserLook(step.shift, target, cell_of(box, self.candidates.grid), box, place, presence)


class Verifier(Examiner):
    """Decides one search, with closer looks at the places that seem to hold the target.

    When a fixated cell is probably the target's, or when no cell is worth a further fixation, the most evident place is
    looked at closely. The search ends at once if the target is there with a probability halfway between `confirm`
    and 1, or more (`surely`). Otherwise it goes on, until no cell is worth a fixation, or `most` closer looks were
    made. Then it has found the target at the best of the examined places, if that is probable enough. If not, the
    target is absent or the search undecided, by the probability that the image holds it.

    Args:
        model: gives the probabilities after closer looks.
        close_up: looks closely at a box `(4,)` (`semfov.Eye.close_up`).
        grid: the cells.
        target: class 1..K.
        thresholds: see `Verification`; None takes those of the model.
        most: largest number of closer looks.

    Raises:
        InputError: no thresholds are given and the model has none, or `most` is out of range.

    Example::

        verifier = Verifier(Verification.from_pretrained("yolox-nano"), partial(eye.close_up, image), grid, target)
        for step in rollout(looks, observer, policy, start, choice, most=31, ends=lambda step: verifier(step) > 0):
            ...
        print(verifier.conclude(step), verifier.looks)
    """

    def __init__(
        self,
        model: Verification,
        close_up: Callable[[Tensor], Detections],
        grid: Grid,
        target: int,
        thresholds: Thresholds | None = None,
        most: int = MOST,
    ) -> None:
        super().__init__(model, grid, target, thresholds, most)
        self.close_up = close_up
        self.looks: list[CloserLook] = []
        self._outcome = 0

    def __call__(self, step: Step) -> Tensor:
        """Decide whether the search ends with a step. Call it once for every step, in order.

        Args:
            step: a step of one search.

        Returns:
            `(1,)`, 0 for a search that continues, otherwise the number of its outcome in `OUTCOMES`.
        """
        self.candidates.see(step.detections)
        self._outcome = self._verify(step, over=self.over(step))
        return torch.full_like(step.cell, self._outcome)

    def conclude(self, step: Step) -> Decision:
        """Make the decision of the search.

        Args:
            step: the last step. If the search did not end with it, all its fixations are spent: what is left of closer
                looks is made now.

        Returns:
            The decision.
        """
        outcome = self._outcome or self._verify(step, over=True)
        presence = self._presence(step.belief)
        if OUTCOMES[outcome] != "found":
            return Decision(OUTCOMES[outcome], presence)
        best = self.best()
        return Decision("found", max(presence, best.place), best.cell, best.box, best.place)

    def _verify(self, step: Step, *, over: bool) -> int:
        """Make the closer looks that are due after a step, and return the outcome."""
        while len(self.looks) < self.most:
            candidate = self.due(step, over=over)
            if candidate is None:
                break
            self.looks.append(self.examine(step, candidate, self.close_up))
            if self.looks[-1].place >= surely(self.thresholds.confirm):
                break
        over = over or len(self.looks) >= self.most
        places = [look.place for look in self.looks]
        return verified(places, self._presence(step.belief), self.thresholds.confirm, over=over)

    def best(self) -> CloserLook:
        """The closer look with the largest probability of the place.

        Returns:
            The closer look; there must be at least one.
        """
        return max(self.looks, key=lambda look: look.place)

    def _presence(self, belief: Belief) -> float:
        """Probability that the image holds the target: the largest after a closer look, or that of the belief."""
        return max((look.presence for look in self.looks), default=float(belief.presence(self.target)))

"""Verification of the target by closer looks, before a search decides."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.any_of import class_meant
from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification, closer_features
from semfov.decision import OUTCOMES, Decision, place_known, strength, strongest
from semfov.detection.detections import Detections
from semfov.episode import Forgetting, Step
from semfov.errors import check, check_whole
from semfov.observation.matching import box_iou

MOST = 2
"""Default for the largest number of closer looks in a search."""

SAME = 0.5
"""Boxes with at least this overlap (intersection over union) are of the same object."""

_COVERED = 0.5  # cells that an examined box covers with at least this weight are not examined again
_MOST_LOOKS = 1000  # largest number of looks at a stream whose detections are kept


@dataclass(frozen=True)
class CloserLook:
    """A closer look at a place that seems to hold the target.

    Attributes:
        fixation: number of the fixation after which it was made.
        target: the class that was looked for, 1..K; in a search for several classes the most probable one at that time.
        cell: the cell of the target, if it is there.
        box: `(4,)`, the box of the target as `(x1, y1, x2, y2)` in pixels, if it is there.
        place: probability that the target is there.
        presence: probability that the image holds the target, after the closer look.
    """

    fixation: int
    target: int
    cell: int
    box: Tensor
    place: float
    presence: float


@dataclass(frozen=True)
class CandidatePlace:
    """A place that seems to hold the target.

    Attributes:
        cell: the cell.
        box: `(4,)`, box of the detection with the strongest evidence there.
        evidence: that evidence (`strongest`).
        probability: probability that the cell holds the target.
    """

    cell: int
    box: Tensor
    evidence: float
    probability: float


@dataclass(frozen=True)
class _Dismissed:
    """Boxes `(2, 4)` and cells `(X·Y,)` of a place that was examined at a frame."""

    frame: int
    boxes: Tensor
    cells: Tensor


class CandidatePlaces:
    """Places that seem to hold the target of one search, the most evident first, each listed once.

    A candidate is the cell with the largest product of probability and evidence. Detections that overlap a box that was
    examined by half, and the cells that it covers, are left out.

    In a scene that changes, evidence of earlier frames counts less, and places that were examined are listed again when
    half of the evidence is left (`semfov.episode.Forgetting`).

    Args:
        grid: the cells.
        forgetting: forgetting between frames (`wait`); None forgets nothing.
    """

    def __init__(self, grid: Grid, forgetting: Forgetting | None = None) -> None:
        self.grid = grid
        self.forgetting = Forgetting() if forgetting is None else forgetting
        self._frame = 0
        self._looks: list[tuple[int, Detections]] = []  # with their frames
        self._dismissed: list[_Dismissed] = []

    def see(self, look: Detections) -> None:
        """Add the detections of a look, a batch of one."""
        self._looks.append((self._frame, look))

    def wait(self) -> None:
        """Let a frame pass: drop looks, and list places again, of which less than half the evidence is left."""
        self._frame += 1
        oldest = self._frame - self.forgetting.span
        self._looks = [(frame, look) for frame, look in self._looks[-_MOST_LOOKS:] if frame >= oldest]
        self._dismissed = [place for place in self._dismissed if place.frame >= oldest]

    def next(self, cells: Tensor, target: int) -> CandidatePlace | None:
        """Find the most evident place that was not examined.

        Args:
            cells: `(X·Y,)`, probability of the target in each cell.
            target: class 1..K.

        Returns:
            The candidate; None if no detection that could be the target is left.
        """
        cells, looks = self.open(cells), self._left()
        shown = torch.stack([torch.zeros_like(cells), *(strength(look, self.grid, target) for look in looks)])
        value = cells * shown.amax(0)
        cell = int(value.argmax())
        evidence, box = strongest(looks, self.grid, cell, target)
        return (
            None if box is None or float(value[cell]) <= 0 else CandidatePlace(cell, box, evidence, float(cells[cell]))
        )

    def open(self, cells: Tensor) -> Tensor:
        """The probabilities, with 0 for the cells that were examined."""
        for place in self._dismissed:
            cells = cells.masked_fill(place.cells, 0)
        return cells

    def examine(
        self, candidate: CandidatePlace, presence: float, close_up: Callable[[Tensor], Detections], target: int
    ) -> tuple[Tensor, Tensor]:
        """Look closely at a candidate, and dismiss it.

        Args:
            candidate: the candidate.
            presence: probability that the image holds the target.
            close_up: looks closely at a box `(4,)`.
            target: class 1..K.

        Returns:
            The features of the closer look `(7,)`, and the box of the target in it `(4,)` (`closer_features`).
        """
        features, box = closer_features(
            presence, candidate.probability, candidate.evidence, close_up(candidate.box), candidate.box, target
        )
        self.dismiss(candidate, box)
        return features, box

    def dismiss(self, candidate: CandidatePlace, box: Tensor) -> None:
        """Do not list a candidate again, nor others at its place.

        Args:
            candidate: the candidate.
            box: `(4,)`, the box of the target in the closer look.
        """
        boxes = torch.stack([candidate.box, box])
        covered = (self.grid.footprint(boxes, "soft") >= _COVERED).any(0)
        covered[candidate.cell] = True
        self._dismissed.append(_Dismissed(self._frame, boxes, covered))

    def _left(self) -> list[Detections]:
        """The looks with faded scores, without the detections of objects that were examined."""
        looks = [
            replace(look, scores=look.scores * self.forgetting.keep ** (self._frame - frame))
            for frame, look in self._looks
        ]
        if not self._dismissed:
            return looks
        boxes = torch.cat([place.boxes for place in self._dismissed])
        return [replace(look, mask=look.mask & (box_iou(look.boxes[0], boxes) < SAME).all(-1)) for look in looks]


def cell_of(box: Tensor, grid: Grid) -> int:
    """The cell that a box `(4,)` covers most (its `soft` footprint)."""
    return int(grid.footprint(box[None], "soft")[0].argmax())


def surely(confirm: float) -> float:
    """Probability of a place from which a search ends at once: halfway between the threshold `confirm` and 1."""
    return (1 + confirm) / 2


def verified(places: Sequence[float], presence: float, confirm: float, *, over: bool) -> int:
    """Decide a search after closer looks.

    It has found its target if a place is sure (`surely`). When it is over, it has found it if a place is probable
    enough; otherwise the target is absent if the picture holds it with a probability below one half.

    Args:
        places: for each closer look, the probability that the target is at its place.
        presence: probability that the picture holds the target.
        confirm: least probability of the place, for `found`.
        over: whether no look follows.

    Returns:
        0 for a search that continues, otherwise the number of its outcome in `semfov.decision.OUTCOMES`.

    >>> verified([0.3, 0.96], 0.9, 0.9, over=False), verified([0.92], 0.9, 0.9, over=False)
    (1, 0)
    >>> [OUTCOMES[verified([place], presence, 0.9, over=True)] for place, presence in ((0.92, 0.9), (0.2, 0.3))]
    ['found', 'absent']
    """
    best = max(places, default=0.0)
    if places and best >= (confirm if over else surely(confirm)):
        return OUTCOMES.index("found")
    if not over:
        return 0
    return OUTCOMES.index("absent") if presence < 0.5 else len(OUTCOMES) - 1


class Examiner:
    """Looks closely at the places of one search that seem to hold the target.

    `Verifier` does it in a picture, and `semfov.live_verifier.LiveVerifier` in a stream of frames.

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

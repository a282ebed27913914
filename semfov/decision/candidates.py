"""Places that seem to hold the target of a search, from which closer looks are chosen."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache, partial
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers.any_of import class_meant
from semfov.belief.prior import Prior
from semfov.belief.verification import closer_features
from semfov.data.inputs import FRAME
from semfov.decision.rule import CloseUp, cell_of, place_known
from semfov.detection.detections import Detections
from semfov.episode import Forgetting, Step
from semfov.motion import Motion
from semfov.observation.matching import box_iou

SAME = 0.5  # boxes with at least this overlap (intersection over union) are of the same object
_COVERED = 0.5  # cells that an examined box covers with at least this weight are not examined again
_MOST_LOOKS = 1000  # largest number of looks at a stream whose detections are kept
LookType = TypeVar("LookType")  # a look of a search, with what is known after it

LookAt = Callable[[Tensor], Detections]
"""Looks closely at a box `(4,)`; gives the detections, a batch of one (`semfov.Eye.close_up`)."""


class CandidatePlace(NamedTuple):
    """A place that seems to hold the target; box `(4,)`."""

    box: Tensor
    evidence: float
    probability: float
    cell: int | None = None


class CandidatePlaces(ABC, Generic[LookType]):
    """Base of the places that seem to hold the target of one search, the most evident first, each listed once."""

    by_worth = False
    """Whether all closer looks worth a pass are made, and the best place alone tells what the picture holds."""

    detections: Detections
    """Detections of the last look, a batch of one."""

    target: int
    """Class that closer looks are made for, 1..K; in a search for several classes the most probable one."""

    presence: float
    """Probability that the picture holds the target, after the last look, with the `prior`."""

    prior: Prior
    """How often the target is there. All probabilities are those with this prior."""

    grid: Grid | None = None
    """The cells, where places are cells."""

    _left: float
    _fixation: int | None = None
    _number: int | None = None
    """The look after which the last closer look was made, or the one that it is."""

    def __init__(self, forgetting: Forgetting | None = None, prior: Prior | None = None) -> None:
        self.forgetting = Forgetting() if forgetting is None else forgetting
        self.prior = Prior() if prior is None else prior
        self._now = 0.0  # seconds of a stream
        # Each with its time: what looks show, boxes `(2, 4)` and cells `(X·Y,)` of examined places, and their
        # probabilities.
        self._looks: list[tuple[float, Any]] = []
        self._examined: list[tuple[float, Tensor, Tensor]] = []
        self._known: list[tuple[float, float]] = []

    @abstractmethod
    def see(self, look: LookType) -> None:
        """Take in a look of the search."""

    @property
    def left(self) -> float:
        """Value of the best look that is left, after the last look."""
        return self._left

    @abstractmethod
    def due(self, least: float, *, last: bool) -> CandidatePlace | None:
        """Find the place that is to be looked at closely now."""

    def seen(self, candidate: CandidatePlace) -> bool:
        """Whether an earlier look shows a candidate as closely, so that it is examined without a pass."""
        return False

    def look_at(self, candidate: CandidatePlace, close_up: LookAt) -> Detections:
        """What the look at a candidate shows that it is examined by."""
        return close_up(candidate.box)

    def dismiss(self, candidate: CandidatePlace, box: Tensor) -> None:
        """Do not list a candidate again, nor others at its place; box `(4,)`."""
        boxes, covered = torch.stack([candidate.box, box]), torch.zeros(0).bool()
        if self.grid is not None:
            covered = (self.grid.footprint(boxes, "soft") >= _COVERED).any(0)
            covered[candidate.cell] = True
        self._examined.append((self._now, boxes, covered))

    def record(self, box: Tensor, place: float, presence: float) -> CloseUp:
        """Make the record of the last closer look; box `(4,)`."""
        self._known.append((self._now, place))
        return CloseUp(self._fixation, self.target, self.cell(box), box, place, presence, self._number)

    def examine(self, candidate: CandidatePlace, close_up: LookAt) -> tuple[Tensor, Tensor]:
        """Look closely at a candidate, unless a look showed it so, and dismiss it; → `(7,)`."""
        # The regressions read the probabilities of the searches that they were fitted to.
        before = self.prior.inverse
        features, box = closer_features(
            before(self.presence),
            before.place(candidate.probability, self.presence),
            candidate.evidence,
            self.look_at(candidate, close_up),
            candidate.box,
            self.target,
        )
        self.dismiss(candidate, box)
        return features, box

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass: forget looks, and list places again, of which less than half the evidence is left."""
        self._now += passed
        oldest = self._now - self.forgetting.span
        self._looks = [look for look in self._looks[-_MOST_LOOKS:] if look[0] >= oldest]
        self._examined = [place for place in self._examined if place[0] >= oldest]
        self._known = [known for known in self._known if known[0] >= oldest]

    def follow(self, motion: Motion | None) -> None:
        """Carry examined places along with the camera, or forget them where a frame fits none before."""
        if motion is None:
            self._looks, self._examined, self._known = [], [], []
            return
        self._examined = [(time, motion.boxes(boxes), cells) for time, boxes, cells in self._examined]

    def cell(self, box: Tensor) -> int | None:
        """The cell that a box `(4,)` covers most; None where places are no cells."""
        return None if self.grid is None else cell_of(box, self.grid)

    def _again(self, boxes: Tensor) -> Tensor:
        """Which of boxes `(N, 4)` are of places that were examined, `(N,)` boolean."""
        examined = torch.cat([boxes.new_zeros(0, 4), *(pair for _, pair, _ in self._examined)])
        return (box_iou(boxes, examined) >= SAME).any(-1)

    @abstractmethod
    def probability(self, look: CloseUp) -> float:
        """Probability, without closer looks, that the target is at the place of a closer look; it fades towards it."""


class CandidateCells(CandidatePlaces[Step]):
    """Cells that seem to hold the target of one search: those with the largest product of probability and evidence.

    Examined boxes and the cells that they cover are left out. A place is due when a fixated cell is nearly as probable
    as any (`place_known`), or when no other look follows. In a scene that changes, evidence of earlier frames counts
    less, and examined places are listed again when half of the evidence is left (`semfov.episode.Forgetting`).
    """

    def __init__(
        self, grid: Grid, target: int, forgetting: Forgetting | None = None, prior: Prior | None = None
    ) -> None:
        super().__init__(forgetting, prior)
        self.grid, self._target = grid, target

    grid: Grid
    _step: Step

    def see(self, look: Step) -> None:
        self._step, self._fixation, self.detections = look, look.shift, look.detections
        self.target = class_meant(look.belief, self._target)
        self.presence = float(look.belief.presence(self._target))
        # Computed when a place is chosen for the first time.
        footprint = cache(partial(self.grid.footprint, look.detections.boxes, "soft"))
        self._looks.append((self._now, (look.detections, footprint)))
        # Largest probability of a cell that was not fixated, given that no fixated cell holds the target.
        self._left = float(look.belief.chance(self._target).masked_fill(look.visited, 0).amax())

    def due(self, least: float, *, last: bool) -> CandidatePlace | None:
        """The most evident place, if a fixated cell is nearly as probable as any, or no other look follows."""
        cells = self._step.belief.probability(self._target)[0]
        for _, _, covered in self._examined:
            cells = cells.masked_fill(covered, 0)
        if not (last or bool(place_known(cells, self._step.visited[0], least))):
            return None
        boxes = torch.cat([detections.boxes[0] for _, (detections, _) in self._looks])
        if not len(boxes):
            return None
        # Faded scores of the detections of all looks, 0 for objects that were examined.
        keep = self.forgetting.keep
        faded = [
            seen.mask[0] * (seen.scores[0, :, self.target] * keep ** (self._now - time))
            for time, (seen, _) in self._looks
        ]
        scores = torch.cat(faded) * ~self._again(boxes) if self._examined else torch.cat(faded)
        evidence = scores[:, None] * torch.cat([footprint()[0] for _, (_, footprint) in self._looks])
        value = cells * evidence.amax(0)
        cell = int(value.argmax())
        if float(value[cell]) <= 0 or float(cells[cell]) < least:
            return None
        best = int(evidence[:, cell].argmax())
        return CandidatePlace(boxes[best], float(evidence[best, cell]), float(cells[cell]), cell)

    def probability(self, look: CloseUp) -> float:
        """Present probability that the target is in the cell of a closer look."""
        return float(self._step.belief.probability(self._target)[0, look.cell])

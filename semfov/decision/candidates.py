"""Places that seem to hold the target of a search, from which closer looks are chosen."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache, partial
from typing import Generic, NamedTuple, TypeVar

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
from semfov.motion import CameraStep, LostScene, Motion
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou
from semfov.observation.thresholds import Thresholds

_COVERED = 0.5  # cells that an examined box covers with at least this weight are not examined again
_MOST_LOOKS = 1000  # largest number of looks at a stream whose detections are kept
LookType = TypeVar("LookType")  # a look of a search, with what is known after it

LookAt = Callable[[Tensor], Detections]
"""Looks closely at a box `(4,)`; gives the detections, a batch of one (`semfov.Eye.close_up`)."""


class CandidatePlace(NamedTuple):
    """A place that seems to hold the target, and that a closer look may be made at.

    Attributes:
        box: box `(4,)` of a detection there.
        evidence: the evidence of that detection: its score, for cells times its share in the cell.
        probability: that the target is there, before the closer look.
        cell: the cell, where places are cells.
    """

    box: Tensor
    evidence: float
    probability: float
    cell: int | None = None


class ExaminedPlace(NamedTuple):
    """A place that is not examined again.

    Attributes:
        time: seconds of the stream at which it was examined.
        boxes: `(2, 4)`, the box that the closer look was made at, and that of the target in it.
        cells: `(X·Y,)` boolean, the cells that the boxes cover; `(0,)` where places are no cells.
    """

    time: float
    boxes: Tensor
    cells: Tensor


class CandidatePlaces(ABC, Generic[LookType]):
    """Base of the places that seem to hold the target of one search, the most evident first, each listed once.

    Invariant: after `see`, the numbers and the place that is `due` are those after the last look. In a stream, examined
    places of which less than half the evidence is left are forgotten (`wait`).

    Attributes:
        detections: detections of the last look, a batch of one.
        target: class that closer looks are made for, 1..K; in a search for several classes the most probable one.
        presence: probability that the picture holds the target, after the last look, with the `prior`.
        prior: how often the target is there. All probabilities are those with this prior.
        grid: the cells, where places are cells.
        forgetting: how evidence fades in a stream.
    """

    detections: Detections
    target: int
    presence: float
    prior: Prior
    grid: Grid | None = None

    _fixation: int | None = None  # the fixation after which the last closer look was made
    _next: int = 0  # index of the next look of the search, closer looks included
    _index: int | None = None  # the index of the look that showed the last place that was examined

    def __init__(self, forgetting: Forgetting | None = None, prior: Prior | None = None) -> None:
        self.forgetting = Forgetting() if forgetting is None else forgetting
        self.prior = Prior() if prior is None else prior
        self._now = 0.0  # seconds of the stream
        self._examined: list[ExaminedPlace] = []
        self._lost_examined: LostScene[ExaminedPlace] = LostScene()

    @abstractmethod
    def see(self, look: LookType) -> None:
        """Update the candidates with a look of the search."""

    @property
    @abstractmethod
    def hit_chance(self) -> float:
        """Chance that the best remaining look shows the target, if no look so far has."""

    @abstractmethod
    def due(self, thresholds: Thresholds, *, last: bool) -> CandidatePlace | None:
        """Find the place that is to be looked at closely now.

        Args:
            thresholds: least probability of a place (`place`), and least chance of a hit (`stop_below`).
            last: whether no other look of the search follows.

        Returns:
            The place; None if no place is due.
        """

    def shown_at(self, candidate: CandidatePlace) -> Detections | None:
        """Find what an earlier look shows of a candidate as closely as a closer look would; None where none does."""
        return None

    def closer_magnification(self, candidate: CandidatePlace) -> float:
        """Compute the magnification of a closer look at a candidate; 1 where all looks are alike."""
        return 1.0

    def places_exactly(self, box: Tensor, magnification: float) -> bool:
        """Tell whether the last look places an object about as exactly as a closer look of some magnification did.

        Args:
            box: `(4,)`, where the object was.
            magnification: of the closer look.

        Returns:
            Whether the look is as close, within an octave, and its border does not cut the object.
        """
        return True

    def dismiss(self, candidate: CandidatePlace, box: Tensor) -> None:
        """Do not list a candidate again, nor others at its place; box `(4,)` of the target in the closer look."""
        boxes = torch.stack([candidate.box, box])
        covered = torch.zeros(0).bool()
        if self.grid is not None:
            covered = (self.grid.footprint(boxes, "soft") >= _COVERED).any(0)
            # A small box may cover not even its own cell by that much.
            covered[candidate.cell] = True
        self._examined.append(ExaminedPlace(self._now, boxes, covered))

    def record(self, box: Tensor, place: float, presence: float) -> CloseUp:
        """Store the result of the last closer look.

        Args:
            box: `(4,)`, box of the target.
            place: probability that the target is there.
            presence: probability that the picture holds the target.

        Returns:
            The closer look, for the record of the search.
        """
        return CloseUp(self._fixation, self.target, self.cell(box), box, place, presence, self._index)

    def examine(self, candidate: CandidatePlace, detections: Detections) -> tuple[Tensor, Tensor]:
        """Store the result of a closer look at a candidate, and remove the candidate.

        Args:
            candidate: the place.
            detections: what a closer look shows, a batch of one.

        Returns:
            The features `(7,)` of the look (`closer_features`), and the box `(4,)` of the target in it.
        """
        # The regressions read the probabilities of the searches that they were fitted to.
        fitted = self.prior.inverse
        features, box = closer_features(
            fitted(self.presence),
            fitted.at_place(candidate.probability, self.presence),
            candidate.evidence,
            detections,
            candidate.box,
            self.target,
        )
        self.count_look(candidate)
        self.dismiss(candidate, box)
        return features, box

    def count_look(self, candidate: CandidatePlace) -> None:
        """Give a closer look the next number among the looks of the search."""
        self._index = self._next
        self._next += 1

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass, and forget examined places of which less than half the evidence is left."""
        self._now += passed
        self._examined = [place for place in self._examined if place.time >= self._oldest]

    @property
    def _oldest(self) -> float:
        """Time before which less than half of the evidence is left."""
        return self._now - self.forgetting.span

    def follow(self, camera: CameraStep) -> None:
        """Carry examined places along with the camera.

        Those that are behind the camera now are forgotten. Where a frame fits none before, all are set aside, until the
        scene is found again or given up.

        Args:
            camera: how the camera moved.
        """
        self._examined = self._lost_examined.follow(self._examined, camera, _moved_examined)

    def cell(self, box: Tensor) -> int | None:
        """Find the cell that a box `(4,)` covers most; None where places are no cells."""
        return None if self.grid is None else cell_of(box, self.grid)

    def _are_examined(self, boxes: Tensor) -> Tensor:
        """Tell which of boxes `(N, 4)` are of places that were examined, `(N,)` boolean."""
        examined = torch.cat([boxes.new_zeros(0, 4), *(place.boxes for place in self._examined)])
        return (box_iou(boxes, examined) >= SAME_OBJECT_IOU).any(-1)

    @abstractmethod
    def probability(self, look: CloseUp) -> float:
        """Probability, without closer looks, that the target is at the place of a closer look; it fades towards it."""


def _moved_examined(places: list[ExaminedPlace], motion: Motion) -> list[ExaminedPlace]:
    """Move examined places with the camera, without those that are behind it now."""
    if not places:
        return []
    boxes = torch.stack([place.boxes for place in places])  # (places, 2, 4)
    moved_boxes, boxes_ahead = motion.boxes_ahead(boxes)
    are_ahead = boxes_ahead.all(-1).tolist()
    moved = zip(places, moved_boxes, are_ahead, strict=True)
    return [place._replace(boxes=boxes_of_place) for place, boxes_of_place, is_ahead in moved if is_ahead]


class _LookAtCells(NamedTuple):
    """What is kept of a look of a fovea: its detections, and a function that makes their footprints `(1, L, X·Y)`."""

    detections: Detections
    footprint: Callable[[], Tensor]


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
        self.grid = grid
        self._target = target
        self._hit_chance = 1.0
        self._looks: list[tuple[float, _LookAtCells]] = []  # each with its time
        self._lost_looks: LostScene[tuple[float, _LookAtCells]] = LostScene()

    grid: Grid
    _step: Step

    def see(self, look: Step) -> None:
        self._step = look
        self._next += 1
        self._fixation = look.shift
        self.detections = look.detections
        self.target = class_meant(look.belief, self._target)
        self.presence = float(look.belief.presence(self._target))
        # Footprints are computed when a place is chosen for the first time.
        footprint = cache(partial(self.grid.footprint, look.detections.boxes, "soft"))
        self._looks.append((self._now, _LookAtCells(look.detections, footprint)))
        chance = look.belief.chance(self._target)
        self._hit_chance = float(chance.masked_fill(look.visited, 0).amax())

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass, and forget looks and examined places of which less than half the evidence is left."""
        super().wait(passed)
        # With rate 0 none is too old, and their number would grow without end.
        self._looks = [look for look in self._looks[-_MOST_LOOKS:] if look[0] >= self._oldest]

    def follow(self, camera: CameraStep) -> None:
        """Carry examined places along with the camera; looks come back with their scene."""
        super().follow(camera)
        self._looks = self._lost_looks.follow(self._looks, camera, lambda looks, _: looks)

    @property
    def hit_chance(self) -> float:
        """Largest probability of a cell that was not fixated, given that no fixated cell holds the target."""
        return self._hit_chance

    def due(self, thresholds: Thresholds, *, last: bool) -> CandidatePlace | None:
        """Find the most evident place, if a fixated cell is nearly as probable as any, or no other look follows."""
        probability = self._step.belief.probability(self._target)[0]
        for examined in self._examined:
            probability = probability.masked_fill(examined.cells, 0)
        is_located = bool(place_known(probability, self._step.visited[0], thresholds.place))
        if not last and not is_located:
            return None
        place = self._most_evident(probability)
        return None if place is None or place.probability < thresholds.place else place

    def _most_evident(self, probability: Tensor) -> CandidatePlace | None:
        """Find the cell with the largest product of probability `(X·Y,)` and evidence; None without evidence."""
        boxes = torch.cat([look.detections.boxes[0] for _, look in self._looks])
        if not len(boxes):
            return None
        evidence = self._evidence(boxes)  # (N, X·Y)
        value = probability * evidence.amax(0)
        cell = int(value.argmax())
        if float(value[cell]) <= 0:
            return None
        best = int(evidence[:, cell].argmax())
        return CandidatePlace(boxes[best], float(evidence[best, cell]), float(probability[cell]), cell)

    def _evidence(self, boxes: Tensor) -> Tensor:
        """Evidence of each detection of all looks in each cell: its faded score times its footprint.

        Args:
            boxes: `(N, 4)`, boxes of the detections of all looks.

        Returns:
            `(N, X·Y)`, 0 for objects that were examined.
        """
        faded_scores = []
        for time, look in self._looks:
            scores_of_look = look.detections.scores[0, :, self.target]
            share = self.forgetting.share_left(self._now - time)
            faded_scores.append(look.detections.mask[0] * (scores_of_look * share))
        scores = torch.cat(faded_scores)
        if self._examined:
            scores = scores * ~self._are_examined(boxes)
        footprints = torch.cat([look.footprint()[0] for _, look in self._looks])
        return scores[:, None] * footprints

    def probability(self, look: CloseUp) -> float:
        """Present probability that the target is in the cell of a closer look."""
        return float(self._step.belief.probability(self._target)[0, look.cell])

"""Places that seem to hold the target, the most evident first."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.verification import closer_features
from semfov.decision.evidence import strength, strongest
from semfov.detection.detections import Detections
from semfov.episode import Forgetting
from semfov.observation.matching import box_iou

SAME = 0.5
"""Boxes with at least this overlap (intersection over union) are of the same object."""

_COVERED = 0.5  # cells that an examined box covers with at least this weight are not examined again
_MOST_LOOKS = 1000  # largest number of looks at a stream whose detections are kept


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

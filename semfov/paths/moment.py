"""The record of one frame of a camera or a video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.decision import CloseUp
from semfov.detection.detections import Detections
from semfov.detection.objects import Objects
from semfov.paths.base import Record, RecordedLook
from semfov.paths.merging import distances_to, merge_fixations


@dataclass(frozen=True, kw_only=True, repr=False)
class Moment(Record):
    """Look, belief and decision at one frame.

    Beside the attributes of `semfov.paths.Record` it has those of its look.

    Attributes:
        number: number of the frame, from 0.
        grid: the cells.
        cell: the fixated cell, or the one that was looked at closely.
        fixation: `(2,)`, the centre of the cell as `(x, y)` in pixels.
        detections: detections of the look, a batch of one.
        belief: belief of one episode after the last look that was not a closer one.
        decision: decision at this frame: `found`, `absent`, or `undecided` as long as it is neither; None for
            exploration and for a belief without thresholds.
        visited: `(X·Y,)` boolean, cells that inhibition of return keeps the gaze from.
        next_cell: the cell to look at in the next frame.
        seconds: time of the look by stage; `open` is the fitting of the frame into the detector's input. A closer look
            has the stage `detect` alone.
        closer: the closer look, if this frame was spent on one; otherwise None.

    Example::

        moment = live.step(frame)
        print(moment.decision.outcome, moment.probability.max())
    """

    number: int
    grid: Grid
    cell: int
    fixation: Tensor
    detections: Detections
    belief: Belief
    visited: Tensor
    next_cell: int
    seconds: dict[str, float]
    closer: CloseUp | None = None

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the frame in pixels."""
        width, height = (int(side) for side in self.grid.extent)
        return width, height

    @property
    def passes(self) -> int:
        """One pass of the detector."""
        return 1

    def __iter__(self) -> Iterator[RecordedLook]:
        """The look at the frame, with the whole frame as its region."""
        (x, y), (width, height) = self.fixation.tolist(), self.size
        yield RecordedLook(
            0, (x, y), (0.0, 0.0, float(width), float(height)), self.detections, sum(self.seconds.values())
        )

    @cached_property
    def candidates(self) -> Objects:
        """Objects of the frame, of all scores from 0.05 on, with boxes in pixels of the frame."""
        distances = distances_to(self.detections.boxes[0], self.fixation)
        return merge_fixations([self.detections], [distances], self.closer_looks)

    @property
    def probability(self) -> Tensor:
        """Probability that each cell holds the target, or any object in an exploration, `(X·Y,)`."""
        if self.target is None:
            return 1 - self.belief.class_probabilities()[0, :, 0]
        return self.belief.probability(self.target)[0]

    def describe(self) -> str:
        """Describe belief and decision at the frame in a few words.

        Returns:
            The words.
        """
        highest = float(self.probability.max())
        if self.target is None:
            return f"p(object) up to {highest:.2f}"
        if self.decision is None:
            return f"p({self.target_name}) up to {highest:.2f}"
        there = "" if self.decision.place is None else f" (there {self.decision.place:.2f})"
        return f"{self.target_name}: {self.decision.outcome}, p {self.decision.probability:.2f}{there}"

    def _lines(self) -> list[str]:
        row, column = divmod(self.cell, self.grid.columns)
        return [f"frame {self.number}, at (column, row): ({column}, {row})", self._listed()]

    @property
    def closer_looks(self) -> Sequence[CloseUp]:
        """The closer look of the frame, if it is one."""
        return () if self.closer is None else (self.closer,)

    def rows(self) -> list[dict[str, Any]]:
        """The frame as a table of plain values.

        `probability` is the probability of the target, or of any object in an exploration, in the cell, and `highest`
        the largest one of all cells. `detections` is the number of detections, `seen` the class of the most confident
        one, and `score` its confidence.

        Returns:
            One dictionary.
        """
        row, column = divmod(self.cell, self.grid.columns)
        x, y = self.fixation.tolist()
        return [
            {
                "frame": self.number,
                "cell": self.cell,
                "column": column,
                "row": row,
                "x": x,
                "y": y,
                "probability": float(self.probability[self.cell]),
                "highest": float(self.probability.max()),
                "highest_cell": int(self.probability.argmax()),
                **self._detected(self.detections),
                "seconds": sum(self.seconds.values()),
            }
        ]

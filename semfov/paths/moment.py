"""The records of one frame of a camera or a video."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.data.inputs import Color, ImageLike, as_image
from semfov.decision import CloseUp
from semfov.detection.detections import Detections
from semfov.errors import check
from semfov.io.schema import Array, Field, Number, Object
from semfov.paths.base import Record
from semfov.paths.cells import GRID, CellRecord
from semfov.paths.files import FARTHEST, WHOLE, Format
from semfov.paths.look import Box, RecordedLook, cell_columns
from semfov.paths.windows import TENSORS, VALUES, WINDOW, ZoomPath, window_from, window_values
from semfov.zoom.glances import Window

_FOVEA = Format(
    "moment",
    {
        "fixation": Field((2,), mixed=True, low=-FARTHEST, high=FARTHEST),
        "probability": Field(("cells",), mixed=True, low=0, high=1 + 1e-3),
        "visited": Field(("cells",), dtype=torch.bool),
    },
    {
        "number": WHOLE,
        **GRID,
        "cell": WHOLE,
        "next_cell": WHOLE,
        "seconds": Array(Object({}, Number(low=0)), 1),
    },
)
"""Format of the files of moments of a fovea."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Moment(Record):
    """Base of the records of one frame of a stream.

    Attributes:
        number: number of the frame, from 0.
        decision: decision at this frame: `found`, `absent`, or `undecided` as long as it is neither; None where nothing
            is decided.

    Example::

        moment = live.step(frame)
        print(moment.describe(), moment.objects.boxes)
    """

    number: int

    @property
    def seen(self) -> Detections:
        """Detections of the look at this frame, a batch of one."""
        return self.looks[-1].detections

    @property
    def examined(self) -> CloseUp | None:
        """The closer look, if this frame was spent on one; otherwise None."""
        last = self.closer[-1] if self.closer else None
        return last if last is not None and last.number == len(self) - 1 else None

    @property
    @abstractmethod
    def next_point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, the point that the next look is at."""

    @property
    def next_region(self) -> Box | None:
        """`(x1, y1, x2, y2)` in pixels, the part of the frame that the next look shows; None for all of it."""
        return None

    def draw(self, frame: ImageLike, *, color: Color = "bgr", longest: int = 1280) -> NDArray[np.uint8]:
        """Draw the look, the belief or the objects, and where the next look goes, into the frame, for a window.

        Matplotlib is not needed.

        Args:
            frame: the frame of the moment.
            color: order of the channels of the frame and of the drawing: `bgr`, as OpenCV reads and shows them, or
                `rgb`.
            longest: longer side of the drawing in pixels; a larger frame is reduced to it.

        Returns:
            `(h, w, 3)`, bytes, with even sides.

        Raises:
            InputError: it is no frame of the size of the moment's.

        Example::

            moment = live.step(frame)
            cv2.imshow("semfov", moment.draw(frame))
        """
        from semfov.viz.live import draw_moment

        image = as_image(frame, argument="frame", color=color)
        check(
            tuple(image.shape[:0:-1]) == self.size, "frame", "{} × {} px".format(*self.size), tuple(image.shape[:0:-1])
        )
        drawn = draw_moment(image, self, self.describe(), longest)
        return np.ascontiguousarray(drawn[..., ::-1]) if color == "bgr" else drawn

    def _decided(self) -> str | None:
        """The decision in words; None without one."""
        if self.decision is None:
            return None
        there = "" if self.decision.place is None else f" (there {self.decision.place:.2f})"
        return f"{self.target_name}: {self.decision.outcome}, p {self.decision.probability:.2f}{there}"


@dataclass(frozen=True, kw_only=True, repr=False)
class FoveaMoment(CellRecord, Moment):
    """Look, belief and decision at one frame that a fovea looks at.

    Beside the attributes of `Moment` it has those of its look.

    Attributes:
        grid: the cells.
        cell: the fixated cell, or the one that was looked at closely.
        fixation: `(2,)`, the centre of the cell as `(x, y)` in pixels.
        probability: `(X·Y,)`, probability that each cell holds the target, or any object in an exploration, after the
            last look that was not a closer one.
        visited: `(X·Y,)` boolean, cells that inhibition of return keeps the gaze from.
        next_cell: the cell to look at in the next frame.
        seconds: time of the look by stage, one mapping; `open` is the fitting of the frame into the detector's input. A
            closer look has the stage `detect` alone.
        belief: belief of one episode that gave the probability; None in a moment from a file.

    Example::

        moment = live.step(frame)
        print(moment.decision.outcome, moment.probability.max())
    """

    cell: int
    fixation: Tensor
    probability: Tensor
    visited: Tensor
    next_cell: int
    belief: Belief | None = field(default=None, compare=False)

    _format = _FOVEA
    _tensors = "fixation", "probability", "visited"
    _plain = "number", "cell", "next_cell"

    @property
    def next_point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, the centre of the next cell."""
        x, y = self.grid.centres[self.next_cell].tolist()
        return x, y

    def _looks(self) -> Iterator[RecordedLook]:
        """The look at the frame, with the whole frame as its region."""
        (x, y), (width, height) = self.fixation.tolist(), self.size
        more = {"frame": self.number, **cell_columns(self.grid, self.cell, self.probability)}
        region = (0.0, 0.0, float(width), float(height))
        yield RecordedLook(0, (x, y), region, self.detections[0], sum(self.seconds[0].values()), None, more)

    def belief_map(self, number: int) -> tuple[Grid, Tensor]:
        """The probability of the target, or of any object, in each cell."""
        return self.grid, self.probability

    def describe(self) -> str:
        """Describe belief and decision at the frame in a few words."""
        highest = float(self.probability.max())
        if self.target is None:
            return f"p(object) up to {highest:.2f}"
        return self._decided() or f"p({self.target_name}) up to {highest:.2f}"

    def _lines(self) -> list[str]:
        row, column = divmod(self.cell, self.grid.columns)
        return [f"frame {self.number}, at (column, row): ({column}, {row})"]

    @classmethod
    def _fields(
        cls, tensors: Mapping[str, Tensor], record: Mapping[str, Any], shared: Mapping[str, Any]
    ) -> dict[str, Any]:
        check(len(shared["detections"]) == 1, "lengths", "one look", len(shared["detections"]))
        made = super()._fields(tensors, record, shared)
        cells, visited = len(made["grid"]), len(tensors["visited"])
        check(visited == cells, "visited", f"{cells} cells", visited)
        for name in ("cell", "next_cell"):
            check(record[name] < cells, name, f"a cell number below {cells}", record[name])
        return made


@dataclass(frozen=True, kw_only=True, repr=False)
class WindowMoment(ZoomPath, Moment):
    """The looks that count at one frame whose windows are looked at, and what they show.

    It is the record of these looks, the last of which is at this frame. Its objects are merged from them. Those of
    earlier frames are where they were then.

    Beside the attributes of `ZoomPath` and `Moment` it has what comes next.

    Attributes:
        next_window: the window to look at in the next frame.

    Example::

        moment = agent.live("person", how="windows").step(frame)
        print(moment.window.fixation, moment.describe())
    """

    next_window: Window

    _format = Format("window moment", TENSORS, {**VALUES, "number": WHOLE, "next_window": WINDOW})

    @property
    def next_point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, the centre of what the next window shows."""
        return self.next_window.centre(self.lattice)

    @property
    def next_region(self) -> Box:
        """`(x1, y1, x2, y2)` in pixels, what the next window shows."""
        return self.next_window.region(self.lattice)

    @property
    def window(self) -> Window:
        """The window that was looked at in this frame."""
        return self.glances[-1].window

    def describe(self) -> str:
        """Describe objects or decision at the frame in a few words."""
        return self._decided() or self.objects_in_words()

    def _lines(self) -> list[str]:
        """The frame and the windows."""
        return [f"frame {self.number}", *super()._lines()]

    def _contents(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors, record = super()._contents()
        return tensors, {**record, "number": self.number, "next_window": window_values(self.next_window)}

    @classmethod
    def _fields(
        cls, tensors: Mapping[str, Tensor], record: Mapping[str, Any], shared: Mapping[str, Any]
    ) -> dict[str, Any]:
        fields = super()._fields(tensors, record, shared)
        return {
            **fields,
            "number": record["number"],
            "next_window": window_from(record["next_window"], fields["lattice"]),
        }

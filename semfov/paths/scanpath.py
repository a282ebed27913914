"""The records of looks of a fovea at cells: an episode in a photograph, from its steps, and a frame of a stream."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate
from typing import Any, ClassVar

import torch
from torch import Tensor

from semfov.belief import Belief, Grid
from semfov.belief.observers.base import Observer
from semfov.data.inputs import as_image
from semfov.data.windowed import LargePicture
from semfov.decision import Decision
from semfov.detection.objects import LEAST
from semfov.episode import STAGES, Step
from semfov.errors import InputError, check
from semfov.io.schema import Array, Field, Json, Maybe, Number, Object, Text
from semfov.paths.base import Moment, Record
from semfov.paths.files import FARTHEST, POSITIVE, WHOLE, Format
from semfov.paths.kinds import FOVEA
from semfov.paths.look import LookView, RecordedLook, cell_columns
from semfov.paths.stimulus import Stimulus
from semfov.paths.words import MomentWords, Words

_GRID: dict[str, Json] = {"grid": Array(Number(low=1, high=10_000, whole=True), 2), "size": Array(POSITIVE, 2)}
"""JSON values of a grid in a file."""

_SENSOR = {
    "sigma": POSITIVE,
    "levels": Number(low=0, high=16, whole=True),
    "growth": POSITIVE,
    "convention": Text(("kornia", "opencv")),
    "reference": POSITIVE,
}
_SETTINGS = Object(
    {
        # Other settings, of a user's own sensor, are kept without a check.
        "sensor": Object(_SENSOR, Json(), ("reference",)),
        "detector": Object({"name": Text()}, Json(), ("name",)),
    },
    Json(),
    ("sensor", "detector"),
)
_PLACEMENT = {"size": Array(POSITIVE, 2), "scale": Array(POSITIVE, 2), "offset": Array(WHOLE, 2)}

_FORMAT = Format(
    "scanpath",
    {
        "cells": Field(("n",), dtype=torch.int64, low=0),
        "fixations": Field(("n", 2), mixed=True, low=-FARTHEST, high=FARTHEST),
        "probabilities": Field(("n", "cells", "C"), mixed=True, low=0, high=1 + 1e-3),
        "values": Field(("n", "cells"), mixed=True, finite=False),
        "posterior": Field(("n", "cells"), mixed=True, low=0, high=1 + 1e-3, optional=True),
        "presence": Field(("n",), mixed=True, low=0, high=1 + 1e-3, optional=True),
        "canvas": Field((3, "H", "W"), dtype=torch.uint8, optional=True),
    },
    {
        **_GRID,
        "seconds": Array(Object(dict.fromkeys(STAGES, Number(low=0)), Number(low=0))),
        "placement": Maybe(Object(_PLACEMENT, None, tuple(_PLACEMENT))),
        "settings": Maybe(_SETTINGS),
    },
)
"""Format of the files of scanpaths."""


class _MadeWhenRead:
    """A field that can be given as a function, which then makes it when it is read for the first time."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, record: Any, owner: type | None = None) -> Any:
        if record is None:
            raise AttributeError(self._name)  # no default
        values = vars(record)
        if callable(values[self._name]):
            values[self._name] = values[self._name]()
        return values[self._name]

    def __set__(self, record: Any, value: Any) -> None:
        vars(record)[self._name] = value


@dataclass(frozen=True, kw_only=True, repr=False)
class _CellRecord(Record):
    """Base of the records of looks of a fovea at cells; `seconds` are those of each look by stage."""

    grid: Grid
    seconds: tuple[Mapping[str, float], ...] = ()

    kind = FOVEA

    _tensors: ClassVar[tuple[str, ...]]
    """Attributes that are tensors of a file; those that are None are left out."""

    _plain: ClassVar[tuple[str, ...]] = ()
    """Attributes that are JSON values of a file."""

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the photograph or frame in pixels."""
        width, height = (int(side) for side in self.grid.extent)
        return width, height

    def _contents(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        size = self.grid.size.tolist() if isinstance(self.grid.size, Tensor) else list(self.grid.size)
        tensors = {name: getattr(self, name) for name in self._tensors if getattr(self, name) is not None}
        record = {name: getattr(self, name) for name in self._plain}
        record |= {"grid": [self.grid.columns, self.grid.rows], "size": size}
        return tensors, {**record, "seconds": [dict(each) for each in self.seconds]}

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
        looks, seconds, decision = len(shared["detections"]), record["seconds"], shared["decision"]
        columns, rows = record["grid"]
        grid = Grid(columns, rows, tuple(record["size"]))
        check(len(seconds) in (0, looks), "seconds", f"times of {looks} looks, or none", len(seconds))
        cell = None if decision is None else decision.cell
        check(cell is None or cell < len(grid), "decision.cell", f"a cell number below {len(grid)}", cell)
        for look in shared["closer"]:
            check((look.cell or 0) < len(grid), "closer", f"a cell below {len(grid)}", look.cell)
        made = {name: tensors.get(name) for name in cls._tensors} | {name: record[name] for name in cls._plain}
        return {**made, "grid": grid, "seconds": tuple(seconds)}


class ScanpathWords(Words):
    """Words for a search or an exploration with a fovea."""

    record: "Scanpath"

    @property
    def decided_by(self) -> str:
        """What the number of the decision is: a `probability`, or a `belief` without thresholds."""
        return "belief" if self.record.ending == "detection" else "probability"

    def describe(self) -> str:
        """Describe the outcome of the episode in one line."""
        record = self.record
        shifts = f"{record.shifts} gaze shift{'s' if record.shifts != 1 else ''}"
        if record.target is None:
            return f"explored with {shifts}: {self.objects}"
        if record.decision is None:
            return f"“{record.target_name}” {'found after' if record.found else 'not found in'} {shifts}"
        if record.closer:
            shifts += f" and {len(record.closer)} closer look{'s' if len(record.closer) != 1 else ''}"
        outcome = "not there" if record.decision.outcome == "absent" else record.decision.outcome
        return f"“{record.target_name}” {outcome} after {shifts} ({self._certainty(record.decision)})"

    def _certainty(self, decision: Decision) -> str:
        """Say how sure the decision is."""
        if self.record.ending == "detection":
            # Beliefs without thresholds are no probabilities in the plain sense.
            return f"by a detection at the gaze; its belief gives {decision.probability:.2f}"
        place = "" if decision.place is None else f", {decision.place:.2f} at this place"
        return f"probability {decision.probability:.2f}{place}"

    @property
    def lines(self) -> list[str]:
        """The fixated cells, the first and the last of many, and the grid."""
        grid = self.record.grid
        cells = [f"({cell % grid.columns}, {cell // grid.columns})" for cell in self.record.cells.tolist()]
        path = cells if len(cells) <= 8 else [*cells[:6], "…", cells[-1]]
        width, height = grid.extent.tolist()
        cells_of_grid = f"{grid.columns} × {grid.rows} cells over {width:.0f} × {height:.0f} px"
        return [f"looks at (column, row): {' '.join(path)} of {cells_of_grid}"]


@dataclass(frozen=True, kw_only=True, repr=False)
class Scanpath(_CellRecord):
    """Fixations of one episode in order, with the detections and the belief at each of them.

    A notebook shows a scanpath as an interactive page. `plot`, `animate`, `to_frame` and `save` make a picture, an
    animation, a table and a file.

    Beside the attributes of `semfov.paths.Record` it has those of its looks.

    Attributes:
        grid: the cells of the image.
        cells: `(n,)`, fixated cells.
        fixations: `(n, 2)`, centres of the fixated cells as `(x, y)` in pixels.
        probabilities: `(n, X·Y, K+1)`, probability that each cell holds each class after each look, background first.
            A learned map gives marginal probabilities: several classes can share a cell, so they need not sum to 1.
        values: `(n, X·Y)`, values of the acquisition function, by which the next fixation was chosen.
        posterior: `(n, X·Y)`, probability of the target in each cell after each look, by the belief of the search; None
            for exploration.
        presence: `(n,)`, probability that the image holds the target after each look; None for exploration.
        seconds: time of each look by stage (`semfov.episode.STAGES`); the clock of the episode is their sum so far.
        stimulus: the data for the foveated views of the photograph; None if it was not kept.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
        scanpath.plot().savefig("scanpath.png")
        scanpath.save("scanpath.safetensors")

    >>> grid, none = Grid(2, 1, (10, 10)), torch.zeros(2, 2)
    >>> Scanpath(grid=grid, classes=("background", "cup"), target=1, cells=torch.arange(2), fixations=none,
    ...          detections=(), probabilities=none, values=none, found=True).describe()
    '“cup” found after 1 gaze shift'
    """

    cells: Tensor
    fixations: Tensor
    probabilities: Tensor = _MadeWhenRead()  # type: ignore[assignment]
    values: Tensor
    posterior: Tensor | None = None
    presence: Tensor | None = None
    stimulus: Stimulus | None = None

    _words = ScanpathWords
    _format = _FORMAT
    _tensors = "cells", "fixations", "probabilities", "values", "posterior", "presence"

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "probabilities": self.probabilities}

    def __len__(self) -> int:
        """Number of fixations, the start included."""
        return len(self.cells)

    @property
    def shifts(self) -> int:
        """Number of gaze shifts (saccades): fixations after the start."""
        return len(self) - 1

    def views(self) -> list[Tensor]:
        """The foveated photograph at each fixation.

        Returns:
            One view `(3, h, w)` in [0, 1] for each fixation.

        Raises:
            InputError: the photograph was not kept.
        """
        if self.stimulus is None:
            raise InputError("scanpath: expected one with its stimulus, as an agent makes it, got one without")
        return self.stimulus.views(self.fixations)

    def _looks(self) -> Iterator[RecordedLook]:
        belief = self.posterior
        if belief is None and self.target is not None:
            belief = self.probabilities[..., self.target]
        region = (0.0, 0.0, float(self.size[0]), float(self.size[1]))
        times = [sum(each.values()) for each in self.seconds]
        clock: list[float | None] = [*accumulate(times)] if times else [None] * len(self)
        columns = zip(self.cells.tolist(), self.fixations.tolist(), self.detections, clock, strict=True)
        for number, (cell, (x, y), detections, seconds) in enumerate(columns):
            value = float(self.values[number - 1, cell]) if number else math.inf
            chosen = value if math.isfinite(value) else None
            more = cell_columns(self.grid, cell, None if belief is None else belief[number])
            more["presence"] = None if self.presence is None else float(self.presence[number])
            yield RecordedLook(number, (x, y), region, detections, seconds, chosen, more)

    def belief_map(self, number: int) -> tuple[Grid, Tensor]:
        """Probability in each cell after a look: of the target by the belief of the search, or of any object."""
        if self.target is None:
            return self.grid, self.probabilities[number, :, 1:].amax(-1)
        return self.grid, (self.probabilities[..., self.target] if self.posterior is None else self.posterior)[number]

    def look_views(self, source: LargePicture) -> Iterator[LookView]:
        """The foveated views, or where the stimulus was not kept, the picture."""
        if self.stimulus is None:
            yield from super().look_views(source)
            return
        for look, view in zip(self, self.views(), strict=True):
            yield LookView(view, self.size, look.detections.boxes[0], look.fixation)

    def page_data(self, picture: Any = None, *, name: str | None = None, **options: Any) -> dict[str, Any]:
        """Data of the scanpath for a page (`semfov.report.episode.episode_data`)."""
        from semfov.report.episode import episode_data

        image = self.image if picture is None else as_image(picture)
        views = None if self.stimulus is None else self.views()
        return episode_data(self, image, views, name=name or self._picture_name, **options)

    def _repr_html_(self) -> str:
        from semfov.report.notebook import scanpath_html

        return scanpath_html(self)

    def _contents(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors, record = super()._contents()
        record |= {"placement": None, "settings": None}
        if self.stimulus is not None:
            tensors["canvas"] = self.stimulus.canvas
            record["placement"] = {name: list(getattr(self.stimulus.placement, name)) for name in _PLACEMENT}
            record["settings"] = dict(self.stimulus.settings)
        return tensors, record

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
        made = super()._fields(tensors, record, shared)
        cells, most, values = len(made["grid"]), int(tensors["cells"].max()), tensors["values"].shape[-1]
        check(values == cells, "values", f"one for each of {cells} cells", values)
        check(most < cells, "cells", f"cell numbers below {cells}", most)
        return {**made, "stimulus": Stimulus.restored(tensors, record)}


class Trace:
    """Keeps the steps of one episode, and makes scanpaths of them at any time."""

    def __init__(
        self,
        grid: Grid,
        classes: tuple[str, ...],
        target: int | None,
        beside: Observer | None,
        least: float = LEAST,
        steps: Iterable[Step] = (),
    ) -> None:
        self.grid, self.classes, self.target, self.beside, self.least = grid, classes, target, beside, least
        self.steps = [*steps]
        self._maps: list[Tensor] = []
        self._belief: Belief | None = None
        self._modes = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def scanpath(self, **outcome: Any) -> Scanpath:
        """Make the scanpath of the steps so far. Its map of all classes is made when it is read."""
        steps, target = self.steps, self.target
        fields = {
            "grid": self.grid,
            "classes": self.classes,
            "target": target,
            "least": self.least,
            "cells": torch.cat([step.cell for step in steps]),
            "fixations": torch.cat([step.fixation for step in steps]),
            "detections": tuple(step.detections for step in steps),
            "probabilities": partial(self._probabilities, len(steps)),
            "values": torch.stack([step.values[0] for step in steps]),
            "found": False,
            "seconds": tuple(step.seconds for step in steps),
        }
        if target is not None:
            fields["posterior"] = torch.stack([step.belief.probability(target)[0] for step in steps])
            fields["presence"] = torch.stack([step.belief.presence(target)[0] for step in steps])
        return Scanpath(**{**fields, **outcome})

    def _probabilities(self, looks: int) -> Tensor:
        """The map of all classes after each of the first looks, `(looks, X·Y, K+1)`."""
        gradients, inference = self._modes
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
            for step in self.steps[len(self._maps) : looks]:
                if self.beside is not None:
                    before = self._belief or self.beside.start(1, self.grid, step.values)
                    self._belief = self.beside(before, step.detections, step.fixation, self.grid)
                self._maps.append((self._belief or step.belief).class_probabilities()[0])
            return torch.stack(self._maps[:looks])


_FOVEA = Format(
    "moment",
    {
        "fixation": Field((2,), mixed=True, low=-FARTHEST, high=FARTHEST),
        "probability": Field(("cells",), mixed=True, low=0, high=1 + 1e-3),
        "visited": Field(("cells",), dtype=torch.bool),
    },
    {"number": WHOLE, **_GRID, "cell": WHOLE, "next_cell": WHOLE, "seconds": Array(Object({}, Number(low=0)), 1)},
)
"""Format of the files of moments of a fovea."""


class FoveaMomentWords(MomentWords):
    """Words for one frame that a fovea looks at."""

    record: "FoveaMoment"

    def describe(self) -> str:
        """Describe belief and decision at the frame in a few words."""
        highest = float(self.record.probability.max())
        if self.record.target is None:
            return f"p(object) up to {highest:.2f}"
        return self.decision or f"p({self.record.target_name}) up to {highest:.2f}"

    @property
    def lines(self) -> list[str]:
        """The frame and the fixated cell."""
        row, column = divmod(self.record.cell, self.record.grid.columns)
        return [f"frame {self.record.number}, at (column, row): ({column}, {row})"]


@dataclass(frozen=True, kw_only=True, repr=False)
class FoveaMoment(_CellRecord, Moment):
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

    _words = FoveaMomentWords
    _format = _FOVEA
    _tensors = "fixation", "probability", "visited"
    _plain = "number", "cell", "next_cell"

    @property
    def next_point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, the centre of the next cell."""
        x, y = self.grid.centres[self.next_cell].tolist()
        return x, y

    def _looks(self) -> Iterator[RecordedLook]:
        (x, y), (width, height) = self.fixation.tolist(), self.size
        more = {"frame": self.number, **cell_columns(self.grid, self.cell, self.probability)}
        region = (0.0, 0.0, float(width), float(height))
        yield RecordedLook(0, (x, y), region, self.detections[0], sum(self.seconds[0].values()), None, more)

    def belief_map(self, number: int) -> tuple[Grid, Tensor]:
        """The probability of the target, or of any object, in each cell."""
        return self.grid, self.probability

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
        check(len(shared["detections"]) == 1, "lengths", "one look", len(shared["detections"]))
        made = super()._fields(tensors, record, shared)
        cells, visited = len(made["grid"]), len(tensors["visited"])
        check(visited == cells, "visited", f"{cells} cells", visited)
        for name in ("cell", "next_cell"):
            check(record[name] < cells, name, f"a cell number below {cells}", record[name])
        return made

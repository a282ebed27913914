"""The records of looks of a fovea at cells: an episode in a photograph, and a frame of a stream."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from semfov.belief import Belief, Grid
from semfov.data.classes import amount
from semfov.data.inputs import as_image
from semfov.data.windowed import LargePicture
from semfov.decision import Decision
from semfov.episode import STAGES
from semfov.errors import InputError, check
from semfov.io.schema import Array, Field, Json, Maybe, Number, Object, Text
from semfov.kinds import FOVEA
from semfov.paths.base import Moment, Record
from semfov.paths.conversion import Values
from semfov.paths.files import FARTHEST, POSITIVE, WHOLE, Format, SharedFields, check_decided_cell
from semfov.paths.fovea import FoveaLook, FoveaLooks, moment_look
from semfov.paths.late import MadeWhenRead
from semfov.paths.look import LookView
from semfov.paths.regions import Region, named_regions
from semfov.paths.stimulus import Stimulus
from semfov.paths.words import MomentWords, Words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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

# Of f fixations with beliefs over a grid of cells, C classes with the background, and q closer looks.
_FORMAT = Format(
    "scanpath",
    {
        "cells": Field(("f",), dtype=torch.int64, low=0),
        "fixations": Field(("f", 2), mixed=True, low=-FARTHEST, high=FARTHEST),
        # Rounding may bring probabilities above 1, in half precision by a thousandth.
        "probabilities": Field(("f", "cells", "C"), mixed=True, low=0, high=1 + 1e-3),
        "values": Field(("f", "cells"), mixed=True, finite=False),
        "posterior": Field(("f", "cells"), mixed=True, low=0, high=1 + 1e-3, optional=True),
        "presence": Field(("f",), mixed=True, low=0, high=1 + 1e-3, optional=True),
        "closer_regions": Field(("q", 4), mixed=True, low=-FARTHEST, high=FARTHEST, optional=True),
        "closer_values": Field(("q",), mixed=True, low=0, high=1 + 1e-3, optional=True),
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


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class _CellRecord(Record):
    """Base of the records of looks of a fovea at cells."""

    grid: Grid
    looks: tuple[FoveaLook, ...]

    kind = FOVEA

    _tensors: ClassVar[tuple[str, ...]]
    """Attributes that are tensors of a file; those that are None are left out."""

    _plain: ClassVar[tuple[str, ...]] = ()
    """Attributes that are JSON values of a file."""

    @property
    def seconds(self) -> tuple[Mapping[str, float], ...]:
        """Seconds of each look by stage (`semfov.episode.STAGES`); empty if they are not known."""
        stages = tuple(look.stages for look in self.looks)
        return stages if all(stages) else ()

    @property
    def found_at(self) -> tuple[float, float] | None:
        """`(x, y)` in picture pixels of the found target: the middle of its box, or else of its cell; None for none."""
        find = self._find
        if find is None or find.box is not None or find.cell is None:
            return super().found_at
        x, y = self.grid.centres[find.cell].tolist()
        return x, y

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the photograph or frame in pixels."""
        width, height = (int(side) for side in self.grid.extent)
        return width, height

    def _contents(self) -> tuple[dict[str, Tensor | None], Values]:
        tensors = {name: getattr(self, name) for name in self._tensors}
        grid = self.grid
        record = {
            **{name: getattr(self, name) for name in self._plain},
            "grid": [grid.columns, grid.rows],
            "size": grid.size.tolist() if isinstance(grid.size, Tensor) else list(grid.size),
            "seconds": [dict(stages) for stages in self.seconds],
        }
        return tensors, record

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: Values, shared: SharedFields) -> Values:
        columns, rows = record["grid"]
        grid = Grid(columns, rows, tuple(record["size"]))
        looks = len(shared["detections"])
        seconds = len(record["seconds"])
        check(seconds in (0, looks), "seconds", f"times of {looks} looks, or none", seconds)
        check_decided_cell(shared["decision"], len(grid))
        for look in shared["closer"]:
            check((look.cell or 0) < len(grid), "closer", f"a cell below {len(grid)}", look.cell)
        optional_tensors = {name: tensors.get(name) for name in cls._tensors}
        plain_values = {name: record[name] for name in cls._plain}
        return {**optional_tensors, **plain_values, "grid": grid}


class ScanpathWords(Words):
    """Words for a search or an exploration with a fovea."""

    record: Scanpath

    @property
    def decided_by(self) -> str:
        """Kind of the decision's number: `probability`, or `belief` (without thresholds)."""
        record = self.record
        if record.ending == "detection":
            return "belief"
        # Only what was learned has a threshold, a closer look, or a share of the pictures that it assumes.
        has_threshold = record.decision is not None and record.decision.confirm is not None
        is_learned = has_threshold or len(record.closer) > 0 or record.assumed is not None
        return "probability" if is_learned else "belief"

    def describe(self) -> str:
        """Describe the outcome of the episode in one line."""
        record = self.record
        shifts = amount(record.shifts, "gaze shift")
        if record.target is None:
            return f"explored with {shifts}: {self.objects}"
        name = f"“{record.target_name}”"
        if record.decision is None:
            return f"{name} {'found after' if record.found else 'not found in'} {shifts}"
        verdict = f"{name} {self.doubt}not there" if record.verdict == "absent" else self.verdict(name)
        return f"{verdict} after {shifts}{self._closer_looks} ({self._certainty(record.decision)})"

    @property
    def _closer_looks(self) -> str:
        """The number of closer looks, to follow that of gaze shifts; empty without any."""
        count = len(self.record.closer)
        return f" and {amount(count, 'closer look')}" if count else ""

    def _certainty(self, decision: Decision) -> str:
        """Say how sure the decision is."""
        if self.decided_by == "belief":
            # Beliefs without thresholds are no probabilities in the plain sense.
            by = "by a detection at the gaze; " if self.record.ending == "detection" else ""
            return f"{by}its belief gives {decision.probability:.2f}"
        place = "" if decision.place is None else f", {decision.place:.2f} at this place"
        return f"probability {decision.probability:.2f}{place}"

    @property
    def lines(self) -> list[str]:
        """The fixated cells, the first and the last of many, and the grid."""
        grid = self.record.grid
        cells = []
        for cell in self.record.cells.tolist():
            row, column = divmod(cell, grid.columns)
            cells.append(f"({column}, {row})")
        # In a line of a terminal.
        path = " ".join(cells if len(cells) <= 8 else [*cells[:6], "…", cells[-1]])
        width, height = grid.extent.tolist()
        cells_of_grid = f"{grid.columns} × {grid.rows} cells over {width:.0f} × {height:.0f} px"
        return [f"looks at (column, row): {path} of {cells_of_grid}"]


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Scanpath(_CellRecord):
    """Looks of one episode of a fovea in order, fixations and closer looks, with the belief after each fixation.

    A notebook shows a scanpath as an interactive page. `plot`, `animate`, `to_frame` and `save` make a picture, an
    animation, a table and a file.

    In addition to the attributes of `semfov.paths.Record` it has those of its n fixations.

    Attributes:
        grid: the cells of the image.
        looks: the looks; the clock of the episode is the sum of their times so far. The value of a closer look is the
            probability that the target is at the place.
        probabilities: `(n, X·Y, K+1)`, probability that each cell holds each class after each fixation, background
            first.
        values: `(n, X·Y)`, values of the acquisition function, by which the next fixation was chosen.
        posterior: `(n, X·Y)`, probability of the target in each cell after each fixation, by the belief of the search;
            None for exploration.
        presence: `(n,)`, probability that the image holds the target after each fixation; None for exploration.
        stimulus: the data for the foveated views of the photograph; None if it was not kept.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup", how="fovea")
        scanpath.plot().savefig("scanpath.png")
        scanpath.save("scanpath.safetensors")

    >>> from semfov.detection import Detections
    >>> grid, none = Grid(2, 1, (10, 10)), torch.zeros(2, 2)
    >>> fovea = FoveaLooks(grid)
    >>> for cell in (0, 1):
    ...     look = fovea.fixate(cell, grid.centres[cell].tolist(), Detections.empty(1, 1), {}, None, none[0], None)
    >>> fields = {"grid": grid, "looks": tuple(fovea.looks), "probabilities": none, "values": none}
    >>> Scanpath(classes=("background", "cup"), target=1, found=True, **fields).describe()
    '“cup” found after 1 gaze shift'
    """

    probabilities: Tensor = MadeWhenRead()  # type: ignore[assignment]
    values: Tensor
    posterior: Tensor | None = None
    presence: Tensor | None = None
    stimulus: Stimulus | None = None

    _words = ScanpathWords
    _format = _FORMAT
    _page_options = (*Record._page_options, "settings", "classes")
    _tensors = "cells", "fixations", "probabilities", "values", "posterior", "presence"

    def __getstate__(self) -> dict[str, object]:
        # A function that makes the map later cannot be pickled.
        return {**vars(self), "probabilities": self.probabilities}

    @cached_property
    def fixated(self) -> tuple[FoveaLook, ...]:
        """The looks that are fixations, without closer ones."""
        return tuple(look for look in self.looks if not look.is_closer)

    @cached_property
    def cells(self) -> Tensor:
        """`(n,)`, fixated cells."""
        return torch.tensor([look.cell for look in self.fixated], dtype=torch.int64)

    @cached_property
    def fixations(self) -> Tensor:
        """`(n, 2)`, centres of the fixated cells as `(x, y)` in pixels."""
        return torch.tensor([look.fixation for look in self.fixated], dtype=self.values.dtype).view(-1, 2)

    @property
    def shifts(self) -> int:
        """Number of gaze shifts (saccades): fixations after the start."""
        return max(len(self.fixated) - 1, 0)

    def views(self) -> list[Tensor]:
        """Foveate the photograph at each fixation.

        Returns:
            One view `(3, h, w)` in [0, 1] for each fixation.

        Raises:
            InputError: the photograph was not kept.
        """
        if self.stimulus is None:
            raise InputError("scanpath: expected one with its stimulus, as an agent makes it, got one without")
        return self.stimulus.views(self.fixations)

    def fixation_after(self, index: int) -> int:
        """Find the last fixation up to a look: its index in the tensors of the fixations.

        Args:
            index: place of the look in the record, from 0; negative ones count from the end.

        Returns:
            The index of the fixation.

        Raises:
            InputError: the record has no such look.
        """
        return sum(not look.is_closer for look in self.looks[: self._place(index) + 1]) - 1

    def belief_map(self, index: int) -> tuple[Grid, Tensor]:
        """Return the grid, and in each cell the probability, after a look, of the target or the likeliest class."""
        fixation = self.fixation_after(index)
        if self.target is None:
            # Class 0 is the background.
            return self.grid, self.probabilities[fixation, :, 1:].amax(-1)
        # A record may have no belief of the search beside the map of all classes.
        posterior = self.probabilities[..., self.target] if self.posterior is None else self.posterior  # (n, X·Y)
        return self.grid, posterior[fixation]

    def regions(self, index: int = -1) -> Sequence[Region]:
        """Find the regions of the semantic map after a look of an exploration; a search has none."""
        if self.target is not None:
            return ()
        return named_regions(self.grid, self.probabilities[self.fixation_after(index)], self.classes)

    def figures(self, boxes: Tensor | None = None) -> dict[str, Callable[[], Figure]]:
        """List the path, the foveated views, and the belief of a search or the map of an exploration."""
        from semfov.viz import plot_belief, plot_belief_bars, plot_foveated_strip
        from semfov.viz.semantic import plot_semantic_map

        figures = super().figures(boxes)
        figures["views"] = partial(plot_foveated_strip, self)
        if self.target is None:
            figures["map"] = partial(plot_semantic_map, self)
        else:
            figures["belief"] = partial(plot_belief, self, None)
            figures["belief_bars"] = partial(plot_belief_bars, self)
        return figures

    def look_views(self, source: LargePicture) -> Iterator[LookView]:
        """Iterate over foveated views and enlarged windows, or without the stimulus over parts of the picture."""
        parts = super().look_views(source)
        if self.stimulus is None:
            yield from parts
            return
        # There is a view of each fixation, and none of closer looks.
        views = iter(self.views())
        for look, part in zip(self.looks, parts, strict=True):
            if look.is_closer:
                yield part
            else:
                yield LookView(next(views), self.size, look.detections.boxes[0], look.fixation)

    def page_data(self, picture: Any = None, *, name: str | None = None, **options: Any) -> Values:
        """Collect the data of the scanpath for a page (`semfov.report.episode.episode_data`)."""
        from semfov.report.episode import episode_data

        image = self.image if picture is None else as_image(picture)
        views = None if self.stimulus is None else self.views()
        return episode_data(self, image, views, name=name or self._picture_name, **options)

    def _repr_html_(self) -> str:
        from semfov.report.notebook import scanpath_html

        return scanpath_html(self)

    def _contents(self) -> tuple[dict[str, Tensor | None], Values]:
        tensors, record = super()._contents()
        closer = [look for look in self.looks if look.is_closer]
        if closer:
            tensors["closer_regions"] = torch.tensor([look.region for look in closer], dtype=torch.float64)
            tensors["closer_values"] = torch.tensor([look.value for look in closer], dtype=torch.float64)
        # Files of records without the photograph have these values, too.
        record |= {"placement": None, "settings": None}
        if self.stimulus is not None:
            tensors["canvas"] = self.stimulus.canvas
            record["placement"] = {name: list(getattr(self.stimulus.placement, name)) for name in _PLACEMENT}
            record["settings"] = dict(self.stimulus.settings)
        return tensors, record

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: Values, shared: SharedFields) -> Values:
        fields = super()._fields(tensors, record, shared)
        grid = fields["grid"]
        # Each of these is allowed by itself, and has to suit the grid.
        columns = tensors["values"].shape[-1]
        check(columns == len(grid), "values", f"one for each of {len(grid)} cells", columns)
        highest = int(tensors["cells"].max())
        check(highest < len(grid), "cells", f"cell numbers below {len(grid)}", highest)
        looks = _looks_of_file(grid, tensors, record, shared)
        return {**fields, "looks": looks, "stimulus": Stimulus.restored(tensors, record)}


def _looks_of_file(
    grid: Grid, tensors: dict[str, Tensor], record: Values, shared: SharedFields
) -> tuple[FoveaLook, ...]:
    """Make the looks of a scanpath from the tensors and values of a file.

    Detections are of all looks in their order; other tensors are of the fixations alone, or of the closer looks alone.
    A closer look without an index is in `closer` alone, not among the looks.
    """
    close_ups = {close_up.index: close_up for close_up in shared["closer"] if close_up.index is not None}
    detections = shared["detections"]
    seconds = record["seconds"] or [{}] * len(detections)
    cells = tensors["cells"].tolist()
    # Records without closer looks lack these tensors.
    regions = tensors.get("closer_regions", torch.zeros(0, 4)).tolist()
    chances = tensors.get("closer_values", torch.zeros(0)).tolist()
    expected = f"{len(cells)} fixations and {len(regions)} closer looks"
    check(len(detections) == len(cells) + len(regions), "lengths", expected, len(detections))
    have_regions = len(close_ups) == len(regions) == len(chances)
    check(have_regions, "closer_regions", f"{len(close_ups)} regions", len(regions))
    points = tensors["fixations"].tolist()
    fovea = FoveaLooks(grid)
    closer_looks = zip(regions, chances, strict=True)
    fixations = enumerate(zip(cells, points, strict=True))
    for number, (look_detections, stages) in enumerate(zip(detections, seconds, strict=True)):
        if number in close_ups:
            region, chance = next(closer_looks)
            fovea.look_closely(close_ups[number].cell or 0, region, look_detections, stages, chance)
        else:
            fixation, (cell, point) = next(fixations)
            fovea.fixate(cell, point, look_detections, stages, *_belief_of_file(tensors, fixation))
    return tuple(fovea.looks)


def _belief_of_file(tensors: Mapping[str, Tensor], fixation: int) -> tuple[float | None, Tensor | None, float | None]:
    """Read what was believed at a fixation: the value of its cell, and what it makes of the target's probabilities.

    Args:
        tensors: `cells` `(f,)` and `values` `(f, X·Y)`, and of a search `posterior` `(f, X·Y)` and `presence` `(f,)`.
        fixation: its number, from 0.

    Returns:
        The value for which the cell was chosen, and after the fixation the probability of the target in each cell
        `(X·Y,)` and in the picture.
    """
    posterior = tensors.get("posterior")
    presence = tensors.get("presence")
    # A cell is chosen by its value after the fixation before; the start is not chosen.
    value = float(tensors["values"][fixation - 1, int(tensors["cells"][fixation])]) if fixation else None
    probability = None if posterior is None else posterior[fixation]
    return value, probability, None if presence is None else float(presence[fixation])


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

    record: FoveaMoment

    def describe(self) -> str:
        """Describe belief and decision at the frame in a few words."""
        highest = float(self.record.probability.max())
        if self.record.target is None:
            return f"p(object) up to {highest:.2f}"
        return self.decision or f"p({self.record.target_name}) up to {highest:.2f}"

    @property
    def lines(self) -> list[str]:
        """The frame and the fixated cell."""
        row, column = divmod(self.record.cell, self.record.grid.columns)  # cells are counted row by row
        return [f"frame {self.record.number}, at (column, row): ({column}, {row})"]


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class FoveaMoment(_CellRecord, Moment):
    """Look, belief and decision at one frame of a stream with a fovea.

    In addition to the attributes of `Moment` it has those of its look.

    Attributes:
        grid: the cells.
        looks: the look at this frame; `open` is the stage in which the frame is fitted into the detector's input. A
            closer look has the stage `detect` alone.
        probability: `(X·Y,)`, probability that each cell holds the target, or any object in an exploration, after the
            last look that was not a closer one.
        visited: `(X·Y,)` boolean, cells that inhibition of return excludes.
        next_cell: the cell to look at in the next frame.
        belief: the belief of the episode; None in a moment from a file.

    Example::

        moment = live.step(frame)
        print(moment.decision.outcome, moment.probability.max())
    """

    probability: Tensor
    visited: Tensor
    next_cell: int
    belief: Belief | None = field(default=None, compare=False)
    photograph: Tensor | None = MadeWhenRead(None)  # type: ignore[assignment]

    _words = FoveaMomentWords
    _format = _FOVEA
    _tensors = "fixation", "probability", "visited"
    _plain = "number", "cell", "next_cell"

    @property
    def next_point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, the centre of the next cell."""
        x, y = self.grid.centres[self.next_cell].tolist()
        return x, y

    @property
    def seconds(self) -> tuple[Mapping[str, float], ...]:
        """Seconds of the look by stage, one mapping."""
        return (self.looks[0].stages,)

    @property
    def cell(self) -> int:
        """The fixated cell, or the one that was looked at closely."""
        return self.looks[0].cell

    @property
    def fixation(self) -> Tensor:
        """`(2,)`, the centre of the cell as `(x, y)` in pixels."""
        return torch.tensor(self.looks[0].fixation, dtype=self.probability.dtype)

    def belief_map(self, index: int) -> tuple[Grid, Tensor]:
        """Return the probability of the target, or of any object, in each cell."""
        self._place(index)
        return self.grid, self.probability

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: Values, shared: SharedFields) -> Values:
        looks = shared["detections"]
        check(len(looks) == 1, "lengths", "one look", len(looks))
        fields = super()._fields(tensors, record, shared)
        grid = fields["grid"]
        visited = len(tensors["visited"])
        check(visited == len(grid), "visited", f"{len(grid)} cells", visited)
        for name in ("cell", "next_cell"):
            check(record[name] < len(grid), name, f"a cell number below {len(grid)}", record[name])
        stages = record["seconds"][0] if record["seconds"] else {}
        look = moment_look(grid, record["number"], record["cell"], looks[0], tensors["probability"], stages)
        return {**fields, "looks": (look,)}

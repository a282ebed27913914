"""The objects of a record in figures: boxes with labels, the picture below them, and the legend of the boxes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.paths import Record
from semfov.paths.conversion import Values
from semfov.viz.drawing import Tag, draw_boxes, draw_grid, draw_image, draw_tags
from semfov.viz.labels import LabelBox, at_both_ends
from semfov.viz.style import FOUND, TARGET, TRUTH

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

_NAMED = 15  # largest number of objects whose labels name their class where only one class was searched for
_LABELLED = 60  # largest number of objects that have labels
_LEGEND_LETTERS = 115  # largest number of letters of a legend in one line


_Dashes = Literal["-", "--", ":"]
"""Styles of lines, as matplotlib names them: solid, dashed and dotted."""


class LegendEntry(NamedTuple):
    """Entry of a legend: colour, line style and text."""

    colour: str
    line: _Dashes
    text: str


class Mark(NamedTuple):
    """Box `(x1, y1, x2, y2)` that a figure draws, in a colour, with a line of a style and a width.

    `text` is that of its label; None for a box without one.
    """

    box: LabelBox
    colour: str
    line: _Dashes
    width: float
    text: str | None = None


def draw_place(axes: Axes, grid: Grid, image: Tensor, boxes: Tensor | None) -> None:
    """Draw the picture, the cells of a fovea, and the true boxes of the target.

    Args:
        axes: axes to draw in.
        grid: cells over the picture (`grid_of`).
        image: `(3, h, w)`, the picture.
        boxes: `(M, 4)`, true boxes; None for none.
    """
    draw_image(axes, image, grid)
    draw_grid(axes, grid)
    if boxes is not None:
        draw_boxes(axes, boxes, TRUTH, "--", 1.8)


def grid_of(record: Record) -> Grid:
    """Find the cells at which a fovea looks; for other kinds of look the picture is a single one."""
    grid_and_belief = record.belief_map(0) if record.kind.grid else None
    return Grid(1, 1, record.size) if grid_and_belief is None else grid_and_belief[0]


def annotation_entries(record: Record, boxes: Tensor | None) -> list[LegendEntry]:
    """Make the entry of a legend for the true boxes of the target, where there are any."""
    if boxes is None or not len(boxes):
        return []
    return [LegendEntry(TRUTH, "--", f"annotated: {record.target_name or 'target'}")]


def object_entries(record: Record) -> list[LegendEntry]:
    """Make the entries of a legend for the boxes of a record: objects, the best place, and refuted places."""
    name = record.target_name or "objects"
    confirmed = int(record.confirmed.sum())
    others = len(record.objects) - confirmed
    entries = []
    if confirmed:
        entries.append(LegendEntry(FOUND, "-", f"confirmed: {name} ({confirmed})"))
    if others:
        # Where nothing can be confirmed, that an object was not goes without saying.
        can_be_confirmed = bool(confirmed) or record.decision is not None
        doubt = "not confirmed: " if can_be_confirmed else ""
        entries.append(LegendEntry(TARGET, "-", f"{doubt}{name} from {record.words.threshold} ({others})"))
    refuted = [look.box for look in record.refuted]
    if record.best_place is not None:
        best, _ = record.best_place
        entries.append(LegendEntry(FOUND, "--", "best place, not sure enough"))
        refuted = [box for box in refuted if not box.equal(best)]
    if refuted:
        entries.append(LegendEntry(FOUND, ":", "not confirmed by a closer look"))
    return entries


def draw_legend(axes: Axes, entries: Sequence[LegendEntry]) -> None:
    """Draw a legend below the axes, in two columns if it is long; none without entries."""
    from matplotlib.lines import Line2D

    if not entries:
        return
    lines = [Line2D([], [], linewidth=1.8, color=entry.colour, linestyle=entry.line) for entry in entries]
    letters = sum(len(entry.text) + 6 for entry in entries)
    legend = axes.legend(
        lines,
        [entry.text for entry in entries],
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        ncols=len(entries) if letters < _LEGEND_LETTERS else 2,
        frameon=False,
        handlelength=1.6,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)


def object_marks(record: Record, last: float = math.inf) -> list[Mark]:
    """List the boxes of a record in the order in which they are drawn.

    First come places that a closer look refuted, then the objects, the most confident last, over the others, and then
    the best place of a search that leaves it open. A box over the seam of a panorama is drawn at both ends.

    Args:
        record: the record.
        last: place of the last look that counts, from 0; infinity for all.

    Returns:
        The boxes, with labels for objects and for the best place.
    """
    refuted = [look.box for look in record.refuted if look.index_of_look <= last]
    marks = [Mark(_corners(box), FOUND, ":", 1.6) for box in refuted]
    rows = [row for row in record.object_rows() if row["look"] - 1 <= last]
    many = len(rows) > _NAMED
    for row in reversed(rows):
        marks += _marks_of_object(row, record, many=many)
    # Before the last look nothing is decided, so that no place is the best one.
    if record.best_place is not None and last >= len(record) - 1:
        marks.append(_mark_of_best_place(record, *record.best_place))
    return marks


def _mark_of_best_place(record: Record, box: Tensor, chance: float) -> Mark:
    """Make the box of the best place, without a label where an object with the same box has one."""
    has_label = bool((record.objects.boxes == box).all(-1).any())
    text = None if has_label else f"best place {chance:.2f}"
    return Mark(_corners(box), FOUND, "--", 2.4, text)


def _marks_of_object(row: Values, record: Record, *, many: bool) -> list[Mark]:
    """Make the box of an object, at both ends of a panorama where it crosses the seam.

    Args:
        row: the row of the object (`Record.object_rows`).
        record: its record.
        many: whether there are too many objects for long names and thick lines.

    Returns:
        The box, or both.
    """
    score = f"{row['score']:.2f}"
    # The name would only repeat the class that was searched for, and take room that many labels do not have.
    one_class = many and record.target is not None
    text = score if one_class else f"{row['class']} {score}"
    colour = TARGET
    line_width = 0.8 if many else 1.2
    if row["confirmed"]:
        colour = FOUND
        line_width = 2.0
    box = (row["x1"], row["y1"], row["x2"], row["y2"])
    return [Mark(part, colour, "-", line_width, text) for part in at_both_ends(box, record.size[0])]


def draw_marks(axes: Axes, marks: Sequence[Mark]) -> list[Artist]:
    """Draw boxes without their labels; returns what was drawn."""
    drawn: list[Artist] = []
    for mark in marks:
        drawn += draw_boxes(axes, Tensor([mark.box]), mark.colour, mark.line, mark.width)
    return drawn


def draw_mark_labels(axes: Axes, record: Record, marks: Sequence[Mark], obstacles: Sequence[LabelBox]) -> None:
    """Write the labels of the boxes of a record, of many those of the most confident ones.

    Args:
        axes: axes that are laid out.
        record: the record.
        marks: boxes of all its looks (`object_marks`).
        obstacles: rectangles that no label covers.
    """
    # The labels of the most confident objects are placed first, and have the best places.
    tags = [Tag(mark.box, mark.text, mark.colour) for mark in reversed(marks) if mark.text is not None]
    draw_tags(axes, tags[:_LABELLED], record.size, obstacles, many=len(record.objects) > _NAMED)


def _corners(box: Tensor) -> LabelBox:
    x1, y1, x2, y2 = box.tolist()
    return x1, y1, x2, y2

"""The objects of a record in a figure: confirmed boxes and others, with scores and a legend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.paths import Record
from semfov.paths.merging import number_of
from semfov.viz.drawing import LABEL, Tag, draw_boxes, draw_tags
from semfov.viz.labels import LabelBox
from semfov.viz.style import FOUND, TARGET

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

LegendEntry = tuple[str, str, str]
"""Colour, line style and text of an entry of a legend."""

_NAMED = 15  # largest number of objects whose labels name their class where only one class was searched for
_LABELLED = 60  # largest number of objects that have labels
_SMALL = 5.0  # font size of the labels of many objects


def draw_objects(
    axes: Axes,
    record: Record,
    obstacles: Sequence[LabelBox] = (),
    *,
    last: int | None = None,
    tagged: bool = True,
) -> list[Artist]:
    """Draw the objects of a record with their scores; a box across the seam of a panorama is drawn at both ends.

    For labels the figure must be laid out, because their positions depend on the layout.
    """
    last = len(record) if last is None else last
    rows = [row for row in record.object_rows() if row["look"] <= last]
    width, height = record.size
    refuted = [look.box for look in record.refuted if number_of(look) <= last]
    drawn = [artist for box in refuted for artist in draw_boxes(axes, box[None], FOUND, ":", 1.6)]
    tags: list[Tag] = []
    many = len(rows) > _NAMED
    single = many and record.target is not None
    # The most confident objects are drawn last, over the others.
    for row in reversed(rows):
        colour, line = (FOUND, 2.0) if row["confirmed"] else (TARGET, 0.8 if many else 1.2)
        text = f"{row['score']:.2f}" if single else f"{row['class']} {row['score']:.2f}"
        for turn in (0, width) if row["x2"] > width else (0,):
            box = row["x1"] - turn, row["y1"], row["x2"] - turn, row["y2"]
            drawn += draw_boxes(axes, Tensor([box]), colour, width=line)
            tags.append(Tag(box, text, colour))
    if tagged:
        drawn += draw_tags(axes, tags[::-1][:_LABELLED], (width, height), obstacles, _SMALL if many else LABEL)
    return drawn


def draw_legend(axes: Axes, entries: Sequence[LegendEntry]) -> None:
    """Draw a legend below the picture."""
    from matplotlib.lines import Line2D

    if not entries:
        return
    styles: list[dict[str, Any]] = [{"color": colour, "linestyle": line} for colour, line, _ in entries]
    lines = [Line2D([], [], linewidth=1.8, **style) for style in styles]
    legend = axes.legend(
        lines,
        [text for _, _, text in entries],
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        ncols=len(entries) if len(entries) < 4 else 2,
        frameon=False,
        handlelength=1.6,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)

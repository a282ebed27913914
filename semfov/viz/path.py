"""Drawing of looks: the path of the gaze, numbered and coloured by time, and outlines of what looks show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semfov.paths import Record, RecordedLook
from semfov.paths.look import Box, shorter_way
from semfov.viz.drawing import lightness, per_point
from semfov.viz.labels import LabelBox, place_numbers
from semfov.viz.style import FOUND, GAZE, TIME

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from matplotlib.text import Annotation, Text

_POINTS = 6.5


class LookPath:
    """The looks of a record: outlines of what they show, and the path of the gaze or, of windows, their numbers.

    `gaze` is the path; None for windows, whose outlines have numbers instead. `number_boxes` are the rectangles of all
    numbers, which labels should not cover.

    Args:
        axes: axes that are laid out.
        record: the record.
    """

    def __init__(self, axes: Axes, record: Record) -> None:
        self.gaze: GazePath | None = None
        self.number_boxes: list[LabelBox] = []
        self._outlines: list[tuple[int, Line2D]] = []
        self._numbers: list[tuple[int, Text]] = []
        if record.kind.path:
            points = np.array([look.fixation for look in record]).reshape(-1, 2)  # also without a look
            self.gaze = GazePath(axes, points, record.size, found=record.found, around=record.around)
            self.number_boxes = self.gaze.number_boxes
        for look in record:
            self._draw_outline(axes, record, look)
        if self.gaze is None:
            self._write_numbers(axes, record)

    def _draw_outline(self, axes: Axes, record: Record, look: RecordedLook) -> None:
        """Draw the border of what a look shows, unless it shows the whole picture."""
        border = record.outline(look)
        if border is None:
            return
        x, y = border.numpy().T
        # The picture of a panorama repeats, so that an outline over its seam is drawn at both ends.
        shifts = (0.0,) if record.around is None else (-record.around, 0.0, record.around)
        for shift in shifts:
            (line,) = axes.plot(x + shift, y, color=GAZE, linewidth=0.8, scalex=False, scaley=False)
            self._outlines.append((look.index, line))

    def _write_numbers(self, axes: Axes, record: Record) -> None:
        """Write the number of each look that shows a part of the picture into its outline."""
        room = 0.025 * record.size[0]
        middles: list[tuple[float, float]] = []
        for look in record:
            if record.outline(look) is None:
                continue
            middle = _number_place(look.region, room, middles)
            text = axes.text(
                *middle,
                str(look.number),
                color="white",
                fontsize=6,
                ha="center",
                va="center",
                bbox={"facecolor": GAZE, "edgecolor": "none", "pad": 0.8},
            )
            middles.append(middle)
            self._numbers.append((look.index, text))
        self.number_boxes += [(x - room / 2, y - room / 2, x + room / 2, y + room / 2) for x, y in middles]

    def show(self, last: int) -> None:
        """Show the looks up to `last`, whose outline is wider."""
        if self.gaze is not None:
            self.gaze.show(last)
        for number, artist in (*self._outlines, *self._numbers):
            artist.set_visible(number <= last)
        for number, line in self._outlines:
            line.set_linewidth(2.0 if number == last else 0.8)


def _number_place(region: Box, room: float, others: list[tuple[float, float]]) -> tuple[float, float]:
    """Choose where the number of a window stands: at the corner farthest from other numbers, or in the middle.

    Distances beyond the width of a number count the same, so that the first free corner is taken.

    Args:
        region: `(x1, y1, x2, y2)`, what the look shows.
        room: width of a number, in pixels of the picture.
        others: middles of the other numbers.

    Returns:
        The middle of the number.
    """
    x1, y1, x2, y2 = region
    left = x1 + room / 2
    right = x2 - room / 2
    top = y1 + room / 2
    bottom = y2 - room / 2
    middle = ((x1 + x2) / 2, (y1 + y2) / 2)
    places = [(left, top), (right, top), (left, bottom), (right, bottom), middle]

    def free_distance(place: tuple[float, float]) -> float:
        """Measure the distance to the nearest other number, up to the width of one."""
        u, v = place
        distances = [max(abs(u - x), abs(v - y)) for x, y in others]
        return min([room, *distances])

    return max(places, key=free_distance)


class GazePath:
    """Saccades as lines and fixations as numbered dots, laid out once.

    `segments` `(pieces · n, 2, 2)` are the lines in their order, of which each saccade has `pieces`: one, or two around
    a panorama, which leave it at one end and come back at the other. Row i of `path` and `colours` is a fixation.

    Args:
        axes: axes that are laid out.
        fixations: `(n, 2)`, in pixels.
        frame: `(width, height)` of the picture.
        found: whether the target was found at the last one.
        around: width after which the picture repeats; saccades then take the short way.
    """

    def __init__(
        self,
        axes: Axes,
        fixations: NDArray[np.float64],
        frame: tuple[float, float],
        *,
        found: bool,
        around: float | None = None,
    ) -> None:
        from matplotlib import colormaps
        from matplotlib.collections import LineCollection

        # Pixel centres are at integers, and in figures the corner of the picture is at 0.
        self.path = fixations + 0.5  # (n, 2)
        self.frame = frame
        self.found = found
        count = len(self.path)
        self.colours = colormaps[TIME](np.linspace(0, 1, max(count, 2))[:count])
        pieces = _saccades(self.path, around)
        self.pieces = len(pieces)
        # (pieces · (n - 1), 2, 2): start and end of each line, the pieces of one saccade after each other.
        self.segments = np.concatenate(pieces, 1).reshape(-1, 2, 2)
        # A light line below the coloured one shows it on any picture.
        light = LineCollection(list(self.segments), colors=(1, 1, 1, 0.7), linewidths=1.6)
        coloured = LineCollection(
            list(self.segments), colors=np.repeat(self.colours[1:], self.pieces, 0), linewidths=0.8
        )
        self.lines = [light, coloured]
        for lines in self.lines:
            axes.add_collection(lines, autolim=False)
        x, y = self.path.T
        self.dots = axes.scatter(x, y, s=16, c=self.colours, edgecolors="white", linewidths=0.6, zorder=5)
        scale = per_point(axes)
        places = self._places_of_numbers(scale)
        self.number_boxes: list[LabelBox] = [place for place in places if place is not None]
        self.numbers = self._numbers(axes, places, scale)
        self.show(count - 1)

    def _places_of_numbers(self, scale: float) -> list[LabelBox | None]:
        """Find room for the number of each fixation on its dot or near it; None where there is none."""
        # The width of a digit is about 0.64 of the font size, and the frame adds 4 points.
        height = (_POINTS + 4) * scale
        points: list[tuple[float, float]] = []
        sizes: list[tuple[float, float]] = []
        for number, (x, y) in enumerate(self.path.tolist(), 1):
            digits = len(str(number))
            points.append((x, y))
            sizes.append(((0.64 * digits * _POINTS + 4.5) * scale, height))
        return place_numbers(points, sizes, self.frame, 60 * scale)

    def _numbers(self, axes: Axes, places: Sequence[LabelBox | None], scale: float) -> list[Annotation | None]:
        """Write the numbers of the fixations into their places; None where a number has none."""
        numbers: list[Annotation | None] = []
        for index, place in enumerate(places):
            numbers.append(None if place is None else self._number(axes, index, place, scale))
        return numbers

    def _number(self, axes: Axes, index: int, place: LabelBox, scale: float) -> Annotation:
        """Write the number of a fixation into a rectangle; a line joins it to its dot if it is not written on it."""
        x, y = self.path[index].tolist()
        left, top, right, bottom = place
        middle = ((left + right) / 2, (top + bottom) / 2)
        is_beside = max(abs(x - middle[0]), abs(y - middle[1])) > scale
        colour = self.colours[index]
        line = {"arrowstyle": "-", "color": "white", "linewidth": 0.7, "shrinkA": 0, "shrinkB": 0}
        return axes.annotate(
            str(index + 1),
            xy=(x, y),
            xytext=middle,
            color="white" if lightness(colour) < 0.55 else "black",
            fontsize=_POINTS,
            fontweight="bold",
            ha="center",
            va="center",
            zorder=6,
            bbox={
                "boxstyle": "round,pad=0.22,rounding_size=0.5",
                "facecolor": colour,
                "edgecolor": "white",
                "linewidth": 0.7,
            },
            arrowprops=line if is_beside else None,
        )

    def show(self, last: int) -> None:
        """Show the fixations up to `last`; a frame marks its number, in green if the target was found there."""
        for lines in self.lines:
            lines.set_segments(list(self.segments[: last * self.pieces]))
        self.dots.set_offsets(self.path[: last + 1])
        self.dots.set_facecolor([tuple(colour) for colour in self.colours[: last + 1]])
        for number, text in enumerate(self.numbers):
            if text is not None:
                text.set_visible(number <= last)
                self._frame_number(text, is_last=number == last)

    def _frame_number(self, text: Annotation, *, is_last: bool) -> None:
        """Draw the frame of a number: of the last one shown a thicker one, in green where the target was found."""
        frame = text.get_bbox_patch()
        assert frame is not None  # all numbers are written with one
        colour = "white"
        if is_last and self.found and text is self.numbers[-1]:
            colour = FOUND
        frame.set(edgecolor=colour, linewidth=1.6 if is_last else 0.7)


def _saccades(path: NDArray[np.float64], around: float | None) -> list[NDArray[np.float64]]:
    """Make the lines between fixations `(n, 2)`: `(n - 1, 2, 2)`, around a panorama twice, once from each end."""
    starts = path[:-1]
    ends = path[1:]
    if around is None:
        return [np.stack([starts, ends], 1)]
    steps = ends - starts
    steps[:, 0] = shorter_way(steps[:, 0], around)
    return [np.stack([starts, starts + steps], 1), np.stack([ends - steps, ends], 1)]

"""Drawing of looks: the path of the gaze, numbered and coloured by time, and outlines of what looks show."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semfov.paths import Record
from semfov.viz.drawing import lightness, per_point
from semfov.viz.labels import LabelBox, place_numbers
from semfov.viz.style import FOUND, GAZE, TIME

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Annotation

_POINTS = 6.5


class LookPath:
    """The looks of a record: outlines of what they show, and the path of the gaze or, of windows, their numbers."""

    def __init__(self, axes: Axes, record: Record) -> None:
        self.gaze: GazePath | None = None
        self.number_boxes: list[LabelBox] = []
        self._outlines: list[tuple[int, Any]] = []
        self._numbers: list[tuple[int, Any]] = []
        width = record.around
        if record.kind.path:
            points = np.array([look.fixation for look in record]).reshape(-1, 2)
            found = bool(getattr(record, "found", False))
            self.gaze = GazePath(axes, points, record.size, found=found, around=width)
            self.number_boxes = self.gaze.number_boxes
        room, middles = 0.025 * record.size[0], list[tuple[float, float]]()
        for look in record:
            border = record.outline(look)
            if border is None:
                continue
            x, y = border.numpy().T
            for shift in (0.0,) if width is None else (-width, 0.0, width):
                (line,) = axes.plot(x + shift, y, color=GAZE, linewidth=0.8, scalex=False, scaley=False)
                self._outlines.append((look.number, line))
            if self.gaze is None:
                x1, y1, x2, y2 = look.region
                left, right, top, bottom = x1 + room / 2, x2 - room / 2, y1 + room / 2, y2 - room / 2
                places = [(left, top), (right, top), (left, bottom), (right, bottom), ((x1 + x2) / 2, (y1 + y2) / 2)]
                # The corner farthest from other numbers, or the middle. Distances beyond the width of a number count
                # the same, so that the first free corner is taken.
                far = [min([room, *(max(abs(u - x), abs(v - y)) for x, y in middles)]) for u, v in places]
                middles.append(places[far.index(max(far))])
                text = axes.text(*middles[-1], str(look.number), color="white", fontsize=6, ha="center", va="center",
                                 bbox={"facecolor": GAZE, "edgecolor": "none", "pad": 0.8})  # fmt: skip
                self._numbers.append((look.number, text))
        self.number_boxes += [(x - room / 2, y - room / 2, x + room / 2, y + room / 2) for x, y in middles]

    def show(self, last: int) -> None:
        """Show the looks up to `last`, whose outline is wider."""
        if self.gaze is not None:
            self.gaze.show(last)
        for number, artist in (*self._outlines, *self._numbers):
            artist.set_visible(number <= last)
        for number, line in self._outlines:
            line.set_linewidth(2.0 if number == last else 0.8)


class GazePath:
    """Saccades as lines and fixations `(n, 2)` as numbered dots, laid out once; lines take the short way `around`."""

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

        self.path, self.frame, self.found = fixations + 0.5, frame, found
        count = len(self.path)
        self.colours = colormaps[TIME](np.linspace(0, 1, max(count, 2))[:count])
        before, after = self.path[:-1], self.path[1:]
        segments = [np.stack([before, after], 1)]
        if around is not None:
            way = after - before
            way[:, 0] = (way[:, 0] + around / 2) % around - around / 2
            segments = [np.stack([before, before + way], 1), np.stack([after - way, after], 1)]
        self.segments = np.concatenate(segments, 1).reshape(-1, 2, 2)
        self.each = len(segments)
        coloured = np.repeat(self.colours[1:], self.each, 0)
        self.lines: list[Any] = [
            axes.add_collection(LineCollection(list(self.segments), colors=colours, linewidths=width), autolim=False)
            for colours, width in (((1, 1, 1, 0.7), 1.6), (coloured, 0.8))
        ]
        x, y = self.path.T
        self.dots = axes.scatter(x, y, s=16, c=self.colours, edgecolors="white", linewidths=0.6, zorder=5)
        self.numbers = self._numbers(axes)
        self.show(count - 1)

    def _numbers(self, axes: Axes) -> list[Annotation | None]:
        scale, count = per_point(axes), len(self.path)
        # The width of a digit is about 0.64 of the font size, and the frame adds 4 points.
        sizes = [((0.64 * len(str(n)) * _POINTS + 4.5) * scale, (_POINTS + 4) * scale) for n in range(count)]
        points = [(float(x), float(y)) for x, y in self.path]
        places = place_numbers(points, sizes, self.frame, 60 * scale)
        self.number_boxes: list[LabelBox] = [place for place in places if place is not None]
        written: list[Annotation | None] = []
        for number, (point, place) in enumerate(zip(points, places, strict=True)):
            if place is None:
                written.append(None)
                continue
            colour = self.colours[number]
            box = {"boxstyle": "round,pad=0.22,rounding_size=0.5", "facecolor": colour, "edgecolor": "white",
                   "linewidth": 0.7}  # fmt: skip
            middle = (place[0] + place[2]) / 2, (place[1] + place[3]) / 2
            # A line joins a number to its point if it is not written on it.
            off = max(abs(a - b) for a, b in zip(point, middle, strict=True)) > scale
            arrow = {"arrowstyle": "-", "color": "white", "linewidth": 0.7, "shrinkA": 0, "shrinkB": 0}
            text = axes.annotate(
                str(number),
                xy=point,
                xytext=middle,
                color="white" if lightness(colour) < 0.55 else "black",
                fontsize=_POINTS,
                fontweight="bold",
                ha="center",
                va="center",
                zorder=6,
                bbox=box,
                arrowprops=arrow if off else None,
            )
            written.append(text)
        return written

    def show(self, last: int) -> None:
        """Show the fixations up to `last`; a frame marks its number, in green if the target was found there."""
        for lines in self.lines:
            lines.set_segments(list(self.segments[: last * self.each]))
        self.dots.set_offsets(self.path[: last + 1])
        self.dots.set_facecolor([tuple(colour) for colour in self.colours[: last + 1]])
        for number, text in enumerate(self.numbers):
            if text is not None:
                text.set_visible(number <= last)
                ends = number == last
                box: Any = text.get_bbox_patch()
                found = ends and self.found and last == len(self.path) - 1
                box.set(edgecolor=FOUND if found else "white", linewidth=1.6 if ends else 0.7)

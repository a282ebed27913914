"""Drawing of the gaze's path: numbered fixations, coloured by time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from semfov.data.fixations.record import FixationValues
from semfov.paths import Scanpath
from semfov.viz.drawing import lightness, per_point
from semfov.viz.labels import LabelBox, place_numbers
from semfov.viz.style import FOUND, TIME

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Annotation

_POINTS = 6.5


def path_of(axes: Axes, scanpath: Scanpath) -> GazePath:
    """Draw the path of an episode."""
    width, height = scanpath.grid.extent.tolist()
    points = scanpath.fixations.detach().double().cpu().numpy()
    return GazePath(axes, points, (width, height), found=scanpath.found)


class GazePath:
    """Saccades as thin lines and fixations as numbered dots, from dark to bright in the order of time.

    All is laid out once, for the whole episode, so a fixation looks the same however much of the path is shown.

    Shapes: fixations `(n, 2)`, frame `(width, height)`.
    """

    def __init__(self, axes: Axes, fixations: FixationValues, frame: tuple[float, float], *, found: bool) -> None:
        from matplotlib import colormaps
        from matplotlib.collections import LineCollection

        self.path, self.frame, self.found = fixations + 0.5, frame, found
        count = len(self.path)
        self.colours = colormaps[TIME](np.linspace(0, 1, max(count, 2))[:count])
        lines = np.stack([self.path[:-1], self.path[1:]], 1)
        self.lines: list[Any] = [
            axes.add_collection(LineCollection(list(lines), colors=colours, linewidths=width), autolim=False)
            for colours, width in (((1, 1, 1, 0.7), 1.6), (self.colours[1:], 0.8))
        ]
        self.segments = lines
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

    def show(self, last: int) -> list[Any]:
        """Show the fixations up to `last`; a frame marks its number, in green if the target was found there."""
        for lines in self.lines:
            lines.set_segments(list(self.segments[:last]))
        self.dots.set_offsets(self.path[: last + 1])
        self.dots.set_facecolor([tuple(colour) for colour in self.colours[: last + 1]])
        for number, text in enumerate(self.numbers):
            if text is not None:
                text.set_visible(number <= last)
                ends = number == last
                box: Any = text.get_bbox_patch()
                found = ends and self.found and last == len(self.path) - 1
                box.set(edgecolor=FOUND if found else "white", linewidth=1.6 if ends else 0.7)
        return [*self.lines, self.dots, *(text for text in self.numbers if text is not None)]

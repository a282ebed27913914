"""Figure of ways to look at pictures: what each finds over seconds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from semfov.viz.style import COLOURS, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARKERS = ("o", "s", "^")


class ComparedPoint(Protocol):
    """What a way of looking finds with some passes."""

    @property
    def way(self) -> str: ...
    @property
    def passes(self) -> float: ...
    @property
    def seconds(self) -> float: ...
    @property
    def ap50(self) -> float | None: ...


@styled
def plot_comparison(points: Sequence[ComparedPoint], measure: str = "AP50") -> Figure:
    """Draw the average precision of each way of looking over its seconds; numbers at the points are passes.

    Args:
        points: the points of all ways.
        measure: what their average precision is called.

    Returns:
        The figure.
    """
    figure, (axes,) = make_figure(1, 1, 5.2, 3.4, layout="constrained")
    ways = dict.fromkeys(point.way for point in points)
    for number, way in enumerate(ways):
        judged = [point for point in points if point.way == way and point.ap50 is not None]
        seconds = [point.seconds for point in judged]
        heights = [point.ap50 or 0.0 for point in judged]
        colour = COLOURS[number % len(COLOURS)]
        axes.plot(seconds, heights, marker=_MARKERS[number % len(_MARKERS)], color=colour, label=way)
        for point, x, y in zip(judged, seconds, heights, strict=True):
            # A little above the point.
            axes.annotate(
                f"{point.passes:.3g}",
                (x, y),
                xytext=(0, 5),
                textcoords="offset points",
                ha="center",
                color=colour,
                fontsize=7,
            )
    axes.set(xlabel="seconds a picture", ylabel=measure, xlim=(0, None), ylim=(0, 1.1))
    axes.legend(loc="lower right")
    return figure

"""Figure that compares ways to look at pictures: objects found over seconds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from semfov.viz.style import COLOURS, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKERS = ("o", "s", "^")


class ComparedPoint(Protocol):
    """Result of one way of looking with a number of passes."""

    @property
    def way(self) -> str: ...
    @property
    def passes(self) -> float: ...
    @property
    def seconds(self) -> float: ...
    @property
    def ap50(self) -> float | None: ...


@styled
def plot_comparison(points: Sequence[ComparedPoint], measure: str) -> Figure:
    """Draw the average precision of each way of looking over its seconds; numbers at the points are passes.

    Args:
        points: the points of all ways.
        measure: what their average precision is called.

    Returns:
        The figure.
    """
    figure, (axes,) = make_figure(1, 1, 5.2, 3.4, layout="constrained")
    points_of_way: dict[str, list[ComparedPoint]] = {}
    for point in points:
        points_of_way.setdefault(point.way, []).append(point)
    for number, (way, points_in_order) in enumerate(points_of_way.items()):
        marker = _MARKERS[number % len(_MARKERS)]
        _draw_way(axes, way, points_in_order, COLOURS[number % len(COLOURS)], marker)
    axes.set(xlabel="seconds a picture", ylabel=measure, xlim=(0, None), ylim=(0, 1.1))
    axes.legend(loc="lower right")
    return figure


def _draw_way(axes: Axes, way: str, points: Sequence[ComparedPoint], colour: str, marker: str) -> None:
    """Draw the points of a way of looking, those without a precision left out, with a line from one to the next."""
    seconds = []
    precisions = []
    for point in points:
        if point.ap50 is None:
            continue
        seconds.append(point.seconds)
        precisions.append(point.ap50)
        axes.annotate(
            f"{point.passes:.3g}",
            (point.seconds, point.ap50),
            xytext=(0, 5),  # a little above the point
            textcoords="offset points",
            ha="center",
            color=colour,
            fontsize=7,
        )
    axes.plot(seconds, precisions, marker=marker, color=colour, label=way)

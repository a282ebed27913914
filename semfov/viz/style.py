"""One look for all figures: colours that everyone can tell apart, lines, fonts, sizes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, Literal, ParamSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette: told apart with every common form of colour blindness."""

GAZE, TARGET, FOUND, TRUTH, OTHER = COLOURS[0], COLOURS[1], COLOURS[2], COLOURS[4], COLOURS[5]
"""Colours with a meaning: the scanpath, the target's detections, its end, annotated boxes, other detections."""

LINES = ("-", "--", "-.", ":")

PROBABILITY = "viridis"
UNCERTAINTY = "cividis"
"""Colour maps; both grow steadily in lightness, in grey print too."""

STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
}

Arguments = ParamSpec("Arguments")


def styled(plot: Callable[Arguments, Figure]) -> Callable[Arguments, Figure]:
    """Draw a figure with `STYLE`, whatever the caller's settings of matplotlib are."""

    @wraps(plot)
    def draw(*arguments: Arguments.args, **options: Arguments.kwargs) -> Figure:
        from matplotlib import rc_context

        with rc_context(STYLE):
            figure = plot(*arguments, **options)
            # Matplotlib makes the labels of ticks when it draws: they would come in the caller's fonts.
            figure.draw_without_rendering()
            return figure

    return draw


def make_figure(
    rows: int,
    columns: int,
    width: float,
    height: float,
    ratios: Sequence[float] | None = None,
    layout: Literal["constrained", "compressed"] = "constrained",
) -> tuple[Figure, list[Axes]]:
    """A figure of `width` × `height` inches that needs no window, and its axes, row by row.

    The layout is `compressed` for pictures, which keep their proportions: they move together.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
    return figure, list(figure.subplots(rows, columns, squeeze=False, height_ratios=ratios).flat)


def line_style(order: int, count: int) -> dict[str, Any]:
    """Colour and dashes of one of `count` lines; no two are alike, and few lines also differ in dashes."""
    group = len(COLOURS) if count > len(COLOURS) else 2
    return {"color": COLOURS[order % len(COLOURS)], "linestyle": LINES[order // group % len(LINES)]}

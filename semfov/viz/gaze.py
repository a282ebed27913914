"""Figures of where people look."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.paths.gaze import GazePrediction
from semfov.viz.drawing import draw_image
from semfov.viz.style import GAZE, line_style, make_figure, only, overlay_colours, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MASSES = (0.8, 0.5, 0.25)
"""Shares of all fixations that the smallest regions inside the contours hold."""


@styled
def plot_gaze(prediction: GazePrediction, *, ax: Axes | None = None, scanpaths: Sequence[Fixations] = ()) -> Figure:
    """Draw the density of fixations over the grey picture, its peaks in order, and scanpaths."""
    width, height = prediction.size
    figure, (axes,) = make_figure(1, 1, width=6.4, height=6.4 * height / width + 0.35, axes=only(ax))
    draw_image(axes, prediction.image, Grid(1, 1, prediction.size), grey=True)
    cells = prediction.cells.numpy()
    axes.imshow(cells / cells.max(), extent=(0, width, height, 0), cmap=overlay_colours(), interpolation="bilinear")
    for order, each in enumerate(scanpaths):
        points = each.resized(prediction.size).points + 0.5
        axes.plot(*points.T, "-o", color=line_style(order, len(scanpaths))["color"], markersize=3, linewidth=1)
    for number, peak in enumerate(prediction.peaks(), 1):
        place = peak["x"] + 0.5, peak["y"] + 0.5
        axes.annotate(
            str(number), place, color="white", ha="center", va="center",
            bbox={"boxstyle": "circle", "facecolor": GAZE, "edgecolor": "white"},
        )  # fmt: skip
    axes.set(title=prediction.describe(), xlim=(0, width), ylim=(height, 0))
    return figure

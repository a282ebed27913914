"""Figures of where people look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.errors import check
from semfov.paths.gaze import GazePrediction
from semfov.viz.animation import Film, render
from semfov.viz.drawing import draw_image
from semfov.viz.style import GAZE, line_style, make_figure, only, overlay_colours, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def plot_gaze(
    prediction: GazePrediction,
    *,
    ax: Axes | None = None,
    scanpaths: Sequence[Fixations] = (),
    cells: Tensor | None = None,
) -> Figure:
    """Draw a density of fixations over the grey picture, and scanpaths.

    Args:
        prediction: the prediction.
        ax: axes to draw in; None makes a figure.
        scanpaths: scanpaths to draw over it.
        cells: `(rows, columns)`, the density; None takes that of all fixations, with its peaks in order.

    Returns:
        The figure.
    """
    width, height = prediction.size
    figure, (axes,) = make_figure(1, 1, width=6.4, height=6.4 * height / width + 0.35, axes=only(ax))
    draw_image(axes, prediction.image, Grid(1, 1, prediction.size), grey=True)
    density = (prediction.cells if cells is None else cells).numpy()
    axes.imshow(density / density.max(), extent=(0, width, height, 0), cmap=overlay_colours(), interpolation="bilinear")
    for order, scanpath in enumerate(scanpaths):
        points = scanpath.resized(prediction.size).points + 0.5
        axes.plot(*points.T, "-o", color=line_style(order, len(scanpaths))["color"], markersize=3, linewidth=1)
    peaks = prediction.peaks() if cells is None else []
    for number, peak in enumerate(peaks, 1):
        axes.annotate(
            str(number),
            (peak["x"] + 0.5, peak["y"] + 0.5),
            color="white",
            ha="center",
            va="center",
            bbox={"boxstyle": "circle", "facecolor": GAZE, "edgecolor": "white"},
        )
    # Without the words, the numbers look like the order of a viewer's fixations.
    numbers = f"; 1 to {len(peaks)}: places with most fixations first" if peaks else ""
    axes.set(title=fill(prediction.describe() + numbers, 80), xlim=(0, width), ylim=(height, 0))
    return figure


def animate_gaze(
    prediction: GazePrediction,
    path: str | PathLike[str] | None = None,
    *,
    people: int = 15,
    duration: float = 3.0,
    seconds: float = 0.8,
    hold: float = 2.0,
    seed: int = 0,
) -> Path | Film:
    """Make a film of drawn viewers: a frame after each fixation, with the mean density of their next ones.

    Args:
        prediction: the prediction.
        path: GIF file to write; None returns the film instead.
        people: number of viewers.
        duration: seconds for which each views the picture.
        seconds: duration of a frame.
        hold: additional seconds of the last frame.
        seed: seed of the viewers.

    Returns:
        The path of the GIF, or the film.
    """
    check(seconds > 0 and hold >= 0, "seconds, hold", "a positive time, and 0 seconds or more", (seconds, hold))
    viewers = prediction.scanpaths(people, seconds=duration, seed=seed)

    def frame(number: int) -> Figure:
        """Draw the first fixations of all viewers, and the density of the next ones."""
        if number == 0:
            figure = plot_gaze(prediction, cells=prediction.cells)
        else:
            begun = [replace(viewer, points=viewer.points[:number], durations=None) for viewer in viewers]
            figure = plot_gaze(prediction, scanpaths=begun, cells=prediction.given(viewers, number))
        figure.axes[0].set_title(f"after {number} fixation{'' if number == 1 else 's'} of {people} viewers")
        return figure

    frames = render(frame(number) for number in range(max(map(len, viewers)) + 1))
    film = Film(frames, seconds, hold, prediction.describe())
    return film if path is None else film.save(path)[0]

"""Figures of where people look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.classes import amount
from semfov.data.fixations import Fixations
from semfov.errors import check, checked_keywords
from semfov.paths.areas import AreasLike, percent, shares_around
from semfov.paths.gaze import GazePrediction
from semfov.viz.animation import Film, render
from semfov.viz.drawing import draw_image
from semfov.viz.style import GAZE, LARGEST_SHARE, TARGET, line_style, make_figure, only, share_colours, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BORDERS = "half of all fixations are inside the thick line, 90\N{NO-BREAK SPACE}% inside the thin one"
"""What the lines of a map are."""

_FIRST = 3  # first fixations that are drawn
_BANDS = tuple(share / 10 for share in range(1, 10))  # shares of the fixations in the areas between two colours
_BORDERS = {0.5: 1.8, LARGEST_SHARE: 0.8}  # widths of the lines around the areas with these shares
_LABELS = 20  # names of areas that find room below each other in a picture
_FINER = 8  # points of a band for a cell along each side


@checked_keywords
@styled
def plot_gaze(
    prediction: GazePrediction,
    *,
    ax: Axes | None = None,
    scanpaths: Sequence[Fixations] = (),
    cells: Tensor | None = None,
    areas: AreasLike | None = None,
    title: bool = True,
) -> Figure:
    """Draw the smallest areas with 10 to 90 % of the fixations over the picture, and the first three fixations.

    Args:
        prediction: the prediction.
        ax: axes to draw in; None makes a figure.
        scanpaths: scanpaths to draw over it.
        cells: `(rows, columns)`, the density; None takes that of all fixations, with the first three fixations.
        areas: areas of interest to draw with their shares, as for `GazePrediction.share`.
        title: whether lines above the picture say what is drawn.

    Returns:
        The figure.
    """
    width, height = prediction.size
    inches = 5.4 * height / width + 0.6
    figure, (axes,) = make_figure(1, 1, width=6.4, height=inches, layout="compressed", axes=only(ax))
    draw_gaze(axes, prediction, prediction.cells if cells is None else cells)
    for order, scanpath in enumerate(scanpaths):
        points = scanpath.resized(prediction.size).points + 0.5
        axes.plot(*points.T, "-o", color=line_style(order, len(scanpaths))["color"], markersize=3, linewidth=1)
    if areas is not None:
        draw_areas(axes, prediction, areas)
    if cells is None:
        draw_first_fixations(axes, prediction)
    if title:
        axes.set_title(_title_of(prediction, has_numbers=cells is None), parse_math=False)
    return figure


def _title_of(prediction: GazePrediction, *, has_numbers: bool) -> str:
    """Say in lines what is drawn, also by numbers, and what speaks against the prediction."""
    sentences = [f"Where people look in {prediction.name}: {BORDERS}"]
    if has_numbers:
        sentences.append(f"1 to {_FIRST}: the first fixations, in order")
    if prediction.caution is not None:
        sentences.append(f"Caution: {prediction.caution}")
    return "\n".join(fill(sentence, 84) for sentence in sentences)


def draw_gaze(axes: Axes, prediction: GazePrediction, cells: Tensor) -> None:
    """Draw the smallest areas with 10 to 90 % of the fixations over the picture.

    Args:
        axes: axes to draw in.
        prediction: gives the picture.
        cells: `(rows, columns)`, the density.
    """
    from matplotlib.patheffects import withStroke

    width, height = prediction.size
    draw_image(axes, prediction.image, Grid(1, 1, prediction.size))
    # Between cells the logarithm is interpolated, as for the density over the pixels.
    log_density = cells.double().log()
    finer = F.interpolate(log_density[None, None], scale_factor=_FINER, mode="bilinear")[0, 0].exp()
    shares = shares_around(finer / finer.sum()).numpy()  # (rows, columns) of the finer cells
    rows, columns = shares.shape
    x = (np.arange(columns) + 0.5) * width / columns
    y = (np.arange(rows) + 0.5) * height / rows
    axes.contourf(x, y, shares, levels=[0, *_BANDS], cmap=share_colours(), vmin=0, vmax=1)
    widths = [*_BORDERS.values()]
    lines = axes.contour(x, y, shares, levels=[*_BORDERS], colors="white", linewidths=widths)
    lines.set(path_effects=[withStroke(linewidth=2.8, foreground="black", alpha=0.5)])
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")


def draw_first_fixations(axes: Axes, prediction: GazePrediction) -> None:
    """Draw the first three fixations as numbers in circles, with a line from one to the next."""
    first = prediction.first_fixations(_FIRST)
    # From pixel centres at integers to a picture whose corner is at 0.
    x = [place["x"] + 0.5 for place in first]
    y = [place["y"] + 0.5 for place in first]
    # A light line below the coloured one shows it on any picture.
    axes.plot(x, y, color="white", linewidth=2.4)
    axes.plot(x, y, color=GAZE, linewidth=1.2)
    for number, place in enumerate(first, 1):
        axes.annotate(
            str(number),
            (place["x"] + 0.5, place["y"] + 0.5),
            color="white",
            ha="center",
            va="center",
            bbox={"boxstyle": "circle", "facecolor": GAZE, "edgecolor": "white"},
            zorder=5,  # above the names of areas
        )


def draw_areas(axes: Axes, prediction: GazePrediction, areas: AreasLike) -> None:
    """Draw areas of interest with their names and shares of the fixations."""
    from matplotlib.patches import Rectangle

    shares = prediction.share(areas)
    for name, (left, top, right, bottom) in prediction.areas(areas).items():
        width = right - left
        height = bottom - top
        axes.add_patch(Rectangle((left, top), width, height, fill=False, edgecolor="white", linewidth=2.6))
        axes.add_patch(Rectangle((left, top), width, height, fill=False, edgecolor=TARGET, linewidth=1.4))
        # Above the box, where it hides nothing of it, unless there is no room.
        is_above = top > prediction.size[1] / _LABELS
        axes.text(
            left,
            top,
            f"{name} {percent(shares[name])}",
            color="white",
            fontsize=8,
            va="bottom" if is_above else "top",
            parse_math=False,
            bbox={"facecolor": TARGET, "edgecolor": "none", "pad": 1.5},
            zorder=4,
        )


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
        figure.axes[0].set_title(f"after {amount(number, 'fixation')} of {people} viewers")
        return figure

    frames = render(frame(number) for number in range(max(map(len, viewers)) + 1))
    return Film(frames, seconds, hold, prediction.describe()).saved(path)

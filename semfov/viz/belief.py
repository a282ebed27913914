"""The probability of one class in every cell: over the photograph, and as bars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import InputError, check
from semfov.paths import Scanpath
from semfov.viz.drawing import (
    check_fixation,
    check_foveal,
    choose_fixations,
    draw_cells,
    draw_cross,
    draw_grey,
    draw_scale,
    make_panels,
)
from semfov.viz.style import PROBABILITY, root, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from mpl_toolkits.mplot3d import Axes3D


def class_posterior(scanpath: Scanpath, target: int | None = None) -> tuple[Tensor, str]:
    """Select the probability of a class in every cell after each look.

    Args:
        scanpath: the episode.
        target: index of the class; None takes the class that was searched for, by the belief of the search.

    Returns:
        `(n, X·Y)`, and the name of the class.

    Raises:
        InputError: there is no such class.
    """
    index = scanpath.target if target is None else target
    if index is None:
        raise InputError("target: expected a class index, as nothing was searched for, got None")
    last = len(scanpath.classes) - 1
    check(0 <= index <= last, "target", f"a class index from 0 to {last}", index)
    posterior = scanpath.posterior if index == scanpath.target else None
    if posterior is None:
        posterior = scanpath.probabilities[..., index]
    return posterior.detach().cpu(), scanpath.classes[index]


@styled
def plot_belief(
    scanpath: Scanpath,
    fixation: int | None = -1,
    *,
    target: int | None = None,
    image: Tensor | None = None,
    most: int = 10,
    columns: int = 5,
    axes: Sequence[Axes] | None = None,
) -> Figure:
    """Plot the probability of a class in every cell after a fixation or several, over the photograph in grey.

    The colour scale goes from 0, where the photograph is visible unchanged, to 1. All such figures can be compared.

    Args:
        scanpath: the episode.
        fixation: number of the fixation; -1 is the last. None shows several: the first ones and the last.
        target: index of the class; None takes the class that was searched for.
        image: `(3, H, W)`, RGB in [0, 1]; None takes the scanpath's own, where it has one.
        most: largest number of fixations to show.
        columns: number of pictures in a row.
        axes: axes to draw in, one for each fixation that is shown; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: it is no record of a fovea, there is no such fixation or class, or an argument is out of range.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup", how="fovea")
        save_figure(plot_belief(scanpath), "belief.pdf")
        save_figure(plot_belief(scanpath, None, most=4, columns=2), "beliefs.pdf")
    """
    check_foveal(scanpath)
    if fixation is None:
        fixations = choose_fixations(scanpath, most)
    else:
        fixations = [check_fixation(len(scanpath.fixated), fixation)]

    def size(rows: int, columns: int) -> tuple[float, float]:
        return _inches_of_panels(scanpath, rows, columns) if fixation is None else (5.6, 4.6)

    photograph = scanpath.image if image is None else image
    panels = make_panels(len(fixations), columns, size, axes)
    for panel, number in zip(panels, fixations, strict=True):
        drawn = draw_belief(panel, scanpath, number, target, photograph)
        if fixation is None:
            panel.set_title(f"fixation {number + 1}: {panel.get_title()}", parse_math=False)
    _, name = class_posterior(scanpath, target)
    draw_scale(panels, drawn, f"probability of {name}")
    return root(panels[0])


def _inches_of_panels(scanpath: Scanpath, rows: int, columns: int) -> tuple[float, float]:
    """Compute width and height of a figure with several pictures, of which each has a title, beside a scale."""
    width, height = scanpath.grid.extent.tolist()
    return max(2.6 * columns, 3.2) + 0.6, max(rows * (2.6 * height / width + 0.3), 2.2)


@styled
def plot_belief_bars(
    scanpath: Scanpath, *, target: int | None = None, most: int = 4, axes: Sequence[Axes] | None = None
) -> Figure:
    """Plot the probability of a class as bars over the grid, after several fixations, with a common scale.

    The grid is seen from below the picture: its near edge is the bottom row.

    Args:
        scanpath: the episode.
        target: index of the class; None takes the class that was searched for.
        most: largest number of fixations to show: the first ones and the last.
        axes: axes with `projection="3d"`, one for each fixation that is shown; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: it is no record of a fovea, there is no such class, or the axes are too few, too many, or not in 3D.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup", how="fovea")
        save_figure(plot_belief_bars(scanpath), "bars.pdf")
    """
    check_foveal(scanpath)
    chances, name = class_posterior(scanpath, target)
    fixations = choose_fixations(scanpath, most)
    highest = max(float(chances.max()), 1e-9)
    panels = _solid_axes(axes, len(fixations))
    for panel, fixation in zip(panels, fixations, strict=True):
        bars = chances[fixation].numpy()
        _draw_bars(panel, scanpath.grid, bars, highest)
        panel.set_title(f"fixation {fixation + 1}: p({name}) up to {float(bars.max()):.2f}", parse_math=False)
    return root(panels[0])


def _solid_axes(axes: Sequence[Axes] | None, count: int) -> list[Axes3D]:
    """Check the given axes in 3D, of which there are `count`, or make a figure with them in a row."""
    from matplotlib.figure import Figure

    if axes is None:
        figure = Figure(figsize=(3.3 * count + 0.4, 3.0), layout="constrained")
        return [figure.add_subplot(1, count, number + 1, projection="3d") for number in range(count)]
    check(len(axes) == count, "axes", f"{count} axes, one for each fixation", len(axes))
    are_solid = all(hasattr(panel, "bar3d") for panel in axes)
    check(are_solid, "axes", 'axes with projection="3d"', "axes without it")
    return list(axes)


def _draw_bars(panel: Axes3D, grid: Grid, bars: NDArray[np.float32], highest: float) -> None:
    """Draw a bar for each cell.

    Args:
        panel: axes in 3D.
        grid: the cells.
        bars: `(X·Y,)`, heights of the bars.
        highest: upper end of the scale.
    """
    from matplotlib import colormaps

    columns = np.arange(grid.columns)
    rows = np.arange(grid.rows)
    column, row = (index.ravel() for index in np.meshgrid(columns, rows))  # (X·Y,) each, in the order of the cells
    # Rows grow downwards in the picture and backwards in the plot.
    depth = grid.rows - 1 - row
    colours = colormaps[PROBABILITY](bars / highest)
    panel.bar3d(column + 0.1, depth + 0.1, 0, 0.8, 0.8, bars, color=colours, shade=True)
    panel.view_init(elev=32, azim=-65)
    panel.set(xlim=(0, grid.columns), ylim=(0, grid.rows), zlim=(0, highest), xlabel="column", ylabel="row")

    # About five numbers on each axis, in the middles of their cells.
    numbered_columns = columns[:: max(1, grid.columns // 5)]
    numbered_rows = rows[:: max(1, grid.rows // 5)]
    panel.set_xticks(numbered_columns + 0.5, [str(n) for n in numbered_columns])
    panel.set_yticks(grid.rows - 0.5 - numbered_rows, [str(n) for n in numbered_rows])
    panel.tick_params(labelsize=7, pad=-1)
    panel.xaxis.labelpad = panel.yaxis.labelpad = -5
    panel.set_box_aspect((4, 4, 2.6), zoom=1.05)


def draw_belief(axes: Axes, scanpath: Scanpath, fixation: int, target: int | None, image: Tensor | None) -> AxesImage:
    """Draw the probability of a class in every cell, from 0 to 1, over a photograph."""
    posterior, name = class_posterior(scanpath, target)
    chances = posterior[fixation]
    draw_grey(axes, image, scanpath.grid)
    drawn = draw_cells(axes, scanpath.grid, chances)
    draw_cross(axes, scanpath.fixations[fixation])
    axes.set_title(f"p({name}) up to {float(chances.max()):.2f}", parse_math=False)
    return drawn

"""What is believed of a class: overlays on the photograph, bars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from semfov.errors import InputError, check
from semfov.scanpath import Scanpath
from semfov.viz.drawing import check_fixation, choose_fixations, draw_gaze, draw_image, draw_overlay, draw_scale
from semfov.viz.style import PROBABILITY, make_figure, only, root, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


def class_posterior(scanpath: Scanpath, target: int | None = None) -> Tensor:
    """Probability of a class in every cell after each look, `(n, X·Y)`.

    Args:
        scanpath: the episode.
        target: index of the class; None is the one that was searched for, as the search believed it.

    Raises:
        InputError: no class is given and nothing was searched for, or there is no such class.
    """
    index = scanpath.target if target is None else target
    if index is None:
        raise InputError("target: expected a class index, since the scanpath has none, got None")
    last = len(scanpath.classes) - 1
    check(0 <= index <= last, "target", f"a class index from 0 to {last}", index)
    if scanpath.posterior is not None and index == scanpath.target:
        return scanpath.posterior.detach().cpu()
    return scanpath.probabilities[..., index].detach().cpu()


@styled
def plot_belief(
    scanpath: Scanpath,
    fixation: int = -1,
    *,
    target: int | None = None,
    image: Tensor | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Probability of a class in every cell after a fixation, laid over the photograph in grey.

    The scale goes from 0, where the photograph is as it is, to 1, so that all such pictures compare.

    Args:
        scanpath: the episode.
        fixation: its number; -1 is the last.
        target: index of the class; None is the one that was searched for.
        image: `(3, H, W)`, RGB in [0, 1]; None is the scanpath's own, where it has one.
        ax: axes to draw in; None makes a figure.
    """
    figure, (axes,) = make_figure(1, 1, width=5.6, height=4.6, layout="compressed", given=only(ax))
    drawn = draw_belief(axes, scanpath, check_fixation(scanpath, fixation), target, _grey(scanpath, image))
    draw_scale(axes, drawn, f"probability of {_name(scanpath, target)}")
    return figure


@styled
def plot_belief_strip(
    scanpath: Scanpath,
    *,
    target: int | None = None,
    image: Tensor | None = None,
    most: int = 10,
    columns: int = 5,
    axes: Sequence[Axes] | None = None,
) -> Figure:
    """`plot_belief` for every fixation, with one scale; at most so many: the first ones and the last.

    Args:
        scanpath: the episode.
        target: index of the class; None is the one that was searched for.
        image: as for `plot_belief`.
        most: at most so many fixations are shown.
        columns: pictures side by side.
        axes: to draw in, as many as there are fixations to show; None makes a figure.
    """
    check(columns >= 1, "columns", "at least 1", columns)
    shown, grey = choose_fixations(scanpath, most), _grey(scanpath, image)
    columns = len(shown) if axes is not None else min(columns, len(shown))
    rows = -(-len(shown) // columns)
    width, height = scanpath.grid.extent.tolist()
    size = max(2.6 * columns, 3.2) + 0.6, rows * (2.6 * height / width + 0.3)
    figure, panels = make_figure(rows, columns, width=size[0], height=size[1], layout="compressed", given=axes)
    used = panels[: len(shown)]
    for panel, fixation in zip(used, shown, strict=True):
        drawn = draw_belief(panel, scanpath, fixation, target, grey)
        panel.set_title(f"fixation {fixation}: {panel.get_title()}", parse_math=False)
    draw_scale(used, drawn, f"probability of {_name(scanpath, target)}")
    for panel in panels[len(shown) :]:
        panel.remove()
    return figure


@styled
def plot_belief_bars(
    scanpath: Scanpath, *, target: int | None = None, most: int = 4, axes: Sequence[Axes] | None = None
) -> Figure:
    """Probability of a class in every cell as bars over the grid, after at most so many fixations, on one scale.

    The grid is seen from below the picture: the near edge is its bottom row.

    Args:
        scanpath: the episode.
        target: index of the class; None is the one that was searched for.
        most: at most so many fixations are shown: the first ones and the last.
        axes: with `projection="3d"`, as many as there are fixations to show; None makes a figure.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    posterior, name = class_posterior(scanpath, target).numpy(), _name(scanpath, target)
    shown, grid = choose_fixations(scanpath, most), scanpath.grid
    highest = max(float(posterior.max()), 1e-9)
    if axes is None:
        figure = Figure(figsize=(3.3 * len(shown) + 0.4, 3.0), layout="constrained")
        panels: list[Any] = [figure.add_subplot(1, len(shown), n + 1, projection="3d") for n in range(len(shown))]
    else:
        check(len(axes) == len(shown), "axes", f"{len(shown)} of them", len(axes))
        check(all(hasattr(each, "bar3d") for each in axes), "axes", 'those with projection="3d"', "others")
        figure, panels = root(axes[0]), list(axes)
    column, row = (index.ravel() for index in np.meshgrid(np.arange(grid.columns), np.arange(grid.rows)))
    for panel, fixation in zip(panels, shown, strict=True):
        bars = posterior[fixation]
        # Rows grow downwards in the picture and backwards in the plot.
        depth = grid.rows - 1 - row
        colours = colormaps[PROBABILITY](bars / highest)
        panel.bar3d(column + 0.1, depth + 0.1, 0, 0.8, 0.8, bars, color=colours, shade=True)
        panel.view_init(elev=32, azim=-65)
        panel.set(xlim=(0, grid.columns), ylim=(0, grid.rows), zlim=(0, highest), xlabel="column", ylabel="row")
        step = max(1, grid.columns // 5), max(1, grid.rows // 5)
        columns, rows = range(0, grid.columns, step[0]), range(0, grid.rows, step[1])
        panel.set_xticks([n + 0.5 for n in columns], [str(n) for n in columns])
        panel.set_yticks([grid.rows - 0.5 - n for n in rows], [str(n) for n in rows])
        panel.tick_params(labelsize=7, pad=-1)
        panel.xaxis.labelpad = panel.yaxis.labelpad = -5
        panel.set_box_aspect((4, 4, 2.6), zoom=1.05)
        panel.set_title(f"fixation {fixation}: p({name}) up to {float(bars.max()):.2f}", parse_math=False)
    return figure


def draw_belief(axes: Axes, scanpath: Scanpath, fixation: int, target: int | None, image: Tensor | None) -> AxesImage:
    """Probability of a class in every cell over a photograph, from 0 to 1."""
    posterior = class_posterior(scanpath, target)[fixation]
    if image is not None:
        draw_image(axes, image, scanpath.grid, grey=True)
    drawn = draw_overlay(axes, scanpath.grid, posterior)
    draw_gaze(axes, scanpath, fixation)
    axes.set_title(belief_title(scanpath, fixation, target), parse_math=False)
    return drawn


def belief_title(scanpath: Scanpath, fixation: int, target: int | None = None) -> str:
    """The greatest probability of a class after a fixation, in words."""
    highest = float(class_posterior(scanpath, target)[fixation].max())
    return f"p({_name(scanpath, target)}) up to {highest:.2f}"


def _grey(scanpath: Scanpath, image: Tensor | None) -> Tensor | None:
    """The photograph to lay beliefs over, where there is one."""
    return scanpath.image if image is None else image


def _name(scanpath: Scanpath, target: int | None) -> str:
    index = scanpath.target if target is None else target
    return "the target" if index is None else scanpath.classes[index]

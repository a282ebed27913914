"""What is believed to be where: heat maps, bars, the most probable class of every cell."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from semfov.errors import InputError, check
from semfov.scanpath import Scanpath
from semfov.viz.drawing import check_fixation, choose_fixations, draw_cells, draw_gaze, draw_grid, draw_image
from semfov.viz.style import PROBABILITY, UNCERTAINTY, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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


def entropy(scanpath: Scanpath) -> Tensor:
    """Uncertainty about the class of every cell after each look, `-Σ p_k log2 p_k` in bits, `(n, X·Y)`.

    Marginal probabilities, of a learned map, are scaled to sum to 1.
    """
    shares = scanpath.probabilities / scanpath.probabilities.sum(-1, keepdim=True)
    return torch.special.entr(shares).sum(-1).detach().cpu() / math.log(2)


@styled
def plot_belief(
    scanpath: Scanpath, fixation: int = -1, *, target: int | None = None, image: Tensor | None = None
) -> Figure:
    """Probability of a class in every cell after a fixation, over the dimmed photograph where one is given.

    Args:
        scanpath: the episode.
        fixation: its number; -1 is the last.
        target: index of the class; None is the one that was searched for.
        image: `(3, H, W)`, RGB in [0, 1].
    """
    figure, (axes,) = make_figure(1, 1, width=5.6, height=4.6, layout="compressed")
    draw_belief(axes, scanpath, fixation, target, image)
    figure.colorbar(axes.images[-1], ax=axes, label="probability", shrink=0.85)
    return figure


@styled
def plot_belief_strip(
    scanpath: Scanpath, *, target: int | None = None, image: Tensor | None = None, most: int = 10, columns: int = 5
) -> Figure:
    """`plot_belief` for every fixation, on one scale; at most so many: the first ones and the last."""
    check(columns >= 1, "columns", "at least 1", columns)
    shown = choose_fixations(scanpath, most)
    columns = min(columns, len(shown))
    rows = -(-len(shown) // columns)
    width, height = scanpath.grid.extent.tolist()
    size = max(2.6 * columns, 3.2) + 0.6, rows * (2.6 * height / width + 0.3)
    figure, panels = make_figure(rows, columns, width=size[0], height=size[1], layout="compressed")
    for axes, fixation in zip(panels, shown, strict=False):
        draw_belief(axes, scanpath, fixation, target, image)
        axes.set_title(f"fixation {fixation}: {axes.get_title()}")
    used = panels[: len(shown)]
    figure.colorbar(used[0].images[-1], ax=used, label="probability", shrink=0.85)
    for axes in panels[len(shown) :]:
        axes.remove()
    return figure


@styled
def plot_belief_bars(scanpath: Scanpath, *, target: int | None = None, most: int = 4) -> Figure:
    """Probability of a class in every cell as bars over the grid, after at most so many fixations, on one scale.

    The grid is seen from below the picture: the near edge is its bottom row.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    posterior = class_posterior(scanpath, target).numpy()
    name = scanpath.classes[scanpath.target if target is None else target]  # type: ignore[index]
    shown, grid = choose_fixations(scanpath, most), scanpath.grid
    highest = max(float(posterior.max()), 1e-9)
    figure = Figure(figsize=(3.3 * len(shown) + 0.4, 3.0), layout="constrained")
    column, row = (index.ravel() for index in np.meshgrid(np.arange(grid.columns), np.arange(grid.rows)))
    for order, fixation in enumerate(shown):
        axes: Any = figure.add_subplot(1, len(shown), order + 1, projection="3d")
        bars = posterior[fixation]
        # Rows grow downwards in the picture and backwards in the plot.
        depth = grid.rows - 1 - row
        colours = colormaps[PROBABILITY](bars / highest)
        axes.bar3d(column + 0.1, depth + 0.1, 0, 0.8, 0.8, bars, color=colours, shade=True)
        axes.view_init(elev=32, azim=-65)
        axes.set(xlim=(0, grid.columns), ylim=(0, grid.rows), zlim=(0, highest), xlabel="column", ylabel="row")
        step = max(1, grid.columns // 5), max(1, grid.rows // 5)
        columns, rows = range(0, grid.columns, step[0]), range(0, grid.rows, step[1])
        axes.set_xticks([n + 0.5 for n in columns], [str(n) for n in columns])
        axes.set_yticks([grid.rows - 0.5 - n for n in rows], [str(n) for n in rows])
        axes.tick_params(labelsize=7, pad=-1)
        axes.xaxis.labelpad = axes.yaxis.labelpad = -5
        axes.set_box_aspect((4, 4, 2.6), zoom=1.05)
        axes.set_title(f"fixation {fixation}: p({name}) up to {float(bars.max()):.2f}")
    return figure


@styled
def plot_semantic_map(scanpath: Scanpath, fixation: int = -1, *, image: Tensor | None = None) -> Figure:
    """The most probable class of every cell after a fixation, beside how uncertain it is.

    Args:
        scanpath: the episode.
        fixation: its number; -1 is the last.
        image: `(3, H, W)`, RGB in [0, 1].
    """
    fixation = check_fixation(scanpath, fixation)
    grid = scanpath.grid
    width, height = grid.extent.tolist()
    figure, (named, unsure) = make_figure(1, 2, width=12.4, height=5.6 * height / width + 0.5, layout="compressed")
    draw_semantic_map(named, scanpath, fixation, image)
    figure.colorbar(named.images[-1], ax=named, label="probability of the most probable object", shrink=0.85)
    if image is not None:
        draw_image(unsure, image, grid, dim=0.3)
    values = entropy(scanpath)
    style: dict[str, Any] = {"cmap": UNCERTAINTY, "vmin": float(values.min()), "vmax": float(values.max())}
    draw_cells(unsure, grid, values[fixation], alpha=0.65 if image is not None else 1, **style)
    draw_gaze(unsure, scanpath, fixation)
    unsure.set_title(f"uncertainty after fixation {fixation}")
    figure.colorbar(unsure.images[-1], ax=unsure, label="entropy (bits)", shrink=0.85)
    return figure


def draw_semantic_map(axes: Axes, scanpath: Scanpath, fixation: int, image: Tensor | None) -> None:
    """The most probable object of every cell, on one scale for the whole episode, and the names of regions."""
    from matplotlib.patheffects import withStroke

    grid = scanpath.grid
    probabilities = scanpath.probabilities.detach().cpu()
    objects = probabilities[..., 1:].amax(-1)
    highest = max(float(objects.max()), 1e-9)
    if image is not None:
        draw_image(axes, image, grid, dim=0.3)
    alpha = 0.65 if image is not None else 1
    draw_cells(axes, grid, objects[fixation], alpha=alpha, cmap=PROBABILITY, vmin=0, vmax=highest)
    draw_grid(axes, grid)
    for name, region, _ in named_regions(scanpath, fixation):
        centres = grid.centres[region] + 0.5
        x, y = centres[(centres - centres.mean(0)).norm(dim=-1).argmin()].tolist()
        text = axes.text(x, y, name, color="black", fontsize=7, clip_on=True)
        text.set(ha="center", va="center", path_effects=[withStroke(linewidth=2, foreground="white")])
    draw_gaze(axes, scanpath, fixation)
    axes.set_title(f"what is where after fixation {fixation}")


def named_regions(scanpath: Scanpath, fixation: int = -1) -> list[tuple[str, list[int], float]]:
    """What the map names after a fixation: class, cells that touch, and the greatest probability among them.

    A cell is named where an object is more probable than background, and than thrice an even share or a half. The
    regions that cover most are first.

    Args:
        scanpath: the episode.
        fixation: its number; -1 is the last.
    """
    grid, probabilities = scanpath.grid, scanpath.probabilities[fixation].detach().cpu()
    objects, label = probabilities[:, 1:].max(-1)
    known = objects > probabilities[:, 0].clamp(min=min(0.5, 3 / len(scanpath.classes)))
    best = torch.where(known, label + 1, 0)
    found = regions(best.reshape(grid.rows, grid.columns))
    named = [(scanpath.classes[int(best[cells[0]])], cells, float(objects[cells].max())) for cells in found]
    return sorted(named, key=lambda region: -len(region[1]))


def regions(labels: Tensor) -> list[list[int]]:
    """Cells that touch at a side and share a label other than 0, of a table `(Y, X)`.

    >>> regions(torch.tensor([[1, 1, 0], [2, 1, 1]]))
    [[0, 1, 4, 5], [3]]
    """
    rows, columns = labels.shape
    flat, seen, found = labels.flatten().tolist(), set[int](), []
    for first in range(len(flat)):
        if flat[first] == 0 or first in seen:
            continue
        region, todo = [], [first]
        seen.add(first)
        while todo:
            cell = todo.pop()
            region.append(cell)
            row, column = divmod(cell, columns)
            beside = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
            near = {y * columns + x for y, x in beside if 0 <= y < rows and 0 <= x < columns} - seen
            same = {other for other in near if flat[other] == flat[first]}
            seen |= same
            todo += same
        found.append(sorted(region))
    return found


def draw_belief(axes: Axes, scanpath: Scanpath, fixation: int, target: int | None, image: Tensor | None) -> None:
    """Probability of a class in every cell, on one scale for the whole episode, so that its pictures compare."""
    fixation = check_fixation(scanpath, fixation)
    posteriors, grid = class_posterior(scanpath, target), scanpath.grid
    if image is not None:
        draw_image(axes, image, grid, dim=0.3)
    style: dict[str, Any] = {"cmap": PROBABILITY, "vmin": 0, "vmax": max(float(posteriors.max()), 1e-9)}
    draw_cells(axes, grid, posteriors[fixation], alpha=0.65 if image is not None else 1, **style)
    draw_gaze(axes, scanpath, fixation)
    name = scanpath.classes[scanpath.target if target is None else target]  # type: ignore[index]
    axes.set_title(f"p({name}) up to {float(posteriors[fixation].max()):.2f}")

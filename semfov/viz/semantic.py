"""Semantic maps: the most probable class of every cell, the names of regions, and how uncertain they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.paths import Scanpath
from semfov.viz.drawing import (
    check_fixation,
    check_foveal,
    draw_cells,
    draw_cross,
    draw_grid,
    draw_image,
    draw_scale,
    text_size,
)
from semfov.viz.labels import place_within
from semfov.viz.style import UNCERTAINTY, lay_out, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_NAME_POINTS = 7


def cell_entropy(scanpath: Scanpath) -> Tensor:
    """Entropy in bits of the class of every cell after each look, `(n, X·Y)`; marginals are scaled to sum to 1."""
    shares = scanpath.probabilities / scanpath.probabilities.sum(-1, keepdim=True)
    return torch.special.entr(shares).sum(-1).detach().cpu() / math.log(2)


@styled
def plot_semantic_map(
    scanpath: Scanpath, fixation: int = -1, *, image: Tensor | None = None, axes: Sequence[Axes] | None = None
) -> Figure:
    """Plot the most probable object of every cell after a fixation, with its name, beside the entropy of the cell.

    Args:
        scanpath: the episode.
        fixation: number of the fixation; -1 is the last.
        image: `(3, H, W)`, RGB in [0, 1]; None takes the scanpath's own, where it has one.
        axes: two axes to draw in; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: it is no record of a fovea, or there is no such fixation.

    Example::

        scanpath = agent.explore(read_image("kitchen.jpg"), how="fovea")
        save_figure(plot_semantic_map(scanpath), "map.pdf")
    """
    check_foveal(scanpath)
    fixation, grid = check_fixation(scanpath, fixation), scanpath.grid
    image = scanpath.image if image is None else image
    width, height = grid.extent.tolist()
    size = 12.4, 5.6 * height / width + 0.5
    figure, (named, unsure) = make_figure(1, 2, width=size[0], height=size[1], layout="compressed", axes=axes)
    drawn = draw_semantic_map(named, scanpath, fixation, image)
    draw_scale(named, drawn, "probability of the most probable object")
    if image is not None:
        draw_image(unsure, image, grid, grey=True)
    values = cell_entropy(scanpath)
    style: dict[str, Any] = {"cmap": UNCERTAINTY, "vmin": float(values.min()), "vmax": float(values.max())}
    bits = draw_cells(unsure, grid, values[fixation], alpha=0.65 if image is not None else None, **style)
    draw_cross(unsure, scanpath.fixations[fixation])
    unsure.set_title(f"uncertainty after fixation {fixation}")
    draw_scale(unsure, bits, "entropy (bits)")
    lay_out(figure)
    write_names(named, scanpath, fixation)
    return figure


def draw_semantic_map(axes: Axes, scanpath: Scanpath, fixation: int, image: Tensor | None) -> AxesImage:
    """Draw the probability of the most probable object of every cell, from 0 to 1, over a photograph."""
    if image is not None:
        draw_image(axes, image, scanpath.grid, grey=True)
    drawn = draw_cells(axes, scanpath.grid, scanpath.probabilities[fixation, :, 1:].amax(-1))
    draw_grid(axes, scanpath.grid)
    draw_cross(axes, scanpath.fixations[fixation])
    axes.set_title(f"semantic map after fixation {fixation}")
    return drawn


def write_names(axes: Axes, scanpath: Scanpath, fixation: int) -> list[Artist]:
    """Draw borders and names of regions, each name on a cell where it covers no other; the figure must be laid out."""
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    grid = scanpath.grid
    named = named_regions(scanpath, fixation)
    candidates, sizes = [], []
    for name, region, _ in named:
        centres = grid.centres[region] + 0.5
        order = (centres - centres.mean(0)).norm(dim=-1).argsort(stable=True)
        wide, high = text_size(axes, name, _NAME_POINTS)
        candidates.append([(x - wide / 2, y - high / 2) for x, y in centres[order].tolist()])
        sizes.append((wide, high))
    width, height = grid.extent.tolist()
    lines = LineCollection([side for _, region, _ in named for side in _borders(grid, region)], colors="white")
    lines.set(linewidths=1.3, zorder=3)
    written: list[Artist] = [axes.add_collection(lines, autolim=False)]
    for (name, _, _), (x1, y1, x2, y2) in zip(named, place_within(candidates, sizes, (width, height)), strict=True):
        text = axes.text((x1 + x2) / 2, (y1 + y2) / 2, name, color="black", fontsize=_NAME_POINTS, clip_on=True)
        text.set(ha="center", va="center", parse_math=False)
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
        written.append(text)
    return written


def _borders(grid: Grid, region: Sequence[int]) -> list[list[tuple[float, float]]]:
    """Sides of cells that bound a region."""
    cells, edges = set(region), grid.edges.tolist()
    lines = []
    for cell in region:
        column, (x1, y1, x2, y2) = cell % grid.columns, edges[cell]
        sides = (
            (cell - 1 if column else None, [(x1, y1), (x1, y2)]),
            (cell + 1 if column + 1 < grid.columns else None, [(x2, y1), (x2, y2)]),
            (cell - grid.columns, [(x1, y1), (x2, y1)]),
            (cell + grid.columns, [(x1, y2), (x2, y2)]),
        )
        lines += [line for beside, line in sides if beside not in cells]
    return lines


def named_regions(scanpath: Scanpath, fixation: int = -1) -> list[tuple[str, list[int], float]]:
    """Regions of adjacent cells with one class that beats background and 3 / K, or 0.5: name, cells, probability."""
    grid, probabilities = scanpath.grid, scanpath.probabilities[fixation].detach().cpu()
    objects, label = probabilities[:, 1:].max(-1)
    sure = objects > probabilities[:, 0].clamp(min=min(0.5, 3 / len(scanpath.classes)))
    best = torch.where(sure, label + 1, 0)
    groups = _regions(best.reshape(grid.rows, grid.columns))
    named = [(scanpath.classes[int(best[cells[0]])], cells, float(objects[cells].max())) for cells in groups]
    return sorted(named, key=lambda region: -len(region[1]))


def _regions(labels: Tensor) -> list[list[int]]:
    """Regions of cells that touch at a side and share a label other than 0; labels `(Y, X)`."""
    rows, columns = labels.shape
    flat, seen, groups = labels.flatten().tolist(), set[int](), []
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
        groups.append(sorted(region))
    return groups

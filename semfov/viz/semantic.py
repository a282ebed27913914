"""What is where: the most probable class of every cell, the names of regions, and how uncertain they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.scanpath import Scanpath
from semfov.viz.drawing import (
    check_fixation,
    draw_cells,
    draw_gaze,
    draw_grid,
    draw_image,
    draw_overlay,
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


def entropy(scanpath: Scanpath) -> Tensor:
    """Uncertainty about the class of every cell after each look, `-Σ p_k log2 p_k` in bits, `(n, X·Y)`.

    Marginal probabilities, of a learned map, are scaled to sum to 1.
    """
    shares = scanpath.probabilities / scanpath.probabilities.sum(-1, keepdim=True)
    return torch.special.entr(shares).sum(-1).detach().cpu() / math.log(2)


@styled
def plot_semantic_map(
    scanpath: Scanpath, fixation: int = -1, *, image: Tensor | None = None, axes: Sequence[Axes] | None = None
) -> Figure:
    """The most probable object of every cell after a fixation, with its name, beside how uncertain the cell is.

    Args:
        scanpath: the episode.
        fixation: its number; -1 is the last.
        image: `(3, H, W)`, RGB in [0, 1]; None is the scanpath's own, where it has one.
        axes: two of them to draw in; None makes a figure.
    """
    fixation, grid = check_fixation(scanpath, fixation), scanpath.grid
    image = scanpath.image if image is None else image
    width, height = grid.extent.tolist()
    size = 12.4, 5.6 * height / width + 0.5
    figure, (named, unsure) = make_figure(1, 2, width=size[0], height=size[1], layout="compressed", given=axes)
    drawn = draw_semantic_map(named, scanpath, fixation, image)
    draw_scale(named, drawn, "probability of the most probable object")
    if image is not None:
        draw_image(unsure, image, grid, grey=True)
    values = entropy(scanpath)
    style: dict[str, Any] = {"cmap": UNCERTAINTY, "vmin": float(values.min()), "vmax": float(values.max())}
    bits = draw_cells(unsure, grid, values[fixation], alpha=0.65 if image is not None else None, **style)
    draw_gaze(unsure, scanpath, fixation)
    unsure.set_title(f"uncertainty after fixation {fixation}")
    draw_scale(unsure, bits, "entropy (bits)")
    lay_out(figure)
    write_names(named, scanpath, fixation)
    return figure


def draw_semantic_map(axes: Axes, scanpath: Scanpath, fixation: int, image: Tensor | None) -> AxesImage:
    """Probability of the most probable object of every cell over a photograph, from 0 to 1."""
    if image is not None:
        draw_image(axes, image, scanpath.grid, grey=True)
    drawn = draw_overlay(axes, scanpath.grid, most_probable(scanpath, fixation))
    draw_grid(axes, scanpath.grid)
    draw_gaze(axes, scanpath, fixation)
    axes.set_title(f"what is where after fixation {fixation}")
    return drawn


def most_probable(scanpath: Scanpath, fixation: int) -> Tensor:
    """Probability of the most probable object of every cell, `(X·Y,)`."""
    return scanpath.probabilities[fixation, :, 1:].detach().cpu().amax(-1)


def write_names(axes: Axes, scanpath: Scanpath, fixation: int) -> list[Artist]:
    """Borders of regions, and names, each on a cell where it covers no other; the figure is laid out."""
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    grid = scanpath.grid
    named = named_regions(scanpath, fixation)
    candidates, sizes = [], []
    for name, region, _ in named:
        centres = grid.centres[region] + 0.5
        order = (centres - centres.mean(0)).norm(dim=-1).argsort(stable=True)
        candidates.append([(x, y) for x, y in centres[order].tolist()])
        sizes.append(text_size(axes, name, _NAME_POINTS))
    width, height = grid.extent.tolist()
    lines = LineCollection([side for _, region, _ in named for side in borders(grid, region)], colors="white")
    lines.set(linewidths=1.3, zorder=3)
    written: list[Artist] = [axes.add_collection(lines, autolim=False)]
    for (name, _, _), (x1, y1, x2, y2) in zip(named, place_within(candidates, sizes, (width, height)), strict=True):
        text = axes.text((x1 + x2) / 2, (y1 + y2) / 2, name, color="black", fontsize=_NAME_POINTS, clip_on=True)
        text.set(ha="center", va="center", parse_math=False)
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
        written.append(text)
    return written


def borders(grid: Grid, region: Sequence[int]) -> list[list[tuple[float, float]]]:
    """The sides of cells of a region beyond which it ends.

    >>> len(borders(Grid(3, 2, (30, 20)), [0, 1]))
    6
    """
    cells, edges = set(region), grid.edges.tolist()
    found = []
    for cell in region:
        column, (x1, y1, x2, y2) = cell % grid.columns, edges[cell]
        sides = (
            (cell - 1 if column else None, [(x1, y1), (x1, y2)]),
            (cell + 1 if column + 1 < grid.columns else None, [(x2, y1), (x2, y2)]),
            (cell - grid.columns, [(x1, y1), (x2, y1)]),
            (cell + grid.columns, [(x1, y2), (x2, y2)]),
        )
        found += [line for beside, line in sides if beside not in cells]
    return found


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

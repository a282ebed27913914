"""Semantic maps: the most probable class of every cell, the names of regions, and how uncertain they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.paths import Scanpath
from semfov.paths.regions import Region, named_regions
from semfov.viz.drawing import (
    check_fixation,
    check_foveal,
    draw_cells,
    draw_cross,
    draw_grey,
    draw_grid,
    draw_scale,
    text_size,
)
from semfov.viz.labels import LabelBox, place_within
from semfov.viz.style import UNCERTAINTY, lay_out, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_NAME_POINTS = 7


def cell_entropy(scanpath: Scanpath) -> Tensor:
    """Compute the entropy in bits of the class of every cell after each look, `(n, X·Y)`."""
    shares = scanpath.probabilities / scanpath.probabilities.sum(-1, keepdim=True)  # (n, X·Y, K+1)
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
    number = check_fixation(len(scanpath.fixated), fixation)
    image = scanpath.image if image is None else image
    width, height = scanpath.grid.extent.tolist()
    figure, (map_axes, entropy_axes) = make_figure(
        1, 2, width=12.4, height=5.6 * height / width + 0.5, layout="compressed", axes=axes
    )
    drawn = draw_semantic_map(map_axes, scanpath, number, image)
    draw_scale(map_axes, drawn, "probability of the most probable object")
    drawn = _draw_entropy(entropy_axes, scanpath, number, image)
    draw_scale(entropy_axes, drawn, "entropy (bits)")
    lay_out(figure)
    write_names(map_axes, scanpath.grid, regions_after(scanpath, number))
    return figure


def regions_after(scanpath: Scanpath, fixation: int) -> list[Region]:
    """Find the named regions of the map after a fixation."""
    return named_regions(scanpath.grid, scanpath.probabilities[fixation], scanpath.classes)


def _draw_entropy(axes: Axes, scanpath: Scanpath, fixation: int, image: Tensor | None) -> AxesImage:
    """Draw the entropy of every cell over a photograph, on a scale for all fixations."""
    draw_grey(axes, image, scanpath.grid)
    values = cell_entropy(scanpath)
    alpha = None if image is None else 0.65
    lowest = float(values.min())
    highest = float(values.max())
    drawn = draw_cells(axes, scanpath.grid, values[fixation], alpha=alpha, cmap=UNCERTAINTY, vmin=lowest, vmax=highest)
    draw_cross(axes, scanpath.fixations[fixation])
    axes.set_title(f"uncertainty after fixation {fixation + 1}")
    return drawn


def draw_semantic_map(axes: Axes, scanpath: Scanpath, fixation: int, image: Tensor | None) -> AxesImage:
    """Draw the probability of the most probable object of every cell, from 0 to 1, over a photograph."""
    draw_grey(axes, image, scanpath.grid)
    drawn = draw_cells(axes, scanpath.grid, scanpath.probabilities[fixation, :, 1:].amax(-1))
    draw_grid(axes, scanpath.grid)
    draw_cross(axes, scanpath.fixations[fixation])
    axes.set_title(f"semantic map after fixation {fixation + 1}")
    return drawn


_Line = list[tuple[float, float]]


def write_names(axes: Axes, grid: Grid, regions: Sequence[Region]) -> list[Artist]:
    """Draw borders and names of regions, each name on a cell where it covers no other.

    Args:
        axes: axes of a figure that is laid out.
        grid: the cells.
        regions: the regions.

    Returns:
        What was drawn.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    sides: list[_Line] = []
    for region in regions:
        sides += _borders(grid, region.cells)
    borders = LineCollection(sides, colors="white")
    borders.set(linewidths=1.3, zorder=3)
    drawn: list[Artist] = [axes.add_collection(borders, autolim=False)]
    for region, (x1, y1, x2, y2) in zip(regions, _places_of_names(axes, grid, regions), strict=True):
        x = (x1 + x2) / 2
        y = (y1 + y2) / 2
        text = axes.text(x, y, region.name, color="black", fontsize=_NAME_POINTS, clip_on=True)
        text.set(ha="center", va="center", parse_math=False)
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
        drawn.append(text)
    return drawn


def _places_of_names(axes: Axes, grid: Grid, regions: Sequence[Region]) -> list[LabelBox]:
    """Place each name on a cell of its region, as near as there is room to the middle."""
    candidates = []
    sizes = []
    for region in regions:
        centres = grid.centres[region.cells] + 0.5
        from_middle = (centres - centres.mean(0)).norm(dim=-1)
        nearest_first = centres[from_middle.argsort(stable=True)].tolist()
        width, height = text_size(axes, region.name, _NAME_POINTS)
        candidates.append([(x - width / 2, y - height / 2) for x, y in nearest_first])
        sizes.append((width, height))
    frame_width, frame_height = grid.extent.tolist()
    return place_within(candidates, sizes, (frame_width, frame_height))


def _borders(grid: Grid, region: Sequence[int]) -> list[_Line]:
    """List the sides of cells that bound a region."""
    places = {divmod(cell, grid.columns) for cell in region}  # rows and columns
    edges = grid.edges.tolist()
    lines: list[_Line] = []
    for cell in region:
        row, column = divmod(cell, grid.columns)
        x1, y1, x2, y2 = edges[cell]
        side_towards: dict[tuple[int, int], _Line] = {
            (row, column - 1): [(x1, y1), (x1, y2)],
            (row, column + 1): [(x2, y1), (x2, y2)],
            (row - 1, column): [(x1, y1), (x2, y1)],
            (row + 1, column): [(x1, y2), (x2, y2)],
        }
        lines += [side for neighbour, side in side_towards.items() if neighbour not in places]
    return lines

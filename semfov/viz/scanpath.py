"""Figures of scanpaths: where the gaze went, and what was seen from each fixation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.data.inputs import ImageLike, as_image
from semfov.errors import InputError, check
from semfov.paths import Scanpath
from semfov.viz.belief import draw_belief
from semfov.viz.drawing import (
    choose_fixations,
    draw_boxes,
    draw_detections,
    draw_gaze,
    draw_grid,
    draw_image,
    draw_scale,
    photograph_of,
)
from semfov.viz.objects import LegendEntry, draw_legend, draw_objects, object_entries
from semfov.viz.path import GazePath, path_of
from semfov.viz.semantic import draw_semantic_map, write_names
from semfov.viz.style import TRUTH, lay_out, make_figure, only, root, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

MOST_BOXES = 6
"""Largest number of detections of a look that are drawn."""


@styled
def plot_scanpath(
    scanpath: Scanpath | Fixations,
    image: ImageLike | None = None,
    *,
    boxes: Tensor | None = None,
    objects: bool = True,
    ax: Axes | None = None,
) -> Figure:
    """Plot numbered fixations on the photograph, coloured by time, with the grid and the objects.

    A legend explains the colours of the boxes: those of objects that a closer look or the decision confirmed, and
    others. Fixations of people have no grid and no objects; their target's box is drawn dashed.

    Args:
        scanpath: the episode, or the fixations of a person (`semfov.data.fixations`).
        image: the picture, of any common type (`semfov.as_image`); None takes the scanpath's own. Fixations of people
            need it.
        boxes: `(M, 4)`, true boxes of the target, drawn dashed.
        objects: whether to draw the objects of the scanpath.
        ax: axes to draw in; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: the photograph is neither given nor kept by the scanpath.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
        save_figure(plot_scanpath(scanpath), "scanpath.pdf")
    """
    image = None if image is None else as_image(image)
    if isinstance(scanpath, Fixations):
        return _plot_person(scanpath, image, boxes, ax)
    image = photograph_of(scanpath, image)
    height = 6.4 * image.shape[-2] / image.shape[-1] + 0.6
    figure, (axes,) = make_figure(1, 1, width=6.4, height=height, layout="compressed", axes=only(ax))
    draw_place(axes, scanpath, image, boxes)
    axes.set_title(scanpath.describe(), parse_math=False)
    draw_legend(axes, [*annotation_entries(scanpath, boxes), *(object_entries(scanpath) if objects else [])])
    lay_out(figure)
    path = path_of(axes, scanpath)
    if objects:
        draw_objects(axes, scanpath, path.number_boxes)
    return figure


def _plot_person(fixations: Fixations, image: Tensor | None, boxes: Tensor | None, ax: Axes | None) -> Figure:
    """Plot fixations of a person on the photograph."""
    if image is None:
        raise InputError("image: expected the photograph, as fixations of people hold none, got None")
    width, height = fixations.size
    tall = 6.4 * height / width + 0.6
    figure, (axes,) = make_figure(1, 1, width=6.4, height=tall, layout="compressed", axes=only(ax))
    draw_image(axes, image, Grid(1, 1, fixations.size))
    if boxes is None and fixations.box is not None:
        boxes = Tensor([fixations.box])
    if boxes is not None:
        draw_boxes(axes, boxes, TRUTH, "--", 1.8)
    title = f"{fixations.picture}, {fixations.subject}: {len(fixations)} fixations"
    if fixations.target is not None:
        outcome = {None: "", True: ", found", False: ", not found"}[fixations.found]
        title = f"{fixations.picture}, {fixations.subject}: “{fixations.target}”{outcome}"
    axes.set_title(title, parse_math=False)
    lay_out(figure)
    GazePath(axes, fixations.points, (width, height), found=bool(fixations.found))
    return figure


@styled
def plot_foveated_strip(
    scanpath: Scanpath,
    views: Sequence[Tensor] | None = None,
    *,
    most: int = 10,
    columns: int = 5,
    axes: Sequence[Axes] | None = None,
) -> Figure:
    """Plot the foveated views of several fixations, with the detections in them.

    Args:
        scanpath: the episode.
        views: for each fixation the foveated photograph `(3, h, w)`, of any size; None takes the scanpath's own.
        most: largest number of fixations to show: the first ones and the last.
        columns: number of pictures in a row.
        axes: axes to draw in, one for each fixation that is shown; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: the views are neither given nor kept by the scanpath, or an argument is out of range.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
        save_figure(plot_foveated_strip(scanpath, most=4), "views.png")
    """
    views = views_of(scanpath, views)
    check(columns >= 1, "columns", "at least 1", columns)
    fixations = choose_fixations(scanpath, most)
    columns = len(fixations) if axes is not None else min(columns, len(fixations))
    rows = -(-len(fixations) // columns)
    height = rows * (2.6 * views[0].shape[-2] / views[0].shape[-1] + 0.3)
    figure, panels = make_figure(rows, columns, width=2.6 * columns, height=height, layout="compressed", axes=axes)
    used = list(zip(panels, fixations, strict=False))
    for panel, fixation in used:
        _draw_view(panel, scanpath, fixation, views[fixation])
    for panel in panels[len(fixations) :]:
        panel.remove()
    _label_views(figure, scanpath, used)
    return figure


@styled
def plot_episode(
    scanpath: Scanpath,
    image: Tensor | None = None,
    views: Sequence[Tensor] | None = None,
    *,
    boxes: Tensor | None = None,
    most: int = 5,
    figure: FigureBase | None = None,
) -> Figure:
    """Plot a whole episode: the scanpath, and for several fixations the foveated view above the belief after it.

    The belief is the target's posterior, or the semantic map if nothing was searched for.

    Args:
        scanpath: the episode.
        image: `(3, H, W)`, RGB in [0, 1]; None takes the scanpath's own.
        views: for each fixation the foveated photograph `(3, h, w)`, of any size; None takes the scanpath's own.
        boxes: `(M, 4)`, true boxes of the target, drawn dashed.
        most: largest number of fixations to show: the first ones and the last.
        figure: empty figure or subfigure to draw in; None makes one.

    Returns:
        The figure.

    Raises:
        InputError: the photograph or the views are neither given nor kept by the scanpath.

    Example::

        scanpath = agent.explore(read_image("kitchen.jpg"))
        save_figure(plot_episode(scanpath, most=3), "episode.pdf")
    """
    from matplotlib.figure import Figure

    image, views = photograph_of(scanpath, image), views_of(scanpath, views)
    fixations = choose_fixations(scanpath, most)
    aspect = image.shape[-2] / image.shape[-1]
    width = 2.5 * len(fixations) + 5.8
    place: Any = figure or Figure(figsize=(width, 2 * 2.5 * aspect + 0.9), layout="constrained")
    sides: Any = place.subfigures(1, 2, width_ratios=[5.2, width - 5.2])
    left, right = sides
    first = left.subplots()
    draw_place(first, scanpath, image, boxes)
    first.set_title(scanpath.describe(), parse_math=False)
    draw_legend(first, annotation_entries(scanpath, boxes))
    panels = right.subplots(2, len(fixations), squeeze=False)
    for (above, below), fixation in zip(panels.T, fixations, strict=True):
        _draw_view(above, scanpath, fixation, views[fixation])
        if scanpath.target is None:
            drawn = draw_semantic_map(below, scanpath, fixation, image)
        else:
            drawn = draw_belief(below, scanpath, fixation, None, image)
    draw_scale(list(panels.flat), drawn, "probability")
    whole = root(first)
    _label_views(whole, scanpath, zip(panels[0], fixations, strict=True))
    path_of(first, scanpath)
    if scanpath.target is None:
        for below, fixation in zip(panels[1], fixations, strict=True):
            write_names(below, scanpath, fixation)
    return whole


def draw_place(axes: Axes, scanpath: Scanpath, image: Tensor, boxes: Tensor | None) -> None:
    """Draw the photograph, the grid, and the true boxes of the target."""
    draw_image(axes, image, scanpath.grid)
    draw_grid(axes, scanpath.grid)
    if boxes is not None:
        draw_boxes(axes, boxes, TRUTH, "--", 1.8)


def annotation_entries(scanpath: Scanpath, boxes: Tensor | None) -> list[LegendEntry]:
    """Entries of a legend for the true boxes of the target, where there are any."""
    name = "target" if scanpath.target is None else scanpath.classes[scanpath.target]
    return [(TRUTH, "--", f"annotated: {name}")] if boxes is not None and len(boxes) else []


def _draw_view(axes: Axes, scanpath: Scanpath, fixation: int, view: Tensor) -> None:
    """Draw the foveated view of a fixation."""
    draw_image(axes, view, scanpath.grid)
    draw_gaze(axes, scanpath, fixation)
    axes.set_title(f"fixation {fixation}")


def views_of(scanpath: Scanpath, views: Sequence[Tensor] | None) -> Sequence[Tensor]:
    """The given views, or those of the scanpath."""
    views = scanpath.views() if views is None else views
    check(len(views) == len(scanpath), "views", f"{len(scanpath)} views, one for each fixation", len(views))
    return views


def _label_views(figure: Figure, scanpath: Scanpath, views: Iterable[tuple[Axes, int]]) -> None:
    """Draw the detections of views, after the layout of the figure, on which the positions of labels depend."""
    lay_out(figure)
    for axes, fixation in views:
        draw_detections(axes, scanpath, fixation, MOST_BOXES)

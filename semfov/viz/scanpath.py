"""Figures of scanpaths: where the gaze went, what was seen from each fixation, and which objects were found."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.data.inputs import ImageLike
from semfov.errors import check, checked_keywords
from semfov.paths import Record, Scanpath
from semfov.paths.look import LookView
from semfov.viz.belief import draw_belief
from semfov.viz.drawing import check_foveal, choose_fixations, draw_image, draw_scale, make_panels, photograph_of
from semfov.viz.look import draw_view
from semfov.viz.objects import (
    LegendEntry,
    annotation_entries,
    draw_legend,
    draw_mark_labels,
    draw_marks,
    draw_place,
    grid_of,
    object_entries,
    object_marks,
)
from semfov.viz.path import GazePath, LookPath
from semfov.viz.semantic import draw_semantic_map, regions_after, write_names
from semfov.viz.style import GAZE, lay_out, make_figure, only, root, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase


@checked_keywords
@styled
def plot_scanpath(
    scanpath: Record | Fixations,
    image: ImageLike | None = None,
    *,
    boxes: Tensor | None = None,
    objects: bool = True,
    ax: Axes | None = None,
) -> Figure:
    """Plot the looks of a record of any kind on the picture, with the objects.

    Fixations of an eye are numbered dots, coloured by time. Looks that show a part of the picture, such as windows and
    the views of a head, are outlined. A legend explains the colours of the boxes: those of objects that a closer look
    or the decision confirmed, and others. Fixations of people have no objects; their target's box is drawn dashed.

    Args:
        scanpath: the record, or the fixations of a person (`semfov.data.fixations`).
        image: the picture in any size, of any common kind (`semfov.as_image`); None takes the record's own. Fixations
            of people need it.
        boxes: `(M, 4)`, true boxes of the target, drawn dashed.
        objects: whether to draw the objects of the record.
        ax: axes to draw in; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: the picture is neither given nor kept by the record.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup", how="fovea")
        save_figure(plot_scanpath(scanpath), "scanpath.pdf")
    """
    picture = photograph_of(scanpath, image)
    width, height = scanpath.size
    figure, (axes,) = make_figure(
        1, 1, width=7.2, height=7.2 * height / width + 0.6, layout="compressed", axes=only(ax)
    )
    if isinstance(scanpath, Fixations):
        _draw_people(axes, scanpath, picture, boxes)
    else:
        _draw_record(axes, scanpath, picture, boxes, objects=objects)
    return figure


_FOUND_IN_WORDS = {None: "", True: ", found", False: ", not found"}


def _draw_people(axes: Axes, fixations: Fixations, image: Tensor, boxes: Tensor | None) -> None:
    """Draw the fixations of a person, and the box of the target where none is given."""
    if boxes is None and fixations.box is not None:
        boxes = Tensor([fixations.box])
    draw_place(axes, Grid(1, 1, fixations.size), image, boxes)
    title = f"{len(fixations)} fixations"
    if fixations.target is not None:
        title = f"“{fixations.target}”{_FOUND_IN_WORDS[fixations.found]}"
    axes.set_title(fill(f"{fixations.picture}, {fixations.subject}: {title}", 80), parse_math=False)
    lay_out(root(axes))
    GazePath(axes, fixations.points, fixations.size, found=bool(fixations.found))


def _draw_record(axes: Axes, record: Record, image: Tensor, boxes: Tensor | None, *, objects: bool) -> None:
    """Draw the looks of a record, and its objects if they are wanted."""
    draw_place(axes, grid_of(record), image, boxes)
    remarks = filter(None, [record.words.lack(), record.words.assumption()])
    title = ". ".join([record.describe(), " ".join(remarks)]).removesuffix(". ")
    axes.set_title(fill(title, 100), parse_math=False)
    entries = annotation_entries(record, boxes)
    if objects:
        entries += object_entries(record)
    if any(record.outline(look) is not None for look in record):
        entries.insert(0, LegendEntry(GAZE, "-", "shown by the looks"))
    draw_legend(axes, entries)
    # Labels are placed by the size of the axes, which the legend changes.
    lay_out(root(axes))
    path = LookPath(axes, record)
    if objects:
        marks = object_marks(record)
        draw_marks(axes, marks)
        draw_mark_labels(axes, record, marks, path.number_boxes)


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
        InputError: it is no record of a fovea, its views are neither given nor kept, or an argument is out of range.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup", how="fovea")
        save_figure(plot_foveated_strip(scanpath, most=4), "views.png")
    """
    views = _views(scanpath, views)
    fixations = choose_fixations(scanpath, most)
    aspect = views[0].shape[-2] / views[0].shape[-1]

    def size(rows: int, columns: int) -> tuple[float, float]:
        return 2.6 * columns, rows * (2.6 * aspect + 0.3)

    panels = make_panels(len(fixations), columns, size, axes)
    for panel, fixation in zip(panels, fixations, strict=True):
        draw_image(panel, views[fixation], scanpath.grid)
        panel.set_title(f"fixation {fixation + 1}")
    _label_views(panels, scanpath, fixations, views)
    return root(panels[0])


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
        InputError: it is no record of a fovea, or the photograph or the views are neither given nor kept by it.

    Example::

        scanpath = agent.explore(read_image("kitchen.jpg"), how="fovea")
        save_figure(plot_episode(scanpath, most=3), "episode.pdf")
    """
    from matplotlib.figure import Figure

    views = _views(scanpath, views)
    image = photograph_of(scanpath, image)
    fixations = choose_fixations(scanpath, most)
    aspect = image.shape[-2] / image.shape[-1]
    width = 2.5 * len(fixations) + 5.8
    place: Any = figure or Figure(figsize=(width, 2 * 2.5 * aspect + 0.9), layout="constrained")
    path_side, look_side = place.subfigures(1, 2, width_ratios=[5.2, width - 5.2])
    path_axes = path_side.subplots()
    draw_place(path_axes, scanpath.grid, image, boxes)
    path_axes.set_title(scanpath.describe(), parse_math=False)
    draw_legend(path_axes, annotation_entries(scanpath, boxes))
    panels = look_side.subplots(2, len(fixations), squeeze=False)
    for (above, below), fixation in zip(panels.T, fixations, strict=True):
        draw_image(above, views[fixation], scanpath.grid)
        above.set_title(f"fixation {fixation + 1}")
        if scanpath.target is None:
            drawn = draw_semantic_map(below, scanpath, fixation, image)
        else:
            drawn = draw_belief(below, scanpath, fixation, None, image)
    draw_scale(list(panels.flat), drawn, "probability")
    _label_views(panels[0], scanpath, fixations, views)
    LookPath(path_axes, scanpath)
    if scanpath.target is None:
        for below, fixation in zip(panels[1], fixations, strict=True):
            write_names(below, scanpath.grid, regions_after(scanpath, fixation))
    return root(path_axes)


def _views(scanpath: Scanpath, views: Sequence[Tensor] | None) -> Sequence[Tensor]:
    """Return the given foveated views of a fovea's record, or its own, one for each fixation."""
    check_foveal(scanpath)
    views = scanpath.views() if views is None else views
    count = len(scanpath.fixated)
    check(len(views) == count, "views", f"{count} views, one for each fixation", len(views))
    return views


def _label_views(panels: Sequence[Axes], scanpath: Scanpath, fixations: Sequence[int], views: Sequence[Tensor]) -> None:
    """Draw gaze and detections into views, after the layout of the figure, on which the positions of labels depend."""
    lay_out(root(panels[0]))
    for axes, fixation in zip(panels, fixations, strict=True):
        look = scanpath.fixated[fixation]
        view = LookView(views[fixation], scanpath.size, look.detections.boxes[0], look.fixation)
        draw_view(axes, scanpath, look, view, most=6)

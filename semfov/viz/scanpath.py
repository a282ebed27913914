"""Figures of scanpaths: where the gaze went, what was seen from each fixation, and which objects were found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from textwrap import fill
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.data.inputs import ImageLike
from semfov.data.large import open_large
from semfov.errors import check
from semfov.paths import Record, Scanpath
from semfov.paths.look import LookView, confident_detections
from semfov.viz.belief import draw_belief
from semfov.viz.drawing import (
    check_fixation,
    check_foveal,
    choose_fixations,
    draw_boxes,
    draw_cells,
    draw_cross,
    draw_grid,
    draw_image,
    draw_look,
    draw_scale,
    draw_tags,
    per_point,
    photograph_of,
    picture_array,
)
from semfov.viz.labels import LabelBox
from semfov.viz.path import GazePath, LookPath
from semfov.viz.semantic import draw_semantic_map, write_names
from semfov.viz.style import FOUND, GAZE, TARGET, TRUTH, lay_out, make_figure, only, root, styled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

_LegendEntry = tuple[str, str, str]  # colour, line style and text of an entry of a legend
_NAMED = 15  # largest number of objects whose labels name their class where only one class was searched for
_LABELLED = 60  # largest number of objects that have labels


def _draw_objects(
    axes: Axes,
    record: Record,
    obstacles: Sequence[LabelBox] = (),
    *,
    last: int | None = None,
    tagged: bool = True,
) -> list[Artist]:
    """Draw the objects of a record, at both ends of a seam; for labels the figure must be laid out."""
    last = len(record) if last is None else last
    rows = [row for row in record.object_rows() if row["look"] <= last]
    width, height = record.size
    refuted = [look.box for look in record.refuted if look.of_look <= last]
    drawn = [artist for box in refuted for artist in draw_boxes(axes, box[None], FOUND, ":", 1.6)]
    tags: list[tuple[LabelBox, str, str]] = []
    many = len(rows) > _NAMED
    single = many and record.target is not None
    # The most confident objects are drawn last, over the others.
    for row in reversed(rows):
        colour, line = (FOUND, 2.0) if row["confirmed"] else (TARGET, 0.8 if many else 1.2)
        text = f"{row['score']:.2f}" if single else f"{row['class']} {row['score']:.2f}"
        for turn in (0, width) if row["x2"] > width else (0,):
            box = row["x1"] - turn, row["y1"], row["x2"] - turn, row["y2"]
            drawn += draw_boxes(axes, Tensor([box]), colour, "-", line)
            tags.append((box, text, colour))
    if record.best_place is not None and last >= len(record) - 1:
        best, chance = record.best_place
        drawn += draw_boxes(axes, best[None], FOUND, "--", 2.4)
        if not (record.objects.boxes == best).all(-1).any():  # otherwise it has a label
            x1, y1, x2, y2 = best.tolist()
            tags.append(((x1, y1, x2, y2), f"best place {chance:.2f}", FOUND))
    if tagged:
        drawn += draw_tags(axes, tags[::-1][:_LABELLED], (width, height), obstacles, many=many)
    return drawn


def _draw_legend(axes: Axes, entries: Sequence[_LegendEntry]) -> None:
    from matplotlib.lines import Line2D

    if not entries:
        return
    styles: list[dict[str, Any]] = [{"color": colour, "linestyle": line} for colour, line, _ in entries]
    lines = [Line2D([], [], linewidth=1.8, **style) for style in styles]
    legend = axes.legend(
        lines,
        [text for _, _, text in entries],
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        ncols=len(entries) if sum(len(text) + 6 for _, _, text in entries) < 115 else 2,
        frameon=False,
        handlelength=1.6,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)


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
    image, (width, height) = photograph_of(scanpath, image), scanpath.size
    figure, (axes,) = make_figure(
        1, 1, width=7.2, height=7.2 * height / width + 0.6, layout="compressed", axes=only(ax)
    )
    if isinstance(scanpath, Fixations):
        boxes = Tensor([scanpath.box]) if boxes is None and scanpath.box is not None else boxes
        _draw_place(axes, scanpath, image, boxes)
        title = f"{len(scanpath)} fixations"
        if scanpath.target is not None:
            title = f"“{scanpath.target}”{ {None: '', True: ', found', False: ', not found'}[scanpath.found] }"
        axes.set_title(fill(f"{scanpath.picture}, {scanpath.subject}: {title}", 80), parse_math=False)
        lay_out(figure)
        GazePath(axes, scanpath.points, scanpath.size, found=bool(scanpath.found))
        return figure
    _draw_place(axes, scanpath, image, boxes)
    axes.set_title(fill(scanpath.describe(), 100), parse_math=False)
    outlined = any(scanpath.outline(look) is not None for look in scanpath)
    entries, sure = _annotation_entries(scanpath, boxes), scanpath.confirmed
    name, count, others = scanpath.target_name or "objects", int(sure.sum()), int((~sure).sum())
    if objects and count:
        entries.append((FOUND, "-", f"confirmed: {name} ({count})"))
    if objects and others:
        rest = "not confirmed: " if count or scanpath.decision is not None else ""
        entries.append((TARGET, "-", f"{rest}{name} from {scanpath.words.threshold} ({others})"))
    best = scanpath.best_place
    if objects and best is not None:
        entries.append((FOUND, "--", "best place, not sure enough"))
    if objects and any(best is None or not look.box.equal(best[0]) for look in scanpath.refuted):
        entries.append((FOUND, ":", "not confirmed by a closer look"))
    _draw_legend(axes, [*([(GAZE, "-", "shown by the looks")] if outlined else []), *entries])
    lay_out(figure)
    path = LookPath(axes, scanpath)
    if objects:
        _draw_objects(axes, scanpath, path.number_boxes)
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
        InputError: it is no record of a fovea, its views are neither given nor kept, or an argument is out of range.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup", how="fovea")
        save_figure(plot_foveated_strip(scanpath, most=4), "views.png")
    """
    views = _views(scanpath, views)
    check(columns >= 1, "columns", "at least 1", columns)
    fixations = choose_fixations(scanpath, most)
    columns = len(fixations) if axes is not None else min(columns, len(fixations))
    rows = -(-len(fixations) // columns)
    height = rows * (2.6 * views[0].shape[-2] / views[0].shape[-1] + 0.3)
    figure, panels = make_figure(rows, columns, width=2.6 * columns, height=height, layout="compressed", axes=axes)
    for panel, fixation in zip(panels, fixations, strict=False):
        draw_image(panel, views[fixation], scanpath.grid)
        panel.set_title(f"fixation {fixation}")
    for panel in panels[len(fixations) :]:
        panel.remove()
    _label_views(panels, scanpath, fixations, views)
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
        InputError: it is no record of a fovea, or the photograph or the views are neither given nor kept by it.

    Example::

        scanpath = agent.explore(read_image("kitchen.jpg"), how="fovea")
        save_figure(plot_episode(scanpath, most=3), "episode.pdf")
    """
    from matplotlib.figure import Figure

    views, image = _views(scanpath, views), photograph_of(scanpath, image)
    fixations = choose_fixations(scanpath, most)
    aspect = image.shape[-2] / image.shape[-1]
    width = 2.5 * len(fixations) + 5.8
    place: Any = figure or Figure(figsize=(width, 2 * 2.5 * aspect + 0.9), layout="constrained")
    sides: Any = place.subfigures(1, 2, width_ratios=[5.2, width - 5.2])
    left, right = sides
    first = left.subplots()
    _draw_place(first, scanpath, image, boxes)
    first.set_title(scanpath.describe(), parse_math=False)
    _draw_legend(first, _annotation_entries(scanpath, boxes))
    panels = right.subplots(2, len(fixations), squeeze=False)
    for (above, below), fixation in zip(panels.T, fixations, strict=True):
        draw_image(above, views[fixation], scanpath.grid)
        above.set_title(f"fixation {fixation}")
        if scanpath.target is None:
            drawn = draw_semantic_map(below, scanpath, fixation, image)
        else:
            drawn = draw_belief(below, scanpath, fixation, None, image)
    draw_scale(list(panels.flat), drawn, "probability")
    _label_views(panels[0], scanpath, fixations, views)
    LookPath(first, scanpath)
    if scanpath.target is None:
        for below, fixation in zip(panels[1], fixations, strict=True):
            write_names(below, scanpath, fixation)
    return root(first)


def _draw_place(axes: Axes, record: Record | Fixations, image: Tensor, boxes: Tensor | None) -> None:
    """Draw the picture, the cells of a fovea, and the true boxes of the target."""
    believed = record.belief_map(0) if isinstance(record, Record) and record.kind.grid else None
    grid = Grid(1, 1, record.size) if believed is None else believed[0]
    draw_image(axes, image, grid)
    draw_grid(axes, grid)
    if boxes is not None:
        draw_boxes(axes, boxes, TRUTH, "--", 1.8)


def _annotation_entries(record: Record, boxes: Tensor | None) -> list[_LegendEntry]:
    """Entries of a legend for the true boxes of the target, where there are any."""
    some = boxes is not None and len(boxes)
    return [(TRUTH, "--", f"annotated: {record.target_name or 'target'}")] if some else []


def _draw_view(axes: Axes, record: Record, number: int, view: LookView, most: int) -> list[Artist]:
    """Draw gaze and most confident detections of a look into its view; labels do not cover the point of gaze."""
    look, (x, y), reach = record.looks[number].detections, view.gaze, 8 * per_point(axes)
    detections = confident_detections(replace(look, boxes=view.boxes[None]), most)
    gaze = (x + 0.5 - reach, y + 0.5 - reach, x + 0.5 + reach, y + 0.5 + reach)
    drawn = draw_look(axes, detections, record.classes, view.size, target=record.target, obstacles=[gaze])
    return [*draw_cross(axes, view.gaze), *drawn]


def _views(scanpath: Scanpath, views: Sequence[Tensor] | None) -> Sequence[Tensor]:
    check_foveal(scanpath)
    views = scanpath.views() if views is None else views
    check(len(views) == len(scanpath), "views", f"{len(scanpath)} views, one for each fixation", len(views))
    return views


def _label_views(panels: Sequence[Axes], scanpath: Scanpath, fixations: Sequence[int], views: Sequence[Tensor]) -> None:
    """Draw gaze and detections into views, after the layout of the figure, on which the positions of labels depend."""
    lay_out(root(panels[0]))
    for axes, fixation in zip(panels, fixations, strict=False):
        look = scanpath.looks[fixation]
        view = LookView(views[fixation], scanpath.size, look.detections.boxes[0], look.fixation)
        _draw_view(axes, scanpath, fixation, view, most=6)


@styled
def plot_fixation(
    scanpath: Record,
    fixation: int,
    image: Tensor | None = None,
    view: Tensor | None = None,
    *,
    boxes: Tensor | None = None,
    axes: Sequence[Axes] | None = None,
) -> Figure:
    """Plot one look: the looks and objects so far, what it shows with its detections, and the belief after it.

    The belief is the probability of the target, or of any object if nothing was searched for. Windows have none.

    Args:
        scanpath: the record, of any kind.
        fixation: number of the look; -1 is the last.
        image: `(3, H, W)`, RGB in [0, 1]; None takes the record's own.
        view: what the look shows, the foveated photograph `(3, h, w)`, of any size; None takes the record's own.
        boxes: `(M, 4)`, true boxes of the target, drawn dashed.
        axes: axes to draw in, three, or two for windows; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: the photograph is neither given nor kept by the record, or there is no such look.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
        save_figure(plot_fixation(scanpath, 0), "first.png")
    """
    fixation, image = check_fixation(scanpath, fixation), photograph_of(scanpath, image)
    views = None if view is None else [view] * len(scanpath)
    seen = views_of(scanpath, image, views)[fixation]
    return LookFigure(scanpath, image, seen, boxes, axes).show(fixation, seen)


def views_of(record: Record, image: Tensor, views: Sequence[Tensor] | None) -> list[LookView]:
    """What the looks showed, from the given views `(3, h, w)` of the whole picture, or from the picture `(3, H, W)`."""
    if views is None:
        return list(record.look_views(open_large(image)))
    check(len(views) == len(record), "views", f"{len(record)} views, one for each fixation", len(views))
    return [
        LookView(view, record.size, look.detections.boxes[0], look.fixation)
        for look, view in zip(record, views, strict=True)
    ]


class LookFigure:
    """A figure of one look that can show other looks: it is laid out once, and only differences are redrawn."""

    def __init__(
        self,
        record: Record,
        image: Tensor,
        view: LookView,
        boxes: Tensor | None = None,
        axes: Sequence[Axes] | None = None,
    ) -> None:
        self.record, believed = record, record.belief_map(0)
        panels, aspect = 2 if believed is None else 3, image.shape[-2] / image.shape[-1]
        wide = 4.2 * min(max(1.0, 0.7 / aspect), 2.0)  # inches; panels of panoramas are wider, not flat
        height = max(wide * aspect / 1.05 + 0.3, 3.4)  # the view keeps its height beside a flat panorama
        self.figure, self.axes = make_figure(1, panels, wide * panels, height, layout="compressed", axes=axes)
        path_axes, view_axes, *others = self.axes
        if axes is None:
            # Hidden axes save the layout of ticks, a tenth of the time.
            for panel in self.axes:
                panel.xaxis.set_visible(False)
                panel.yaxis.set_visible(False)
        _draw_place(path_axes, record, image, boxes)
        _draw_legend(path_axes, _annotation_entries(record, boxes))
        self.view = view_axes.imshow(picture_array(view.pixels), interpolation="bilinear")
        view_axes.set(xticks=[], yticks=[], title="what the eye sees")
        self.named = isinstance(record, Scanpath) and record.target is None
        if believed is not None:
            (belief_axes,), (grid, chances) = others, believed
            draw_image(belief_axes, image, grid, grey=True)
            self.belief = draw_cells(belief_axes, grid, chances)
            if self.named:
                draw_grid(belief_axes, grid)
            draw_scale(belief_axes, self.belief, "probability")
        path_axes.set_title("look 0")
        lay_out(self.figure)
        if axes is None:
            # The layout does not change any more, and computing it again takes as long as drawing.
            self.figure.set_layout_engine("none")
        self.path = LookPath(path_axes, record)
        self.changing: list[Artist] = []

    def show(self, number: int, view: LookView) -> Figure:
        record, (path_axes, view_axes, *others) = self.record, self.axes
        look, (width, height) = record.looks[number], view.size
        for artist in self.changing:
            artist.remove()
        self.path.show(number)
        path_axes.set_title(f"look {number}" if look.seconds is None else f"look {number}, {look.seconds:.2f} s")
        self.changing = _draw_objects(path_axes, record, last=number, tagged=False)
        self.view.set_data(picture_array(view.pixels))
        self.view.set_extent((0, width, height, 0))
        view_axes.set(xlim=(0, width), ylim=(height, 0))
        self.changing += _draw_view(view_axes, record, number, view, most=10)
        for axes, believed in zip(others, [record.belief_map(number)], strict=False):
            assert believed is not None
            grid, chances = believed
            self.belief.set_data(chances.detach().cpu().reshape(grid.rows, grid.columns).numpy())
            self.changing += draw_cross(axes, look.fixation)
            title = f"p({record.target_name or 'any object'}) up to {float(chances.max()):.2f}"
            if isinstance(record, Scanpath) and self.named:
                title = f"semantic map after fixation {number}"
                self.changing += write_names(axes, record, number)
            axes.set_title(title, parse_math=False)
        return self.figure

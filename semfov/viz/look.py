"""One look of a record in a figure: the looks and objects so far, what it shows, and the belief after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.large import open_large
from semfov.errors import check
from semfov.paths import Record, RecordedLook
from semfov.paths.look import LookView, confident_detections
from semfov.viz.drawing import (
    check_fixation,
    draw_cells,
    draw_cross,
    draw_grid,
    draw_image,
    draw_look,
    draw_scale,
    per_point,
    photograph_of,
    picture_array,
)
from semfov.viz.objects import annotation_entries, draw_legend, draw_marks, draw_place, grid_of, object_marks
from semfov.viz.path import LookPath
from semfov.viz.semantic import write_names
from semfov.viz.style import lay_out, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
    number = check_fixation(len(scanpath), fixation)
    image = photograph_of(scanpath, image)
    views = None if view is None else [view] * len(scanpath.fixated)
    shown = views_of(scanpath, image, views)[number]
    return LookFigure(scanpath, image, shown, boxes, axes).show(number, shown)


def draw_view(axes: Axes, record: Record, look: RecordedLook, view: LookView, most: int) -> list[Artist]:
    """Draw gaze and detections of a look into its view; no label covers the point of gaze.

    Args:
        axes: axes of the view, laid out.
        record: the record.
        look: the look.
        view: what it shows.
        most: largest number of detections; the most confident ones are drawn.

    Returns:
        What was drawn.
    """
    detections = confident_detections(replace(look.detections, boxes=view.boxes[None]), most)
    x, y = view.gaze
    reach = 8 * per_point(axes)
    cross = (x + 0.5 - reach, y + 0.5 - reach, x + 0.5 + reach, y + 0.5 + reach)
    drawn = draw_look(axes, detections, record.classes, view.size, target=record.target, obstacles=[cross])
    return [*draw_cross(axes, view.gaze), *drawn]


def views_of(record: Record, image: Tensor, views: Sequence[Tensor] | None) -> list[LookView]:
    """Collect what the looks showed.

    Args:
        record: the record.
        image: `(3, H, W)`, the picture.
        views: for each fixation a view `(3, h, w)` of the whole picture; None takes those of the record.

    Returns:
        Pixels, boxes and gaze of each look.
    """
    shown = list(record.look_views(open_large(image)))
    if views is None:
        return shown
    count = len(record.fixated)
    check(len(views) == count, "views", f"{count} views, one for each fixation", len(views))
    for look, view in zip(record.fixated, views, strict=True):
        shown[look.index] = LookView(view, record.size, look.detections.boxes[0], look.fixation)
    return shown


class LookFigure:
    """A figure of one look that can show other looks: it is laid out once, and only differences are redrawn.

    `path` has the looks so far, `view` the pixels of the look, and `belief` the cells of the map, None for windows.
    `changing` are the artists of the look that is shown, which the next one removes.

    Args:
        record: the record.
        image: `(3, H, W)`, the picture.
        view: what the first look shows.
        boxes: `(M, 4)`, true boxes of the target.
        axes: axes to draw in; None makes a figure.
    """

    def __init__(
        self,
        record: Record,
        image: Tensor,
        view: LookView,
        boxes: Tensor | None = None,
        axes: Sequence[Axes] | None = None,
    ) -> None:
        self.record = record
        # An exploration with a fovea has a map of all classes, in which regions are named.
        self._names_regions = record.kind.grid and record.target is None
        believed = record.belief_map(0)
        panels = 2 if believed is None else 3
        self.figure, self.axes = self._open(panels, image.shape[-2] / image.shape[-1], axes)
        path_axes, view_axes = self.axes[:2]
        draw_place(path_axes, grid_of(record), image, boxes)
        draw_legend(path_axes, annotation_entries(record, boxes))
        path_axes.set_title("look 1")
        self.view = view_axes.imshow(picture_array(view.pixels), interpolation="bilinear")
        view_axes.set(xticks=[], yticks=[], title="what the eye sees")
        if believed is not None:
            self._draw_belief(image, *believed)
        # Numbers and labels are placed by the size of the axes.
        lay_out(self.figure)
        if axes is None:
            # The layout does not change any more, and computing it again takes as long as drawing.
            self.figure.set_layout_engine("none")
        self.path = LookPath(path_axes, record)
        self.changing: list[Artist] = []

    @staticmethod
    def _open(panels: int, aspect: float, axes: Sequence[Axes] | None) -> tuple[Figure, list[Axes]]:
        """Make a figure with panels in a row for a picture of some height over width, or use the given axes."""
        width = 4.2 * min(max(1.0, 0.7 / aspect), 2.0)  # inches; panels of panoramas are wider, not flat
        height = max(width * aspect / 1.05 + 0.3, 3.4)  # the view keeps its height beside a flat panorama
        figure, opened = make_figure(1, panels, width * panels, height, layout="compressed", axes=axes)
        if axes is None:
            # Hidden axes save the layout of ticks, a tenth of the time.
            for panel in opened:
                panel.xaxis.set_visible(False)
                panel.yaxis.set_visible(False)
        return figure, opened

    def _draw_belief(self, image: Tensor, grid: Grid, chances: Tensor) -> None:
        """Draw the belief over the grey picture, with the scale of its colours."""
        axes = self.axes[2]
        draw_image(axes, image, grid, grey=True)
        self.belief = draw_cells(axes, grid, chances)
        if self._names_regions:
            draw_grid(axes, grid)
        draw_scale(axes, self.belief, "probability")

    def show(self, number: int, view: LookView) -> Figure:
        """Show a look.

        Args:
            number: number of the look.
            view: what it shows.

        Returns:
            The figure, which the next call changes.
        """
        for artist in self.changing:
            artist.remove()
        self.changing = self._show_path(number)
        self.changing += self._show_view(number, view)
        believed = self.record.belief_map(number)
        if believed is not None:
            self.changing += self._show_belief(number, *believed)
        return self.figure

    def _show_path(self, number: int) -> list[Artist]:
        """Show the looks and objects up to a look; returns what was drawn."""
        axes = self.axes[0]
        self.path.show(number)
        seconds = self.record.looks[number].seconds
        axes.set_title(f"look {number + 1}" if seconds is None else f"look {number + 1}, {seconds:.2f} s")
        return draw_marks(axes, object_marks(self.record, number))

    def _show_view(self, number: int, view: LookView) -> list[Artist]:
        """Show the pixels of a look with its detections; returns what was drawn."""
        axes = self.axes[1]
        width, height = view.size
        self.view.set_data(picture_array(view.pixels))
        self.view.set_extent((0, width, height, 0))
        axes.set(xlim=(0, width), ylim=(height, 0))
        return draw_view(axes, self.record, self.record.looks[number], view, most=10)

    def _show_belief(self, number: int, grid: Grid, chances: Tensor) -> list[Artist]:
        """Show the belief after a look; returns what was drawn."""
        axes = self.axes[2]
        self.belief.set_data(chances.detach().cpu().reshape(grid.rows, grid.columns).numpy())
        drawn = draw_cross(axes, self.record.looks[number].fixation)
        title = f"p({self.record.target_name or 'any object'}) up to {float(chances.max()):.2f}"
        if self._names_regions:
            title = f"semantic map after fixation {number + 1}"
            drawn += write_names(axes, grid, self.record.regions(number))
        axes.set_title(title, parse_math=False)
        return drawn

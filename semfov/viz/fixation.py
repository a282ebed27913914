"""One look of a record in a figure: a frame of an animation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from semfov.data.large import open_large
from semfov.errors import check
from semfov.paths import Record, Scanpath
from semfov.paths.look import LookView
from semfov.viz.drawing import (
    check_fixation,
    draw_cross,
    draw_grid,
    draw_image,
    draw_overlay,
    draw_scale,
    draw_view,
    photograph_of,
    picture_array,
)
from semfov.viz.objects import draw_legend, draw_objects
from semfov.viz.path import LookPath
from semfov.viz.scanpath import annotation_entries, draw_place
from semfov.viz.semantic import write_names
from semfov.viz.style import lay_out, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_BOXES = 10
"""Largest number of detections of a look that are drawn."""


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
    """A figure of one look that can show other looks: it is laid out once, and only differences are redrawn.

    Shapes: image `(3, H, W)`, boxes `(M, 4)`.
    """

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
        draw_place(path_axes, record, image, boxes)
        draw_legend(path_axes, annotation_entries(record, boxes))
        self.view = view_axes.imshow(picture_array(view.pixels), interpolation="bilinear")
        view_axes.set(xticks=[], yticks=[], title="what the eye sees")
        self.named = isinstance(record, Scanpath) and record.target is None
        if believed is not None:
            (belief_axes,), (grid, chances) = others, believed
            draw_image(belief_axes, image, grid, grey=True)
            self.belief = draw_overlay(belief_axes, grid, chances)
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
        """Show a look."""
        record, (path_axes, view_axes, *others) = self.record, self.axes
        look, (width, height) = record.looks[number], view.size
        for artist in self.changing:
            artist.remove()
        self.path.show(number)
        path_axes.set_title(f"look {number}" if look.seconds is None else f"look {number}, {look.seconds:.2f} s")
        self.changing = draw_objects(path_axes, record, last=number, tagged=False)
        self.view.set_data(picture_array(view.pixels))
        self.view.set_extent((0, width, height, 0))
        view_axes.set(xlim=(0, width), ylim=(height, 0))
        self.changing += draw_view(view_axes, record, number, view, _MOST_BOXES)
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

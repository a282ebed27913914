"""One fixation in a figure: a frame of an animation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.paths import Scanpath
from semfov.viz.belief import belief_title, draw_belief
from semfov.viz.belief import class_posterior as posterior_of
from semfov.viz.drawing import (
    cell_table,
    check_fixation,
    draw_detections,
    draw_gaze,
    draw_image,
    draw_scale,
    photograph_of,
    picture_array,
)
from semfov.viz.objects import draw_legend
from semfov.viz.path import path_of
from semfov.viz.scanpath import MOST_BOXES, annotation_entries, draw_place
from semfov.viz.semantic import draw_semantic_map, most_probable, write_names
from semfov.viz.style import lay_out, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def plot_fixation(
    scanpath: Scanpath,
    fixation: int,
    image: Tensor | None = None,
    view: Tensor | None = None,
    *,
    boxes: Tensor | None = None,
    axes: Sequence[Axes] | None = None,
) -> Figure:
    """Plot one fixation: the scanpath so far, the foveated view with its detections, and the belief after the look.

    The belief is the target's posterior, or the semantic map if nothing was searched for.

    Args:
        scanpath: the episode.
        fixation: number of the fixation; -1 is the last.
        image: `(3, H, W)`, RGB in [0, 1]; None takes the scanpath's own.
        view: the foveated photograph `(3, h, w)`, of any size; None takes the scanpath's own.
        boxes: `(M, 4)`, true boxes of the target, drawn dashed.
        axes: three axes to draw in; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: the photograph or the view is neither given nor kept by the scanpath, or there is no such fixation.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
        save_figure(plot_fixation(scanpath, 0), "first.png")
    """
    fixation = check_fixation(scanpath, fixation)
    view = scanpath.views()[fixation] if view is None else view
    return FixationFigure(scanpath, photograph_of(scanpath, image), view, boxes, axes).show(fixation, view)


class FixationFigure:
    """A figure of one fixation that can show other fixations: it is laid out once, and only differences are redrawn.

    Shapes: image `(3, H, W)`, view `(3, h, w)`, boxes `(M, 4)`.
    """

    def __init__(
        self,
        scanpath: Scanpath,
        image: Tensor,
        view: Tensor,
        boxes: Tensor | None = None,
        axes: Sequence[Axes] | None = None,
    ) -> None:
        self.scanpath = scanpath
        height = 4 * image.shape[-2] / image.shape[-1] + 0.3
        self.figure, self.axes = make_figure(1, 3, width=12.6, height=height, layout="compressed", axes=axes)
        path_axes, view_axes, belief_axes = self.axes
        if axes is None:
            # Hidden axes save the layout of ticks, a tenth of the time.
            for panel in self.axes:
                panel.xaxis.set_visible(False)
                panel.yaxis.set_visible(False)
        draw_place(path_axes, scanpath, image, boxes)
        draw_legend(path_axes, annotation_entries(scanpath, boxes))
        self.view = draw_image(view_axes, view, scanpath.grid)
        view_axes.set_title("what the eye sees")
        if scanpath.target is None:
            self.belief = draw_semantic_map(belief_axes, scanpath, 0, image)
        else:
            self.belief = draw_belief(belief_axes, scanpath, 0, None, image)
        # `show` draws the cross of the gaze.
        for line in list(belief_axes.lines):
            line.remove()
        draw_scale(belief_axes, self.belief, "probability")
        path_axes.set_title("fixation 0")
        lay_out(self.figure)
        if axes is None:
            # The layout does not change any more, and computing it again takes as long as drawing.
            self.figure.set_layout_engine("none")
        self.path = path_of(path_axes, scanpath)
        self.changing: list[Artist] = []

    def show(self, fixation: int, view: Tensor) -> Figure:
        """Show a fixation, seen as `view` `(3, h, w)`."""
        path_axes, view_axes, belief_axes = self.axes
        for artist in self.changing:
            artist.remove()
        self.path.show(fixation)
        path_axes.set_title(f"fixation {fixation}")
        self.view.set_data(picture_array(view))
        self.changing = draw_gaze(view_axes, self.scanpath, fixation) + draw_gaze(belief_axes, self.scanpath, fixation)
        self.changing += draw_detections(view_axes, self.scanpath, fixation, MOST_BOXES)
        if self.scanpath.target is None:
            values: Any = most_probable(self.scanpath, fixation)
            belief_axes.set_title(f"semantic map after fixation {fixation}")
            self.changing += write_names(belief_axes, self.scanpath, fixation)
        else:
            values = posterior_of(self.scanpath)[fixation]
            belief_axes.set_title(belief_title(self.scanpath, fixation), parse_math=False)
        self.belief.set_data(cell_table(self.scanpath.grid, values))
        return self.figure

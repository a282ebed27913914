"""Figures of saliency maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import check_shape
from semfov.gaze.saliency.cells import Reduction, cell_saliency
from semfov.viz.drawing import draw_boxes, draw_cells, draw_grid, draw_image, draw_scale
from semfov.viz.style import PROBABILITY, TARGET, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def plot_saliency(
    saliency: Tensor,
    image: Tensor,
    *,
    grid: Grid | None = None,
    reduction: Reduction = "max",
    title: str = "saliency",
    axes: Sequence[Axes] | None = None,
) -> Figure:
    """Plot a photograph, its saliency map and, with a grid, the saliency of the cells.

    The most salient cell is framed.

    Args:
        saliency: `(H, W)`, of any size.
        image: `(3, H, W)`, RGB in [0, 1].
        grid: cells of the photograph; None leaves out the third panel.
        reduction: how the saliency of a cell follows from its pixels (`semfov.saliency.cell_saliency`).
        title: title of the map.
        axes: axes to draw in, two, or three with a grid; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: the saliency is not `(H, W)`, or the number of axes does not fit.

    >>> import torch
    >>> figure = plot_saliency(torch.rand(12, 16), torch.rand(3, 48, 64), grid=Grid(4, 3, (64, 48)))
    """
    check_shape(saliency, "saliency", None, None)
    height, width = image.shape[-2:]
    panels = 2 if grid is None else 3
    size = 3.4 * panels + 0.6, 3.4 * height / width + 0.35
    figure, every = make_figure(1, panels, width=size[0], height=size[1], layout="compressed", axes=axes)
    draw_image(every[0], image, grid or Grid(1, 1, (width, height)))
    every[0].set_title("photograph")
    values = saliency.detach().cpu()
    drawn = every[1].imshow(values.numpy(), extent=(0, width, height, 0), cmap=PROBABILITY, vmin=0)
    every[1].set(xticks=[], yticks=[], title=title)
    draw_scale(every[1], drawn, "")
    if grid is not None:
        cells = cell_saliency(values[None], grid.columns, grid.rows, reduction)[0]
        draw_cells(every[2], grid, cells, cmap=PROBABILITY, vmin=0)
        draw_grid(every[2], grid)
        row, column = divmod(int(cells.argmax()), grid.columns)
        step = grid.extent / grid.extent.new_tensor([grid.columns, grid.rows])
        corner = grid.extent.new_tensor([column, row]) * step
        draw_boxes(every[2], cells.new_tensor([[*corner.tolist(), *(corner + step).tolist()]]), TARGET, width=2.0)
        every[2].set_title(f"{reduction} in each cell")
    return figure

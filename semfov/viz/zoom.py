"""The windows at which an eye looked in a large picture, and the objects that it found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.paths import Record
from semfov.viz.drawing import draw_image, photograph_of
from semfov.viz.labels import LabelBox
from semfov.viz.objects import draw_legend, draw_objects, object_entries
from semfov.viz.style import GAZE, lay_out, make_figure, only, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def plot_zoom_path(path: Record, image: Tensor | None = None, *, ax: Axes | None = None) -> Figure:
    """Plot the windows that were looked at, numbered in their order, and the objects.

    Looks at the whole picture have no window. A legend tells the objects that a closer look or the decision confirmed
    from the others.

    Args:
        path: record of a search or an exploration.
        image: `(3, h, w)`, RGB in [0, 1], the picture in any size; None takes the one that the record kept.
        ax: axes to draw in; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: the picture is neither given nor kept.

    Example::

        path = agent.search("harbour.tif", "person")
        save_figure(plot_zoom_path(path), "path.png")
    """
    image = photograph_of(path, image)
    width, height = path.size
    size = 7.2, 7.2 * height / width + 0.6
    figure, (axes,) = make_figure(1, 1, width=size[0], height=size[1], layout="compressed", given=only(ax))
    draw_image(axes, image, Grid(1, 1, (width, height)))
    taken = draw_windows(axes, path)
    axes.set_title(path.describe(), parse_math=False)
    windows = [(GAZE, "-", "windows of the looks")] if taken else []
    draw_legend(axes, [*windows, *object_entries(path)])
    lay_out(figure)
    draw_objects(axes, path, taken)
    return figure


def draw_windows(axes: Axes, path: Record, last: int | None = None) -> list[LabelBox]:
    """Draw the windows of looks, numbered in their order.

    Args:
        axes: axes that hold the picture.
        path: the record.
        last: number of the last look that is drawn, with a wider frame; None draws all.

    Returns:
        Rectangles of the numbers.
    """
    from matplotlib.patches import Rectangle

    width, height = path.size
    taken: list[tuple[float, float]] = []
    room = 0.025 * width
    for look in path:
        if look.region == (0, 0, width, height) or (last is not None and look.number > last):
            continue
        x1, y1, x2, y2 = look.region
        style: dict[str, Any] = {"fill": False, "edgecolor": GAZE, "linewidth": 2.0 if look.number == last else 0.8}
        axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, **style))
        place = _free(look.region, taken, room)
        taken.append(place)
        axes.text(*place, str(look.number), color="white", fontsize=6, ha="center", va="center",
                  bbox={"facecolor": GAZE, "edgecolor": "none", "pad": 0.8})  # fmt: skip
    return [(x - room / 2, y - room / 2, x + room / 2, y + room / 2) for x, y in taken]


def _free(box: tuple[float, float, float, float], taken: list[tuple[float, float]], room: float) -> tuple[float, float]:
    """Position for the number of a window: the corner farthest from other numbers, or the middle.

    Args:
        box: `(x1, y1, x2, y2)` of the window.
        taken: positions of other numbers.
        room: width that a number needs.

    Returns:
        `(x, y)`.
    """
    x1, y1, x2, y2 = box
    left, right, top, bottom = x1 + room / 2, x2 - room / 2, y1 + room / 2, y2 - room / 2
    places = [(left, top), (right, top), (left, bottom), (right, bottom), ((x1 + x2) / 2, (y1 + y2) / 2)]

    def far(place: tuple[float, float]) -> float:
        # Distances beyond the width of a number count the same, so that the first free corner is taken.
        return min([room, *(max(abs(place[0] - x), abs(place[1] - y)) for x, y in taken)])

    return max(places, key=far)

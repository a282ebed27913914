"""The windows at which an eye looked in a large picture, and the objects that it found."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.paths import FoveaMoment, Record
from semfov.viz.animation import Film, film_or_file
from semfov.viz.drawing import CONFIDENT, Tag, draw_boxes, draw_cross, draw_image, draw_tags, photograph_of
from semfov.viz.labels import LabelBox
from semfov.viz.objects import draw_legend, draw_objects, object_entries
from semfov.viz.style import GAZE, TARGET, lay_out, make_figure, only, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_DETECTIONS = 15  # largest number of detections of a window that are drawn


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
    figure, (axes,) = make_figure(1, 1, width=size[0], height=size[1], layout="compressed", axes=only(ax))
    draw_image(axes, image, Grid(1, 1, (width, height)))
    number_boxes = _draw_windows(axes, path)
    axes.set_title(path.describe(), parse_math=False)
    windows = [(GAZE, "-", "windows of the looks")] if number_boxes else []
    draw_legend(axes, [*windows, *object_entries(path)])
    lay_out(figure)
    draw_objects(axes, path, number_boxes)
    return figure


def _draw_windows(axes: Axes, path: Record, last: int | None = None) -> list[LabelBox]:
    """Draw the windows of looks up to `last` (None: all), numbered; returns the rectangles of the numbers."""
    from matplotlib.patches import Rectangle

    numbers: list[tuple[float, float]] = []
    room = 0.025 * path.size[0]
    for look in path:
        x1, y1, x2, y2 = look.region
        if path.is_whole(look.region) or (last is not None and look.number > last):
            continue
        style: dict[str, Any] = {"fill": False, "edgecolor": GAZE, "linewidth": 2.0 if look.number == last else 0.8}
        axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, **style))
        place = _free(look.region, numbers, room)
        numbers.append(place)
        axes.text(*place, str(look.number), color="white", fontsize=6, ha="center", va="center",
                  bbox={"facecolor": GAZE, "edgecolor": "none", "pad": 0.8})  # fmt: skip
    return [(x - room / 2, y - room / 2, x + room / 2, y + room / 2) for x, y in numbers]


def _free(
    box: tuple[float, float, float, float], numbers: list[tuple[float, float]], room: float
) -> tuple[float, float]:
    """Position `(x, y)` for the number of a window: the corner farthest from other numbers, or the middle."""
    x1, y1, x2, y2 = box
    left, right, top, bottom = x1 + room / 2, x2 - room / 2, y1 + room / 2, y2 - room / 2
    places = [(left, top), (right, top), (left, bottom), (right, bottom), ((x1 + x2) / 2, (y1 + y2) / 2)]

    def far(place: tuple[float, float]) -> float:
        # Distances beyond the width of a number count the same, so that the first free corner is taken.
        return min([room, *(max(abs(place[0] - x), abs(place[1] - y)) for x, y in numbers)])

    return max(places, key=far)


@styled
def plot_moment(moment: FoveaMoment, image: Tensor | None = None, *, ax: Axes | None = None) -> Figure:
    """Plot the point of gaze in a frame, and the objects; image `(3, h, w)`."""
    figure = plot_zoom_path(moment, image, ax=ax)
    axes = figure.axes[0] if ax is None else ax
    draw_cross(axes, moment.fixation)
    return figure


def animate_looks(
    path: Record,
    file: str | PathLike[str] | None = None,
    *,
    image: Tensor | None = None,
    seconds: float = 0.8,
    hold: float = 2.0,
) -> Path | Film:
    """Make a film of a record: for each look the picture with the windows so far, and the window with its detections.

    Shapes: image `(3, h, w)`.
    """
    return film_or_file(path, _frames(path, photograph_of(path, image)), seconds, hold, file)


def _frames(path: Record, image: Tensor) -> Iterator[Figure]:
    width, height = path.size
    high = 4.8 * height / width
    for look in path:
        figure, (whole, window) = make_figure(1, 2, width=4.8 + 1.15 * high, height=high + 0.4, layout="compressed")
        for axes in (whole, window):
            draw_image(axes, image, Grid(1, 1, (width, height)))
        number_boxes = _draw_windows(whole, path, look.number)
        whole.set_title(f"look {look.number}")
        x1, y1, x2, y2 = look.region
        window.set(xlim=(x1, x2), ylim=(y2, y1), title="its window and detections")
        lay_out(figure)
        draw_objects(whole, path, number_boxes, last=look.number, tagged=False)
        detections = look.detections
        sure = detections.confidence[0] >= CONFIDENT
        boxes, labels = detections.boxes[0][sure][:_MOST_DETECTIONS], detections.labels[0][sure].tolist()
        draw_boxes(window, boxes, TARGET)
        tags = [
            Tag(tuple(box), f"{path.classes[label]} {score:.2f}", TARGET)
            for box, label, score in zip(boxes.tolist(), labels, detections.confidence[0][sure].tolist(), strict=False)
        ]
        draw_tags(window, tags, (x2, y2), [])
        yield figure

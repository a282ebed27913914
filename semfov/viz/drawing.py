"""What figures are made of: the photograph, the grid over it, boxes with their labels, the point of gaze."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import check, check_shape
from semfov.scanpath import Scanpath
from semfov.viz.labels import place_labels
from semfov.viz.style import GAZE, OTHER, TARGET

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CONFIDENT = 0.1
"""Detections that are less confident are not drawn."""

_LABEL_POINTS = 6.5


def check_fixation(scanpath: Scanpath, fixation: int) -> int:
    """The number of a fixation, counted from the end where it is negative."""
    count = len(scanpath)
    check(-count <= fixation < count, "fixation", f"one of {count} (or -1 for the last)", fixation)
    return fixation % count


def choose_fixations(scanpath: Scanpath, most: int) -> list[int]:
    """At most so many fixations: the first ones and the last."""
    check(most >= 1, "most", "at least 1", most)
    count = len(scanpath)
    return list(range(count)) if count <= most else [*range(most - 1), count - 1]


def draw_image(axes: Axes, image: Tensor, grid: Grid, dim: float = 0.0) -> None:
    """A photograph or a view of it `(3, h, w)`, of any size, in the frame of the grid, darkened by `dim`.

    Coordinates are pixel edges, not centres, at integers: the frame of boxes and of the grid.
    """
    check_shape(image, "image", 3, None, None)
    width, height = grid.extent.tolist()
    pixels = image.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy() * (1 - dim)
    axes.imshow(pixels, extent=(0, width, height, 0), interpolation="bilinear")
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])


def draw_cells(axes: Axes, grid: Grid, values: Tensor, *, alpha: float = 1.0, **style: Any) -> None:
    """A value of every cell `(X·Y,)` as a colour."""
    width, height = grid.extent.tolist()
    table = values.detach().cpu().reshape(grid.rows, grid.columns).numpy()
    axes.imshow(table, extent=(0, width, height, 0), alpha=alpha, interpolation="nearest", **style)
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])


def draw_grid(axes: Axes, grid: Grid) -> None:
    """The borders of the cells."""
    width, height = grid.extent.tolist()
    style: dict[str, Any] = {"color": "white", "linewidth": 0.4, "alpha": 0.45}
    for column in range(1, grid.columns):
        axes.axvline(column * width / grid.columns, **style)
    for row in range(1, grid.rows):
        axes.axhline(row * height / grid.rows, **style)


def draw_boxes(axes: Axes, boxes: Tensor, colour: str, line: str = "-", width: float = 1.2) -> None:
    """Outlines of boxes `(M, 4)`."""
    from matplotlib.patches import Rectangle

    for x1, y1, x2, y2 in boxes.tolist():
        style: dict[str, Any] = {"edgecolor": colour, "linestyle": line, "linewidth": width}
        axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, **style))


def draw_gaze(axes: Axes, scanpath: Scanpath, fixation: int) -> None:
    """A cross where the gaze is."""
    x, y = (scanpath.fixations[fixation].cpu() + 0.5).tolist()
    axes.plot(x, y, "+", color="white", markersize=11, markeredgewidth=2.8, zorder=5)
    axes.plot(x, y, "+", color=GAZE, markersize=10, markeredgewidth=1.4, zorder=5)


def draw_detections(axes: Axes, scanpath: Scanpath, fixation: int, most: int = 6, kept_free: int = 1) -> None:
    """The most confident detections of a look, each labelled by its best class that is not background.

    Labels leave the point of gaze free, and those of the `kept_free` fixations up to it.
    """
    detections = scanpath.detections[fixation]
    sure = detections.confidence[0] >= CONFIDENT
    boxes = detections.boxes[0][sure][:most].cpu()
    labels = detections.labels[0][sure][:most].tolist()
    scores = detections.confidence[0][sure][:most].tolist()
    texts = [f"{scanpath.classes[label]} {score:.2f}" for label, score in zip(labels, scores, strict=True)]
    frame = tuple(scanpath.grid.extent.tolist())
    sizes = [_text_size(axes, text) for text in texts]
    reach = 8 * _per_point(axes)
    points = (scanpath.fixations[: fixation + 1][-kept_free:].cpu() + 0.5).tolist()
    marks = [(x - reach, y - reach, x + reach, y + reach) for x, y in points]
    places = place_labels([tuple(box) for box in boxes.tolist()], sizes, frame, marks)
    for box, label, text, (x, y, _, _) in zip(boxes, labels, texts, places, strict=True):
        colour = TARGET if label == scanpath.target else OTHER
        draw_boxes(axes, box[None], colour)
        axes.text(
            x,
            y,
            text,
            color="white" if colour == TARGET else "black",
            fontsize=_LABEL_POINTS,
            va="top",
            clip_on=True,
            zorder=4,
            bbox={"facecolor": colour, "edgecolor": "none", "pad": 0.8, "alpha": 0.9},
        )


def _text_size(axes: Axes, text: str) -> tuple[float, float]:
    """About the `(width, height)` of a label in the units of axes that are laid out."""
    from matplotlib.textpath import TextPath

    points = TextPath((0, 0), text, size=_LABEL_POINTS).get_extents().width + 3
    scale = _per_point(axes)
    return points * scale, (_LABEL_POINTS * 1.2 + 2.5) * scale


def _per_point(axes: Axes) -> float:
    """How many units of the axes make a point, once the figure is laid out."""
    box = axes.get_window_extent()
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    # A picture keeps its proportions, so one scale serves both directions.
    return max(abs(right - left) / box.width, abs(top - bottom) / box.height) * axes.figure.dpi / 72

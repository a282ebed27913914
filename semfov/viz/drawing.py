"""Parts of figures: photograph, grid, values of cells, boxes with labels, and the point of gaze."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.data.inputs import ImageLike, as_image
from semfov.detection.detections import Detections
from semfov.errors import InputError, check, check_shape
from semfov.paths import Record
from semfov.viz.labels import LabelBox, place_labels
from semfov.viz.style import GAZE, OTHER, TARGET, make_figure, overlay_colours, root

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage
    from matplotlib.typing import ColorType

_LABEL = 6.5  # font size of the labels of boxes
_SMALL = 5.0  # font size of the labels of many boxes
_LUMA = (0.299, 0.587, 0.114)  # shares of red, green and blue in the luma of Rec. 601


class Tag(NamedTuple):
    """Label of a box: the box, the text, and the colour of both."""

    box: LabelBox
    text: str
    colour: str


def photograph_of(record: Record | Fixations, image: ImageLike | None) -> Tensor:
    """Return the given picture, or the one that the record kept.

    Args:
        record: the record; fixations of people keep no picture.
        image: a picture of any common kind; None takes the record's.

    Returns:
        `(3, h, w)`, RGB in [0, 1].

    Raises:
        InputError: the picture is neither given nor kept.
    """
    if image is not None:
        return as_image(image)
    photograph = record.image if isinstance(record, Record) else None
    if photograph is None:
        raise InputError(f"image: expected the photograph, as the {type(record).__name__.lower()} kept none, got None")
    return photograph


def check_fixation(count: int, fixation: int) -> int:
    """Return the number of one of some looks; negative numbers count from the end."""
    check(-count <= fixation < count, "fixation", f"a number from 0 to {count - 1}, or -1 for the last", fixation)
    return fixation % count


def check_foveal(record: Record) -> None:
    """Raise `InputError` where a record has no belief over cells."""
    got = f"{type(record).__name__} ({record.how})"
    check(record.kind.grid, "scanpath", 'the record of a fovea, as how="fovea" makes it', got)


def choose_fixations(record: Record, most: int) -> list[int]:
    """List the numbers of at most `most` fixations: the first ones and the last."""
    check(most >= 1, "most", "at least 1", most)
    count = len(record.fixated)
    return list(range(count)) if count <= most else [*range(most - 1), count - 1]


def draw_image(axes: Axes, image: Tensor, grid: Grid, *, grey: bool = False) -> AxesImage:
    """Draw a photograph or a view of it, of any size, in the coordinates of the grid; image `(3, h, w)`."""
    width, height = grid.extent.tolist()
    drawn = axes.imshow(picture_array(image, grey=grey), extent=(0, width, height, 0), interpolation="bilinear")
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    return drawn


def picture_array(image: Tensor, *, grey: bool = False) -> NDArray[np.float32]:
    """Convert a picture `(3, h, w)` to an array `(h, w, 3)` for matplotlib; grey is the luma of Rec. 601."""
    check_shape(image, "image", 3, None, None)
    pixels = image.detach().cpu().clamp(0, 1)
    if grey:  # in three channels, since matplotlib would give one channel the colours of a map
        pixels = (pixels * pixels.new_tensor(_LUMA)[:, None, None]).sum(0).clamp(0, 1).expand(3, -1, -1)
    return pixels.permute(1, 2, 0).numpy()


def draw_grey(axes: Axes, image: Tensor | None, grid: Grid) -> None:
    """Draw a photograph `(3, H, W)` in grey, on which colours stand out; nothing where there is none."""
    if image is not None:
        draw_image(axes, image, grid, grey=True)


def make_panels(
    count: int, columns: int, size: Callable[[int, int], tuple[float, float]], axes: Sequence[Axes] | None
) -> list[Axes]:
    """Make a figure with panels in rows of some columns, or use the given axes.

    Args:
        count: number of panels.
        columns: largest number of panels in a row; given axes count as one row.
        size: computes `(width, height)` of the figure in inches from the numbers of rows and columns.
        axes: axes to use, one for each panel; None makes them.

    Returns:
        The panels, row by row.

    Raises:
        InputError: there is no column, or there are too few or too many axes.
    """
    check(columns >= 1, "columns", "at least 1", columns)
    columns = count if axes is not None else min(columns, count)
    rows = -(-count // columns)  # rounded up
    width, height = size(rows, columns)
    _, panels = make_figure(rows, columns, width, height, layout="compressed", axes=axes)
    for panel in panels[count:]:  # the end of the last row
        panel.remove()
    return panels[:count]


def draw_cells(axes: Axes, grid: Grid, values: Tensor, *, alpha: float | None = None, **style: Any) -> AxesImage:
    """Draw a value of every cell `(X·Y,)` as a colour; without a style a probability over a picture, clear at 0."""
    width, height = grid.extent.tolist()
    style = style or {"cmap": overlay_colours(), "vmin": 0, "vmax": 1}
    table = values.detach().cpu().reshape(grid.rows, grid.columns).numpy()
    drawn = axes.imshow(table, extent=(0, width, height, 0), alpha=alpha, interpolation="nearest", **style)
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    return drawn


def draw_scale(axes: Axes | list[Axes], drawn: AxesImage, label: str) -> None:
    """Draw the colour bar of an image. Its ticks have few digits, because the layout leaves no room for more."""
    from matplotlib.ticker import MaxNLocator

    first = axes[0] if isinstance(axes, list) else axes
    root(first).colorbar(drawn, ax=axes, label=label, shrink=0.85, ticks=MaxNLocator(5, steps=[1, 2, 5, 10]))


def draw_grid(axes: Axes, grid: Grid) -> None:
    """Draw the borders between the cells of a grid."""
    from matplotlib.collections import LineCollection

    width, height = grid.extent.tolist()
    between_columns = [n * width / grid.columns for n in range(1, grid.columns)]
    between_rows = [n * height / grid.rows for n in range(1, grid.rows)]
    lines = [[(x, 0), (x, height)] for x in between_columns]
    lines += [[(0, y), (width, y)] for y in between_rows]
    axes.add_collection(LineCollection(lines, colors="white", linewidths=0.4, alpha=0.45), autolim=False)


def draw_boxes(axes: Axes, boxes: Tensor, colour: str, line: str = "-", width: float = 1.2) -> list[Artist]:
    """Draw the outlines of boxes `(M, 4)`."""
    from matplotlib.patches import Rectangle

    outlines = [
        Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=colour, linestyle=line, linewidth=width)
        for x1, y1, x2, y2 in boxes.tolist()
    ]
    return [axes.add_patch(outline) for outline in outlines]


def draw_cross(axes: Axes, point: Tensor | Sequence[float]) -> list[Artist]:
    """Draw a cross at the point of gaze, `(x, y)` in pixels."""
    # From pixel centres at integers to a picture whose corner is at 0.
    x, y = (float(side) + 0.5 for side in point)
    return [
        *axes.plot(x, y, "+", color="white", markersize=11, markeredgewidth=2.8, zorder=5),
        *axes.plot(x, y, "+", color=GAZE, markersize=10, markeredgewidth=1.4, zorder=5),
    ]


def draw_look(
    axes: Axes,
    detections: Detections,
    classes: Sequence[str],
    frame: tuple[float, float],
    *,
    target: int | None = None,
    obstacles: Sequence[LabelBox] = (),
) -> list[Artist]:
    """Draw the detections of a look, each labelled with its best class other than background.

    Args:
        axes: axes that are laid out.
        detections: a batch of one, with boxes in pixels of the view.
        classes: names of the classes, background first.
        frame: `(width, height)` of the view.
        target: class that was searched for, whose detections have their own colour; None for all.
        obstacles: rectangles that no label covers.

    Returns:
        What was drawn.
    """
    tags = []
    drawn: list[Artist] = []
    labels = detections.labels[0].tolist()
    scores = detections.confidence[0].tolist()
    for box, label, score in zip(detections.boxes[0], labels, scores, strict=True):
        colour = TARGET if label == target else OTHER
        x1, y1, x2, y2 = box.tolist()
        tags.append(Tag((x1, y1, x2, y2), f"{classes[label]} {score:.2f}", colour))
        drawn += draw_boxes(axes, box[None], colour)
    return [*drawn, *draw_tags(axes, tags, frame, obstacles)]


def draw_tags(
    axes: Axes,
    tags: Sequence[Tag],
    frame: tuple[float, float],
    obstacles: Sequence[LabelBox],
    *,
    many: bool = False,
) -> list[Artist]:
    """Write the labels of boxes, so that none covers another.

    Args:
        axes: axes that are laid out.
        tags: the labels.
        frame: `(width, height)` of the picture.
        obstacles: rectangles that no label covers.
        many: whether to write small.

    Returns:
        What was drawn.
    """
    points = _SMALL if many else _LABEL
    sizes = [text_size(axes, tag.text, points) for tag in tags]
    places = place_labels([tag.box for tag in tags], sizes, frame, obstacles)
    inset = per_point(axes)
    return [
        axes.text(
            left + inset,
            top + inset,
            tag.text,
            color="white" if lightness(tag.colour) < 0.5 else "black",
            fontsize=points,
            va="top",
            clip_on=True,
            parse_math=False,
            zorder=4,
            bbox={"facecolor": tag.colour, "edgecolor": "none", "pad": 0.8, "alpha": 0.9},
        )
        for tag, (left, top, _, _) in zip(tags, places, strict=True)
    ]


def text_size(axes: Axes, text: str, points: float) -> tuple[float, float]:
    """Approximate `(width, height)` of a label in units of axes that are laid out."""
    scale = per_point(axes)
    # Letters that are fitted to the pixels of a screen take up to a twentieth more.
    return (1.05 * _text_width(text) * points + 4) * scale, (points * 1.2 + 3.5) * scale


@lru_cache(1024)
def _text_width(text: str) -> float:
    """Width of a text for a font size of 1."""
    from matplotlib.textpath import TextPath

    # An empty path has no extents. Dollar signs are replaced, because matplotlib would typeset a formula.
    return float(TextPath((0, 0), text.replace("$", "S"), size=1).get_extents().width) if text.strip() else 0.0


def per_point(axes: Axes) -> float:
    """Measure the number of units of the axes in a point, once the figure is laid out."""
    box = axes.get_window_extent()
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    # A picture keeps its proportions, so one scale serves both directions.
    return max(abs(right - left) / box.width, abs(top - bottom) / box.height) * root(axes).dpi / 72


def lightness(colour: ColorType) -> float:
    """Luma of a colour by Rec. 601, from 0 to 1."""
    from matplotlib.colors import to_rgb

    return float(torch.tensor(to_rgb(colour)) @ torch.tensor(_LUMA))

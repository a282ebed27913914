"""The windows at which an eye looked in a large picture, and the objects that it found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.paths import ZoomPath
from semfov.viz.drawing import photograph_of
from semfov.viz.style import FOUND, GAZE, TARGET, make_figure, only, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def plot_zoom_path(
    path: ZoomPath, image: Tensor | None = None, *, score: float = 0.1, ax: Axes | None = None
) -> Figure:
    """Plot the windows that were looked at, numbered in their order, and the objects that were found.

    The first look, at the whole picture, is not drawn. Objects have names where all classes were looked for.

    Args:
        path: record of a search or an exploration.
        image: `(3, h, w)`, RGB in [0, 1], the picture in any size; it must be given.
        score: least score of the objects that are drawn.
        ax: axes to draw in; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: the picture is not given.

    Example::

        path = agent.search("harbour.tif", "person")
        save_figure(plot_zoom_path(path, semfov.as_image("harbour_small.jpg")), "path.png")
    """
    from matplotlib.patches import Rectangle

    image = photograph_of(path, image)
    width, height = path.lattice.size
    size = 7.2, 7.2 * height / width + 0.3
    figure, (axes,) = make_figure(1, 1, width=size[0], height=size[1], layout="compressed", given=only(ax))
    pixels = image.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy()
    axes.imshow(pixels, extent=(0, width, height, 0), interpolation="bilinear")
    taken: list[tuple[float, float]] = []
    for number, glance in enumerate(path.glances):
        if number == 0:
            continue
        box = path.region(number)
        x1, y1, x2, y2 = box
        line: dict[str, Any] = {"fill": False, "edgecolor": GAZE, "linewidth": 0.8 + 0.5 * (glance.window.level == 1)}
        axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, **line))
        place = _free(box, taken, 0.025 * width)
        taken.append(place)
        axes.text(*place, str(number), color="white", fontsize=6, ha="center", va="center",
                  bbox={"facecolor": GAZE, "edgecolor": "none", "pad": 0.8})  # fmt: skip
    kept = path.objects.above(score)
    for (x1, y1, x2, y2), label in zip(kept.boxes.tolist(), kept.labels.tolist(), strict=True):
        colour = TARGET if label == path.target else FOUND
        axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=colour, linewidth=1.0))
        if path.target is None:
            axes.text(x1, y2, path.classes[label], color="white", fontsize=5, parse_math=False, va="top", clip_on=True,
                      bbox={"facecolor": colour, "edgecolor": "none", "pad": 0.5})  # fmt: skip
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    axes.set_title(path.describe(), parse_math=False)
    return figure


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

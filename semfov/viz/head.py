"""Figures and films of eye and head in a scene."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from semfov.data.inputs import ImageLike, as_image
from semfov.detection.placement import resize
from semfov.errors import check
from semfov.head.scenes import Panorama
from semfov.paths import HeadPath
from semfov.viz.animation import Film, film_or_file
from semfov.viz.drawing import draw_image, photograph_of, picture_array
from semfov.viz.objects import draw_legend, draw_objects, object_entries
from semfov.viz.style import GAZE, OTHER, TARGET, lay_out, make_figure, only, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def plot_head_path(
    path: HeadPath, image: ImageLike | None = None, *, looks: int | None = None, ax: Axes | None = None
) -> Figure:
    """Plot the windows that the head turned to, the fixations in their order, and the objects that were found."""
    picture = photograph_of(path, None if image is None else as_image(image))
    count = len(path) if looks is None else looks
    check(1 <= count <= len(path), "looks", f"a number from 1 to {len(path)}", count)
    width, height = path.views.world.scene.extent.tolist()
    figure, (axes,) = make_figure(
        1, 1, width=7.2, height=7.2 * height / width + 0.6, layout="compressed", axes=only(ax)
    )
    _draw_path(axes, path, picture, count)
    axes.set_title(path.describe(), parse_math=False)
    draw_legend(axes, [(GAZE, "-", "views of the head"), *object_entries(path)])
    lay_out(figure)
    draw_objects(axes, path, last=count - 1)
    return figure


def _draw_path(axes: Axes, path: HeadPath, image: Tensor, count: int) -> None:
    """Draw the first `count` looks, in pixels of the scene's picture."""
    world = path.views.world
    draw_image(axes, image, world.scene)
    poses = list(dict.fromkeys(action // path.views.cells for action in path.actions[:count]))
    for pose in poses:
        now = pose == path.actions[count - 1] // path.views.cells
        frame = world.places(torch.tensor([[0.0, 0.0, *map(float, world.size)]]), path.views.poses[pose])
        _outline(axes, path, frame, color=GAZE, linewidth=1.6 if now else 0.7, alpha=1.0 if now else 0.6)
    points = torch.stack([world.pixels_of(path.gaze(look)[None])[0] for look in range(count)]) + 0.5
    for one, other in pairwise(points):
        x, y = _unwrapped(torch.stack([one, other]), path)
        for shift in (0.0, float(world.scene.extent[0])):
            axes.plot(x + shift, y, color=OTHER, linewidth=0.8)
    for number, (x, y) in enumerate(points.tolist()):
        last = number == count - 1
        axes.text(x, y, str(number), color="white", fontsize=7 if last else 5, ha="center", va="center",
                  bbox={"facecolor": TARGET if last else GAZE, "edgecolor": "none", "pad": 0.9,
                        "boxstyle": "circle"})  # fmt: skip


def _outline(axes: Axes, path: HeadPath, places: Any, **style: Any) -> None:
    """Draw the border of a region of the scene; one that crosses the seam of a panorama is drawn at both ends."""
    world = path.views.world
    if hasattr(places, "outlines"):
        points = world.pixels_of(places.outlines()[0]) + 0.5
    else:
        x1, y1, x2, y2 = places.boxes[0].tolist()
        points = torch.tensor([[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]])
    x, y = _unwrapped(points, path)
    wide = float(world.scene.extent[0])
    for shift in (-wide, 0.0, wide):
        axes.plot(x + shift, y, scalex=False, scaley=False, **style)


def _unwrapped(points: Tensor, path: HeadPath) -> tuple[Any, Any]:
    """Coordinates x and y of a line, made continuous across the seam of a panorama."""
    x, y = points.unbind(-1)
    if path.views.gaze.shape[-1] == 3:
        wide = float(path.views.world.scene.extent[0])
        step = (x.diff() + wide / 2) % wide - wide / 2
        x = torch.cat([x[:1], x[:1] + step.cumsum(0)])
    return x.numpy(), y.numpy()


def animate_head(
    path: HeadPath,
    file: str | PathLike[str] | None = None,
    *,
    image: ImageLike | None = None,
    seconds: float = 0.8,
    hold: float = 2.0,
) -> Path | Film:
    """Make a film of eye and head: for each look the scene with the windows so far, the view, and the belief."""
    picture = photograph_of(path, None if image is None else as_image(image))
    return film_or_file(path, _frames(path, picture), seconds, hold, file)


def _frames(path: HeadPath, image: Tensor) -> Iterator[Any]:
    from matplotlib.figure import Figure

    world = path.views.world
    width, height = world.scene.extent.tolist()
    high = 7.2 * height / width
    views = head_views(path, image)
    for look, action in enumerate(path.actions):
        figure = Figure(figsize=(7.2, high + 3.1), layout="constrained")
        halves: Any = figure.subfigures(2, 1, height_ratios=[high, 2.9])
        above, below = halves
        axes = above.subplots()
        _draw_path(axes, path, image, look + 1)
        axes.set_title(f"look {look}, {path.seconds[look]:.1f} s")
        draw_objects(axes, path, last=look, tagged=False)
        left, right = below.subplots(1, 2, width_ratios=[1, 1.25])
        left.imshow(picture_array(next(views)))
        x, y = path.views.view_grid.centres[action % path.views.cells].tolist()
        left.plot([x], [y], marker="+", markersize=14, color=TARGET, markeredgewidth=2)
        left.set(xticks=[], yticks=[], title="what the head sees")
        cells = path.maps[look].view(world.scene.rows, world.scene.columns).numpy()
        right.imshow(cells, extent=(0, width, height, 0), vmin=0, vmax=1, cmap="viridis")
        what = "any object" if path.target is None else path.classes[path.target]
        right.set(xticks=[], yticks=[], title=f"P({what})")
        yield figure


def head_views(path: HeadPath, image: Tensor) -> Iterator[Tensor]:
    """Render what the head saw in each look, `(3, h, w)`, from a picture `(3, H, W)` of the scene in any size."""
    world, (width, height) = path.views.world, path.size
    if world.closed:
        # Poses are angles, which do not depend on the size of the picture.
        scene = Panorama(image[..., : image.shape[-1] // 2 * 2], world.size, reach=90)
        yield from (scene.view(path.pose(look))[0] for look in range(len(path)))
        return
    across, down = image.shape[-1] / width, image.shape[-2] / height
    for look in range(len(path)):
        x1, y1, x2, y2 = path.region(look)
        left, top = min(round(x1 * across), image.shape[-1] - 1), min(round(y1 * down), image.shape[-2] - 1)
        right, bottom = max(round(x2 * across), left + 1), max(round(y2 * down), top + 1)
        yield resize(image[None, :, top:bottom, left:right], world.size)[0].clamp(0, 1)

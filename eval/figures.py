"""Draw the figures of the paper that show a photograph: `python -m eval.figures`.

    python -m eval.figures
    python -m eval.figures --picture desk.jpg --target book --start [2,7] --detector.name yolox-nano

Without a photograph it draws an embedded scene. The files have the names of the figures in the source of the paper
(docs/method.md has the list). Curves and tables are those of `python -m eval.results`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from eval.comparison.saliency import open_at_reference
from eval.comparison.settings import SaliencyConfig
from semfov import ActivePerception, Scanpath
from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic
from semfov.data.inputs import as_image
from semfov.data.scenes import EmbeddedScenes
from semfov.detection.detections import Detections
from semfov.eye import Eye
from semfov.gaze.choice import select_fixation
from semfov.gaze.policies import Policy
from semfov.gaze.saliency import VOCUS2, cell_saliency
from semfov.io.ranges import Shifts, Side
from semfov.observation.matching import box_iou
from semfov.paths.look import confident_detections
from semfov.runs.command import command
from semfov.runs.config import DetectorConfig, SensorConfig
from semfov.runs.settings import Settings
from semfov.runs.setup import make_eye, make_observation
from semfov.runs.store import look_everywhere
from semfov.sensor.named import SensorName, named_sensor
from semfov.viz import plot_belief_bars, plot_foveated_strip
from semfov.viz.drawing import (
    Tag,
    choose_fixations,
    draw_boxes,
    draw_cells,
    draw_cross,
    draw_image,
    draw_look,
    draw_scale,
    draw_tags,
)
from semfov.viz.path import GazePath, LookPath
from semfov.viz.style import FOUND, GAZE, OTHER, PROBABILITY, lay_out, make_figure, save_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST = 12
"""Largest number of detections in a picture."""
LOOKS = 4
"""Looks before the map of saliency is drawn, and fixations of the example of a search, as in the paper."""
_SAME_OBJECT = 0.5
"""Intersection over union from which on two detections are of one object."""


@dataclass(frozen=True)
class _FiguresConfig(Settings):
    """What the figures show.

    Args:
        picture: a photograph (None: an embedded scene).
        target: class that the example of a search searches for.
        start: `[column, row]` of the cell that is fixated first.
        shifts: largest number of gaze shifts of the search.
        detector: the detector.
        model: observation model, by name or file (None: the one fitted by maximum likelihood for the detector).
        grid: `[columns, rows]` of the belief.
        out: folder of the figures.
    """

    picture: Path | None = None
    target: str = "cup"
    start: tuple[int, int] = (5, 5)
    shifts: Shifts = 9
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    model: str | None = None
    grid: tuple[Side, Side] = (10, 10)
    out: Path = Path("runs/figures")


@dataclass(frozen=True)
class Example:
    """A photograph, and a search in it.

    Shapes: image `(3, H, W)`.
    """

    eye: Eye
    image: Tensor
    scanpath: Scanpath

    @property
    def grid(self) -> Grid:
        """The cells of the photograph."""
        return self.scanpath.grid

    @property
    def frame(self) -> tuple[float, float]:
        """Width and height of the photograph."""
        return self.image.shape[-1], self.image.shape[-2]

    @property
    def fixation(self) -> Tensor:
        """The first fixation, `(2,)`."""
        return self.scanpath.fixations[0]

    def foveated(self, sensor: SensorName, fixation: Tensor) -> Tensor:
        """Return the photograph at its own resolution, through a named sensor, `(3, H, W)`."""
        fovea = named_sensor(sensor)
        state = fovea.open(self.image[None], torch.full((2,), max(self.frame) / self.eye.reference))
        return fovea.picture(state, fixation[None])[0]

    def pictures(self, rows: int, columns: int, width: float) -> tuple[Figure, list[Axes]]:
        """Make a figure with places for the photograph, each `width` inches wide."""
        height = width * self.frame[1] / self.frame[0] + 0.25
        return make_figure(rows, columns, width * columns, height * rows, layout="compressed")


def figures(config: _FiguresConfig) -> None:
    """Draw all figures and print their files."""
    with torch.inference_mode():
        example = _search_example(config)
        for name, draw in _FIGURES.items():
            print(f"{name}: ", end="")
            figure = draw(example)
            print(
                "no object here changes its class"
                if figure is None
                else save_figure(figure, config.out / f"{name}.png")
            )


def _search_example(config: _FiguresConfig) -> Example:
    """Search the photograph as published: calibrated scores, and predictive search."""
    sensor = SensorConfig(name="published")
    eye = make_eye(config.detector, sensor)
    model = make_observation(config.model, eye)
    observer = Semantic(len(eye.detector.classes) + 1, model)
    agent = ActivePerception(
        eye, (observer, Policy("predictive", model)), (observer, Policy("kl", model)), grid=config.grid
    )
    image = EmbeddedScenes(eye.detector.classes[1:])[0].image if config.picture is None else as_image(config.picture)
    scanpath = agent.search(image, config.target, how="fovea", start=config.start, shifts=config.shifts)
    assert isinstance(scanpath, Scanpath)
    return Example(eye, image, scanpath)


@styled
def foveal_reconstruction(example: Example) -> Figure:
    """Draw the photograph, and its foveal images with the wider and the narrower fovea."""
    images = {"photograph": example.image}
    foveae: dict[str, SensorName] = {"fov100": "published", "fov50": "published-narrow"}
    for name, sensor in foveae.items():
        images[name] = example.foveated(sensor, example.fixation)
    figure, axes = example.pictures(1, 3, 3.2)
    for panel, (title, image) in zip(axes, images.items(), strict=True):
        draw_image(panel, image, example.grid)
        panel.set_title(title)
    return figure


@styled
def detection_example(example: Example) -> Figure:
    """Draw what the detector sees in the photograph, above what it sees in the foveal image."""
    figure, axes = example.pictures(2, 1, 4.6)
    foveal = example.foveated("published", example.fixation)
    looks = [example.eye.detector(example.image[None]), example.scanpath.detections[0]]
    for panel, image, title in zip(axes, (example.image, foveal), ("regular", "foveated"), strict=True):
        draw_image(panel, image, example.grid)
        panel.set_title(title)
    draw_cross(axes[1], example.fixation)
    lay_out(figure)
    for panel, look in zip(axes, looks, strict=True):
        draw_look(
            panel,
            confident_detections(look, MOST),
            example.scanpath.classes,
            example.frame,
            target=example.scanpath.target,
        )
    return figure


@styled
def _foveal_scene(example: Example) -> Figure:
    """Draw the foveal image and the distance of the centre of each box from the fovea, in longer sides."""
    figure, (axes,) = example.pictures(1, 1, 5.4)
    draw_image(axes, example.foveated("published", example.fixation), example.grid)
    detections = confident_detections(example.scanpath.detections[0], MOST)
    boxes = detections.boxes[0]
    middles = (boxes[:, :2] + boxes[:, 2:]) / 2
    x, y = (example.fixation + 0.5).tolist()
    for middle in middles.tolist():
        axes.plot([x, middle[0]], [y, middle[1]], color="white", linewidth=2.2)
        axes.plot([x, middle[0]], [y, middle[1]], "o-", color=GAZE, linewidth=1.1, markersize=2.5)
    draw_cross(axes, example.fixation)
    draw_boxes(axes, boxes, OTHER)
    lay_out(figure)
    distances = example.grid.box_distance(boxes, example.fixation).tolist()
    names = [example.scanpath.classes[label] for label in detections.labels[0].tolist()]
    tags = [
        Tag((x1, y1, x2, y2), f"{name}, d = {distance:.2f}", OTHER)
        for (x1, y1, x2, y2), name, distance in zip(boxes.tolist(), names, distances, strict=True)
    ]
    draw_tags(axes, tags, example.frame, [])
    return figure


def ambiguities(example: Example) -> Figure | None:
    """Draw an object whose class changes when it is seen from afar; None if there is none."""
    sharp = confident_detections(example.eye.detector(example.image[None]), MOST)
    everywhere = look_everywhere(example.eye, lambda: example.image[None], example.grid, None, str)
    pair = ambiguous(
        sharp, [confident_detections(everywhere[cell : cell + 1], MOST) for cell in range(len(example.grid))]
    )
    if pair is None:
        return None
    before, cell, after = pair
    return _ambiguity(example, before, after, example.grid.centres[cell])


def ambiguous(sharp: Detections, looks: Sequence[Detections]) -> tuple[Detections, int, Detections] | None:
    """Find the two detections of one object that differ in class, of which the less confident is most confident."""
    best = 0.0
    pair = None
    for number, look in enumerate(looks):
        same = box_iou(sharp.boxes[0], look.boxes[0]) >= _SAME_OBJECT
        other = sharp.labels[0][:, None] != look.labels[0][None]
        sure = torch.minimum(sharp.confidence[0][:, None], look.confidence[0][None]) * (same & other)
        if sure.numel() and float(sure.max()) > best:
            best = float(sure.max())
            first, second = divmod(int(sure.argmax()), sure.shape[1])
            pair = _only(sharp, first), number, _only(look, second)
    return pair


@styled
def _ambiguity(example: Example, before: Detections, after: Detections, fixation: Tensor) -> Figure:
    """Draw a detection in the photograph, beside one in the foveal image of a fixation."""
    figure, axes = example.pictures(1, 2, 4.2)
    draw_image(axes[0], example.image, example.grid)
    axes[0].set_title("regular")
    draw_image(axes[1], example.foveated("published", fixation), example.grid)
    draw_cross(axes[1], fixation)
    axes[1].set_title("foveated")
    lay_out(figure)
    for panel, detections in zip(axes, (before, after), strict=True):
        draw_look(panel, detections, example.scanpath.classes, example.frame)
    return figure


def _only(detections: Detections, number: int) -> Detections:
    """Take one detection of a look."""
    return detections.take(slice(number, number + 1))


@styled
def grid_example(example: Example) -> Figure:
    """Draw the cells of the map: the fixated one, and those that its detections of a score of 0.1 or more update."""
    from matplotlib.colors import ListedColormap

    figure, (axes,) = example.pictures(1, 1, 5.4)
    grid = example.grid
    detections = confident_detections(example.scanpath.detections[0], MOST)
    draw_image(axes, example.foveated("published", example.fixation), grid)
    updated = grid.footprint(detections.boxes[0]).any(0)
    draw_cells(axes, grid, updated.float().masked_fill(~updated, torch.nan), cmap=ListedColormap([GAZE]), alpha=0.45)
    draw_boxes(axes, grid.edges, "red", width=0.6)
    draw_boxes(axes, grid.edges[example.scanpath.cells[:1]], FOUND, width=3)
    return figure


@styled
def saliency_example(example: Example) -> Figure:
    """Draw the foveal image after a few looks, and its saliency by VOCUS2, which is 0 in visited cells."""
    grid = example.grid
    model = VOCUS2()
    reduction = SaliencyConfig().reduction
    state, points = open_at_reference(example.eye.sensor, example.eye.reference, example.image, grid.centres)
    visited = torch.zeros(1, len(grid), dtype=torch.bool)
    cells = [int(example.scanpath.cells[0])]
    for _ in range(LOOKS):
        view = example.eye.sensor.picture(state, points[cells[-1]][None])
        saliency = model(view)
        visited[0, cells[-1]] = True
        values = cell_saliency(saliency, grid.columns, grid.rows, reduction)
        cells.append(int(select_fixation(values, visited, torch.zeros_like(values))))
    height, width = saliency.shape[-2:]
    pixels = torch.cartesian_prod(torch.arange(height), torch.arange(width)).flip(-1).float()
    visited_pixels = visited[0, Grid(grid.columns, grid.rows, (width, height)).cell_of(pixels)].reshape(height, width)
    figure, axes = example.pictures(1, 2, 4.2)
    draw_image(axes[0], view[0], Grid(1, 1, (width, height)))
    axes[0].set_title("foveal image")
    shown = saliency[0].masked_fill(visited_pixels, 0).numpy()
    drawn = axes[1].imshow(shown, extent=(0, width, height, 0), cmap=PROBABILITY, vmin=0)
    axes[1].set(xticks=[], yticks=[], title=f"VOCUS2 after {LOOKS} looks")
    draw_scale(axes[1], drawn, "")
    lay_out(figure)
    fixations = grid.centres[cells[:LOOKS]]
    for panel, frame in zip(axes, (example.frame, (width, height)), strict=True):
        ratio = fixations.new_tensor(frame) / fixations.new_tensor(example.frame)
        GazePath(panel, ((fixations + 0.5) * ratio - 0.5).double().numpy(), frame, found=False)
    return figure


@styled
def _search_in_steps(example: Example) -> Figure:
    """Fixations of a search with what is detected at each, above the probability of the target in every cell."""
    from matplotlib.figure import Figure

    scanpath, count = example.scanpath, min(LOOKS, len(example.scanpath))
    # The layout engines of matplotlib give axes in 3D no room beside others.
    figure = Figure(figsize=(3.3 * count, 5.6))
    figure.subplots_adjust(left=0.01, right=0.96, top=0.95, bottom=0.03, wspace=0.08, hspace=0.1)
    above = [figure.add_subplot(2, count, n + 1) for n in range(count)]
    below = [figure.add_subplot(2, count, count + n + 1, projection="3d") for n in range(count)]
    plot_foveated_strip(scanpath, most=count, axes=above)
    plot_belief_bars(scanpath, most=count, axes=below)
    lay_out(figure)
    for panel, fixation in zip(above, choose_fixations(scanpath, count), strict=True):
        LookPath(panel, scanpath).show(fixation)
    return figure


_FIGURES: dict[str, Callable[[Example], Figure | None]] = {
    "detection_example": detection_example,
    "foveal_reconstruction": foveal_reconstruction,
    "map": _foveal_scene,
    "ambiguities": ambiguities,
    "grid_example": grid_example,
    "saliency_example": saliency_example,
    "vsexample": _search_in_steps,
}
"""The figures by their labels in the source of the paper."""


main = command(figures, _FiguresConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())

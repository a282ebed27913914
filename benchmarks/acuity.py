"""Acuity of sensors by distance from the fixation, and recall of a detector behind them.

    python -m benchmarks.acuity                                               # embedded scenes
    python -m benchmarks.acuity --root DIR --annotations FILE --count 60 --detector yolox-nano --weights FILE

The first table gives the finest grating that keeps half of its contrast. The second gives the round trip: the
signal-to-noise ratio of the detector's input with the sensor, relative to its input without a sensor. The third gives
the recall of objects by the distance of their centre from the fixation. Distances and wavelengths are in pixels of a
picture whose longer side is 640.
"""

import argparse
import math
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.tables import table
from semfov.data.coco import CocoScenes
from semfov.data.scene import Scenes
from semfov.data.scenes import EmbeddedScenes
from semfov.detection.detector import Detector
from semfov.detection.load import load_detector
from semfov.eye import Eye
from semfov.observation.matching import box_iou
from semfov.sensor import Foveation, LogPolar, MultiScaleFovea, Sensor, named_sensor

SIDE = 640
EDGES = (0, 25, 50, 100, 150, 200, 300, 400)
WAVELENGTHS = tuple(2.0 * 2 ** (n / 2) for n in range(2, 15))
SCORE, OVERLAP = 0.1, 0.5


def sensors(fovea: float, spacing: float, pooling: float) -> dict[str, Sensor]:
    """Sensors by their names in tables."""
    return {
        "none": Foveation(1e9),
        **{name: named_sensor(name) for name in ("published", "published-narrow", "gradual")},
        "log-polar": LogPolar(fovea, spacing, pooling),
    }


def contrasts(sensor: Sensor, wavelength: float) -> list[float]:
    """Share of a grating's contrast that a sensor keeps, between each two neighbouring `EDGES`."""
    place = torch.arange(2 * EDGES[-1], dtype=torch.float32) - EDGES[-1]
    phase = place * (2 * math.pi / wavelength)
    wave = torch.stack([phase.cos(), phase.sin(), phase.cos()])[:, None].expand(-1, len(place), -1)
    # Vertical and horizontal gratings. The third channel only serves to make an RGB image for the sensor.
    both = torch.stack([wave, wave.mT])
    views = torch.cat(
        [sensor.look(sensor.open(one[None], torch.ones(2)), torch.full((1, 2), EDGES[-1])) for one in both]
    )
    # A grating that is only weakened keeps its phase, so the products of the two quadratures with the view give its
    # contrast.
    contrast = (views * both)[:, :2].sum(1).mean(0)
    distance = torch.hypot(place[:, None], place)
    return [float(contrast[(distance >= low) & (distance < high)].mean()) for low, high in pairwise(EDGES)]


def finest(sensor: Sensor) -> list[str]:
    """Shortest wavelength from which on all gratings keep half of their contrast, between neighbouring `EDGES`."""
    by_wavelength = [contrasts(sensor, wavelength) for wavelength in WAVELENGTHS]
    texts = []
    for place in range(len(EDGES) - 1):
        lost = [n for n in range(len(WAVELENGTHS)) if by_wavelength[n][place] < 0.5]
        if not lost:
            texts.append(f"≤ {WAVELENGTHS[0]:.0f}")
            continue
        above = lost[-1] + 1
        if above == len(WAVELENGTHS):
            texts.append(f"> {WAVELENGTHS[-1]:.0f}")
            continue
        low, high = by_wavelength[above - 1][place], by_wavelength[above][place]
        share = (0.5 - low) / (high - low)
        texts.append(f"{WAVELENGTHS[above - 1] * (WAVELENGTHS[above] / WAVELENGTHS[above - 1]) ** share:.1f}")
    return texts


def looks(scenes: Scenes, count: int, fixations: int) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Photographs `(1, 3, H, W)`, fixations in them `(F, 2)`, boxes `(M, 4)` and labels `(M,)` of their objects."""
    generator = torch.Generator().manual_seed(0)
    for index in range(min(count, len(scenes))):
        scene = scenes[index]
        size = torch.tensor(scene.size)
        points = torch.rand(fixations, 2, generator=generator) * size - 0.5
        yield scene.image[None], points, scene.boxes, scene.labels


class AcuityCounts:
    """Errors and found objects by distance from the fixation.

    Attributes:
        error: sum of squared differences between the views with and without the sensor.
        pixels: number of values in this sum.
        found: number of objects found.
        objects: number of objects.
        seconds: CPU seconds of the sensor.
        looks: number of looks.
    """

    def __init__(self) -> None:
        bins = len(EDGES) - 1
        self.error, self.pixels, self.found, self.objects = (torch.zeros(bins, dtype=torch.float64) for _ in range(4))
        self.seconds, self.looks = 0.0, 0

    def add(self, eye: Eye, image: Tensor, points: Tensor, boxes: Tensor, labels: Tensor) -> None:
        """Look at a photograph from each fixation, and count."""
        edges = torch.tensor(EDGES[1:-1], dtype=torch.float32)
        view, scale = eye.open(image), SIDE / max(image.shape[-2:])
        middle = (boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5
        left, top = view.placement.offset
        wide, high = (round(n * s) for n, s in zip(view.placement.size, view.placement.scale, strict=True))
        x = (torch.arange(wide) + 0.5) / view.placement.scale[0] - 0.5
        y = (torch.arange(high) + 0.5) / view.placement.scale[1] - 0.5
        for point in points:
            start = time.process_time()
            canvas = eye.foveated(view, point[None])
            self.seconds += time.process_time() - start
            self.looks += 1
            where = torch.hypot(x - point[0], y[:, None] - point[1]).flatten() * scale
            change = (canvas - view.canvas)[0, :, top : top + high, left : left + wide].square().mean(0).flatten()
            place = torch.bucketize(where, edges, right=True)
            near = where < EDGES[-1]
            self.error.index_add_(0, place[near], change[near].double())
            self.pixels.index_add_(0, place[near], torch.ones_like(change[near], dtype=torch.float64))
            detections = eye.detect(view, point[None], canvas)
            hits = box_iou(boxes, detections.boxes[0]) >= OVERLAP
            hits &= detections.scores[0][:, labels].mT >= SCORE
            hits &= (detections.labels[0] == labels[:, None]) & detections.mask[0]
            away = torch.hypot(*(middle - point).unbind(-1)) * scale
            place, near = torch.bucketize(away, edges, right=True), away < EDGES[-1]
            self.found.index_add_(0, place[near], hits.any(-1)[near].double())
            self.objects.index_add_(0, place[near], torch.ones_like(away[near], dtype=torch.float64))


def report(chosen: dict[str, Sensor], detector: Detector, scenes: Scenes, count: int, fixations: int) -> str:
    """Return the report with all tables, as Markdown."""
    bins = [f"{low}–{high}" for low, high in pairwise(EDGES)]
    acuity = [[name, *finest(sensor)] for name, sensor in chosen.items() if name != "none"]
    by_sensor = {name: AcuityCounts() for name in chosen}
    eyes = {name: Eye(sensor, detector).eval().requires_grad_(False) for name, sensor in chosen.items()}
    for image, points, boxes, labels in looks(scenes, count, fixations):
        for name, eye in eyes.items():
            by_sensor[name].add(eye, image, points, boxes, labels)
    noise = [
        [name, *(f"{-10 * math.log10(value):.1f}" for value in (counts.error / counts.pixels).tolist())]
        for name, counts in by_sensor.items()
        if name != "none"
    ]
    recall = []
    for name, counts in by_sensor.items():
        shares = [f"{value:.2f}" for value in (counts.found / counts.objects).tolist()]
        every, cost = float(counts.found.sum() / counts.objects.sum()), 1e3 * counts.seconds / counts.looks
        recall.append([name, *shares, f"{every:.3f}", f"{cost:.1f}"])
    objects = next(iter(by_sensor.values())).objects.long().tolist()
    return "\n\n".join(
        [
            "Wavelength of the finest grating that keeps half of its contrast, by distance from the fixation:",
            table(["", *bins], acuity),
            f"Signal-to-noise ratio of the round trip in dB, {detector.name}'s input, by distance from the fixation:",
            table(["", *bins], noise),
            f"Recall (score {SCORE}, IoU {OVERLAP}) by distance of the object from the fixation, in "
            f"{min(count, len(scenes))} photographs with {fixations} fixations each ({sum(objects)} objects: "
            f"{', '.join(map(str, objects))}); and CPU milliseconds of the sensor per look:",
            table(["", *bins, "all", "ms"], recall),
        ]
    )


def draw(image: Tensor, sensor: LogPolar, path: Path) -> None:
    """Draw a picture `(1, 3, H, W)`, its views through three sensors, and its cortical image side by side."""
    from matplotlib.figure import Figure

    gaze = torch.tensor([image.shape[-1] * 0.4, image.shape[-2] * 0.5])
    cortical, crops = sensor.cortical(image, gaze), MultiScaleFovea(80)
    views = {
        "picture": image,
        "published": named_sensor("published")(image, gaze),
        "log-polar, back-projected": sensor(image, gaze),
        "cortical image": cortical,
        "multi-scale": crops.picture(crops.open(image, torch.ones(2)), gaze[None]),
    }
    figure = Figure(figsize=(17.5, 3.4), layout="constrained")
    for axes, (name, view) in zip(figure.subplots(1, 5), views.items(), strict=True):
        axes.imshow(view[0].clamp(0, 1).movedim(0, -1).numpy())
        axes.set_title(name)
        axes.set_axis_off()
        if view is not cortical:
            axes.plot(*gaze.tolist(), "+", color="white")
    figure.savefig(path, dpi=75)


@torch.inference_mode()
def main() -> None:
    """Measure, and print the report."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.acuity", description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--root", type=Path, help="folder of photographs (none: the embedded scenes)")
    parser.add_argument("--annotations", type=Path, help="annotation file of the photographs, in the COCO format")
    parser.add_argument("--count", type=int, default=8, help="number of photographs")
    parser.add_argument("--fixations", type=int, default=5, help="number of fixations in each photograph")
    parser.add_argument("--detector", default="yolox-nano", help="name or file of the detector")
    parser.add_argument("--weights", help="file of the detector's weights (none: the registered weights)")
    parser.add_argument("--fovea", type=float, default=60.0, help="eccentricity in pixels at which acuity is halved")
    parser.add_argument("--spacing", type=float, default=1.0, help="distance of receptors at the fixation, in pixels")
    parser.add_argument(
        "--pooling", type=float, default=1.0, help="width of receptive fields, in distances of neighbours"
    )
    parser.add_argument("--picture", type=Path, help="file to write for a picture of the views")
    options = parser.parse_args()
    torch.set_num_threads(1)
    detector = load_detector(options.detector, **({} if options.weights is None else {"weights": options.weights}))
    scenes: Scenes = EmbeddedScenes(detector.classes, count=options.count)
    if options.root is not None:
        scenes = CocoScenes(options.root, options.annotations, detector.classes, min_instances=0, max_target_area=None)
    if options.picture is not None:
        draw(scenes[0].image[None], LogPolar(options.fovea, options.spacing, options.pooling), options.picture)
    chosen = sensors(options.fovea, options.spacing, options.pooling)
    rings, wedges = LogPolar(options.fovea, options.spacing).retina.receptors((SIDE, SIDE * 3 // 4))
    print(f"log-polar: {rings} rings of {wedges} receptors, {rings * wedges:,} for {SIDE * SIDE * 3 // 4:,} pixels\n")
    print(report(chosen, detector, scenes, options.count, options.fixations))


if __name__ == "__main__":
    main()

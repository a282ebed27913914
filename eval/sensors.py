r"""Sensors at equal numbers of the detector's pixels: `python -m eval.sensors`.

    python -m eval.sensors --data.root val --data.annotations instances_val.json \
        --fit.root train --fit.annotations instances_train.json

Every sensor gets an observation model of its own, fitted to the same photographs (`--fit`). Then it searches and
explores the same other photographs (`--data`). `--fixations 0` fits nothing, and measures only what raw scores tell.
The detector must take pictures of any size. To continue a stopped run, give the same command again.

All models of a sensor are fitted by `semfov fit MODEL --sensor.name NAME`, and measured by `python -m eval.search`,
`eval.decide` and `eval.explore` with `--models FOLDER`.
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from eval.comparison.summary import Curve, collect_records
from eval.explore.report import success
from eval.explore.run import ExploreConfig, ExploreRun
from eval.search.report import performance
from eval.search.run import SearchConfig, SearchRun
from semfov.data.scene import Annotation, Scenes
from semfov.detection import Detections
from semfov.errors import check, lookup
from semfov.eye import Eye
from semfov.io.files import plain_name, write_text
from semfov.io.ranges import Count, Whole
from semfov.metrics.episodes import area_under_roc
from semfov.observation import FovealObservationModel
from semfov.observation.matching import box_iou
from semfov.runs.command import command
from semfov.runs.config import DataConfig, LookingConfig, ProtocolConfig, SensorConfig
from semfov.runs.protocols import choose_classes
from semfov.runs.scene_run import finish
from semfov.runs.tables import percent, plus_minus, table
from semfov.threads import one_thread
from train.fit_fom import FitFomConfig, fit_fom
from train.outputs import model_path


class _SensorChoice(NamedTuple):
    """A sensor with a size of the detector's input."""

    sensor: str
    side: int
    settings: Mapping[str, Any] = {}


CANDIDATES = {
    "published, 320": _SensorChoice("published", 320),
    "multi-scale, 4 × 160": _SensorChoice("multi-scale", 160),
    "gradual, 320": _SensorChoice("gradual", 320),
    "gradual, 416": _SensorChoice("gradual", 416),
    "log-polar, 320": _SensorChoice("log-polar", 320),
    "sharp, 320": _SensorChoice("gradual", 320, {"sigma": 1e4}),
    "multi-scale, 4 × 160 of 1920 px": _SensorChoice("multi-scale", 160, {"reference": 1920.0}),
}
"""What is compared; the last one is for pictures of at least 1920 px, and left out unless it is asked for.

A Gaussian window of 10,000 px is flat, so the sharp sensor shows the same from everywhere.
"""

_SHIFTS = (1, 5, 15)
_ANSWERS = ("all classes", "without background")
_SCORE = 0.1
_OVERLAP = 0.5
_PLACES = ((0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
"""Where the five looks fixate, as shares of width and height."""


@dataclass(frozen=True)
class _SensorsConfig(LookingConfig):
    """Compare sensors, each with models of its own.

    Args:
        data: the photographs to search and to explore.
        fit: the photographs to fit the observation models to.
        detector: the detector; each sensor sets its `input_size`, which is not padded less than to a square.
        sensor: ignored.
        belief: the belief; its columns and rows are the cells.
        protocol: the protocol of searches and explorations.
        fixations: random fixations in each photograph of the fit (0: no observation model is fitted).
        classes: largest number of classes of a photograph that are told present or absent, and as many that it lacks.
        candidates: the sensors to compare, of `CANDIDATES`.
        out: folder for models, records and the table.
    """

    fit: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    protocol: ProtocolConfig = field(default_factory=lambda: ProtocolConfig(starts=5, shifts=15))
    fixations: Whole = 4
    classes: Count = 8
    candidates: tuple[str, ...] = tuple(CANDIDATES)[:-1]
    out: Path = Path("runs/sensors")

    def settings(self, name: str) -> dict[str, Any]:
        """Return settings that the fit and the runs of a candidate have in common."""
        candidate = CANDIDATES[lookup(name, CANDIDATES, "candidate")]
        detector = replace(self.detector, input_size=candidate.side, stride=None)
        sensor = SensorConfig(candidate.sensor, **candidate.settings)  # type: ignore[arg-type]
        where = {"cache": self.cache, "workers": self.workers, "scheduler": self.scheduler}
        return {"detector": detector, "sensor": sensor, **where}

    def folder(self, name: str) -> Path:
        """Folder of a candidate."""
        return self.out / plain_name(name)


def _compare_sensors(config: _SensorsConfig) -> None:
    """Fit, search and explore with every sensor, and write the table."""
    check(config.protocol.shifts >= _SHIFTS[-1], "protocol.shifts", f"{_SHIFTS[-1]} or more", config.protocol.shifts)
    head = ["sensor", "detector's pixels", "ms"]
    for policy in policies(config)[1:]:
        head += [f"{policy}, CP@{shifts}" for shifts in _SHIFTS]
    head += ["area, 1 look", "area, 5 looks", "recall, 1 look", "recall, 5 looks"]
    head += [f"map after {_SHIFTS[-1]}, {answer}" for answer in _ANSWERS]
    rows = [_row(config, name) for name in config.candidates]
    text = "\n".join(table([head, *rows])) + "\n"
    write_text(config.out / "summary.md", text)
    write_text(config.out / "config.yaml", config.yaml())
    print(text)


def _row(config: _SensorsConfig, name: str) -> list[str]:
    """Write the row of a sensor."""
    searchers = policies(config)
    mapping = "random-raw"
    belief = config.belief
    model = None
    if config.fixations:
        file = _observation(config, name)
        mapping = "random-calibrated"
        belief = replace(belief, model=str(file))
        model = FovealObservationModel.from_pretrained(file).requires_grad_(False)
    common: dict[str, Any] = {"data": config.data, "protocol": config.protocol, "store": config.store, "belief": belief}
    common |= config.settings(name)
    folder = config.folder(name)

    search = SearchRun(SearchConfig(policies=searchers, out=folder / "search", **common))
    finish(search, name)
    searches = collect_records(search)[0]
    performances = performance(searches, searchers, config.protocol.shifts, "all targets")
    explore = ExploreRun(ExploreConfig(policies=(mapping,), out=folder / "explore", **common))
    finish(explore, name)
    maps = collect_records(explore)[0]

    pixels, seconds = cost(search.eye, search.scenes[0].image)
    cells = [name, f"{pixels:,}", f"{1e3 * seconds:.0f}"]
    for policy in searchers[1:]:
        cells += [_percent_after(performances[policy], shifts) for shifts in _SHIFTS]
    looks = _five_looks(search, model, config.classes)
    for value, error in zip(looks.value.tolist(), looks.error.tolist(), strict=True):
        cells.append(plus_minus(value, error, 3))
    for answer in _ANSWERS:
        curve = success(maps, [mapping], answer)[mapping]
        cells.append(_percent_after(curve, _SHIFTS[-1]))
    return cells


def policies(config: _SensorsConfig) -> tuple[str, ...]:
    """Return the searchers that are compared, the random one first."""
    calibrated = ["non-predictive-calibrated"] * bool(config.fixations)
    return ("random", "non-predictive-raw", *calibrated)


def _observation(config: _SensorsConfig, name: str) -> Path:
    """File of the observation model of a sensor, which is fitted unless it is there."""
    fitting = FitFomConfig(
        data=config.fit,
        fixations=config.fixations,
        name="observation",
        out=config.folder(name),
        **config.settings(name),
    )
    file = model_path(fitting, "")
    if not file.is_file():
        fit_fom(fitting)
    return file


def _percent_after(curve: Curve, shifts: int) -> str:
    """Write a curve's value after some gaze shifts in percent, with its error over images."""
    return percent(float(curve.mean[shifts]), float(curve.over_images[shifts]))


class _Seen(NamedTuple):
    """What one look, and five looks, show of a photograph.

    Attributes:
        scores: `(C, 2)`, the largest score of each examined class in one look, and in five.
        present: `(C,)`, whether the photograph has the class.
        objects: `(3,)`, the objects that one look finds, that five find, and all.
    """

    scores: Tensor
    present: Tensor
    objects: Tensor


def _five_looks(run: SearchRun, model: FovealObservationModel | None, classes: int) -> Bootstrap:
    """Measure what is seen in one look from the middle, and in that and four looks around it.

    The area tells how well the largest score of a class says whether it is in a photograph. An object is found by a
    detection of its class with a score of 0.1 that overlaps it by half.

    Shapes: → `(4,)`.
    """
    scenes = [_seen(run, index, model, classes) for index in range(len(run.scenes))]

    def measure(drawn: Tensor) -> Tensor:
        chosen = [scenes[index] for index in drawn.tolist()]
        present = torch.cat([scene.present for scene in chosen])
        areas = torch.full((2,), torch.nan)
        if present.any() and not present.all():
            scores = torch.cat([scene.scores for scene in chosen])
            areas = torch.tensor([area_under_roc(of_looks, present) for of_looks in scores.T])
        found_in_one, found_in_five, objects = torch.stack([scene.objects for scene in chosen]).sum(0)
        return torch.cat([areas, torch.stack([found_in_one, found_in_five]) / objects])

    return Bootstrap.of(measure, range(len(scenes)), samples=200)


def _seen(run: SearchRun, index: int, model: FovealObservationModel | None, classes: int) -> _Seen:
    """Look at a photograph from the middle, and from four places around it.

    Args:
        run: takes the looks.
        index: number of the photograph.
        model: calibrates the scores; None leaves them as they are.
        classes: largest number of classes that the photograph has, and that it lacks.
    """
    grid = run.grid(index)
    cells = grid.cell_of(grid.extent * torch.tensor(_PLACES))
    detections = run.detections(index)[cells]
    objects = _found_objects(detections, run.scenes.annotation(index))
    chosen, present = _classes(run.scenes, index, classes, run.config.protocol.seed)
    if model is not None:
        distance = grid.box_distance(detections.boxes, grid.centres[cells])
        calibrated = model.calibrate(detections.scores, distance)
        detections = Detections(detections.boxes, calibrated, detections.mask, detections.confidence)
    highest = detections.highest[:, torch.tensor(chosen, dtype=torch.int64)]  # (5, C)
    return _Seen(torch.stack([highest[0], highest.amax(0)], -1), present, objects)


def _found_objects(detections: Detections, annotation: Annotation) -> Tensor:
    """Count the annotated objects that the first look finds, that any look finds, and all, `(3,)`."""
    boxes = annotation.boxes[~annotation.crowd]  # (M, 4)
    labels = annotation.labels[~annotation.crowd]
    overlap = torch.stack([box_iou(boxes, in_look) for in_look in detections.boxes])  # (5, M, N)
    of_class = detections.labels[:, None] == labels[:, None]
    sure = (detections.confidence >= _SCORE)[:, None]
    found = ((overlap >= _OVERLAP) & of_class & sure).any(-1)  # (5, M)
    return torch.tensor([float(found[0].sum()), float(found.any(0).sum()), float(len(boxes))])


def _classes(scenes: Scenes, index: int, classes: int, seed: int) -> tuple[list[int], Tensor]:
    """Classes that a photograph has, as many that it lacks, and which of them it has."""
    annotation = scenes.annotation(index)
    chosen = choose_classes(scenes, index, annotation, classes, 1.0, seed)
    return chosen, torch.isin(torch.tensor(chosen, dtype=torch.int64), annotation.labels)


def cost(eye: Eye, image: Tensor, looks: int = 12) -> tuple[int, float]:
    """Pixels that the detector sees in a look, and seconds of a processor for it: the fastest of `looks`."""
    with one_thread(), torch.inference_mode():
        view = eye.open(image[None])
        point = torch.tensor([[image.shape[-1] / 2, image.shape[-2] / 2]])
        seconds = []
        for _ in range(looks):
            start = time.process_time()
            canvases = eye.foveated(view, point)
            eye.detect(view, point, canvases)
            seconds.append(time.process_time() - start)
        return len(canvases) * canvases.shape[-2] * canvases.shape[-1], min(seconds)


main = command(_compare_sensors, _SensorsConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())

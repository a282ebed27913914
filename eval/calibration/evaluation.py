"""How well scores, and beliefs about a target, agree with the annotated objects."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, cast

import torch

import semfov
from eval.calibration.beliefs import COUNTS, BeliefCalibrationRun
from eval.calibration.beliefs_report import write_belief_report
from eval.comparison.summary import announce
from eval.search.run import SearchConfig
from semfov.eye import Eye
from semfov.fit.samples import Samples
from semfov.io.files import write_text
from semfov.io.ranges import Count, Seed, Share, Side
from semfov.metrics.calibration import Calibration, calibration
from semfov.runs.config import BeliefConfig, DataConfig, EyeConfig, ProtocolConfig
from semfov.runs.scene_run import finish
from semfov.runs.setup import make_observation
from semfov.runs.tables import table
from semfov.viz import plot_reliability
from semfov.viz.style import save_figure
from train.samples import collect_samples


@dataclass(frozen=True)
class CalibrationConfig(EyeConfig):
    """Evaluate how well scores, and beliefs about a target, agree with the annotated objects.

    Args:
        data: photographs to evaluate on, by default all of them.
        detector: the detector, which is applied to each foveated view.
        model: fitted observation model, by name or file (None: the one shipped for the detector and sensor).
        fixations: number of random fixations in each photograph.
        iou: smallest intersection over union at which a detection matches an object.
        seed: random seed of the fixations and of the searches.
        beliefs: evaluate beliefs, too, for which every cell of every photograph is fixated once.
        grid: `[columns, rows]` of the grid of the beliefs.
        search_model: observation model of searches, by name or file (None: the one shipped for the detector).
        map_model: observation model of the semantic map, by name or file (None: ours for the detector and sensor).
        target_area: a class is searched for only if its boxes cover at most this share of the image.
        out: folder for the tables and the figures.
        cache: folder for the labelled detections and for the stored detections from every cell (None: `out` for the
            former, the user's cache for the latter).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    shard: ClassVar[int] = 32
    model: str | None = None
    fixations: Count = 6
    iou: Share = 0.5
    seed: Seed = 0
    beliefs: bool = True
    grid: tuple[Side, Side] = (10, 10)
    search_model: str | None = None
    map_model: str | None = None
    target_area: Share = 0.2
    out: Path = Path("runs/calibration")


def judge_calibration(config: CalibrationConfig) -> None:
    """Evaluate scores, then beliefs."""
    _judge_scores(config)
    if config.beliefs:
        judge_beliefs(config)


def _judge_scores(config: CalibrationConfig) -> None:
    """Collect labelled detections, and write how well raw and calibrated scores predict their classes."""
    sampler = collect_samples(config, (config.cache or config.out) / "samples", "looking")
    samples = sampler.all()
    model = make_observation(config.model, cast(Eye, sampler.eye))
    with torch.inference_mode():
        calibrated = model.calibrate(samples.scores, samples.distance)
    predictions = {"raw": samples.scores, "calibrated": calibrated}
    text = "\n".join(_calibration_table(model, predictions, samples)) + "\n"
    write_text(config.out / "calibration.md", text)
    write_text(config.out / "config.yaml", config.yaml())
    figure = plot_reliability({name: (p, samples.labels) for name, p in predictions.items()})
    written = [config.out / "calibration.md", config.out / "config.yaml"]
    announce(text, [*written, save_figure(figure, config.out / "reliability.png")])


def judge_beliefs(config: CalibrationConfig) -> None:
    """Search, and write how well the probabilities of beliefs agree with which cells hold the target."""
    search = SearchConfig(
        data=replace(config.data, max_target_area=config.target_area),
        detector=config.detector,
        sensor=config.sensor,
        belief=BeliefConfig(
            *config.grid,
            model=config.model,
            search_model=config.search_model,
            map_model=config.map_model,
        ),
        protocol=ProtocolConfig(shifts=COUNTS[-1] - 1, seed=config.seed),
        out=config.out,
        cache=config.cache,
        workers=config.workers,
        scheduler=config.scheduler,
    )
    run = BeliefCalibrationRun(search)
    finish(run, "believing")
    announce(*write_belief_report(run))


def _calibration_table(
    model: semfov.FovealObservationModel, predictions: dict[str, torch.Tensor], samples: Samples
) -> list[str]:
    """Measures of raw and of calibrated scores by level of distance, and over all levels."""
    level = model.level(samples.distance)
    edges = ["0", *(f"{edge:.3f}" for edge in model.edges.tolist()), "…"]
    rows = [["distance", "scores", "detections", "NLL", "Brier", "ECE", "classwise ECE", "accuracy"]]
    for number in range(len(edges)):
        everything = number == len(edges) - 1
        chosen = torch.ones_like(level, dtype=torch.bool) if everything else level == number
        label = "all" if everything else f"{edges[number]} - {edges[number + 1]}"
        for name, probabilities in predictions.items():
            rows.append([label, name, *_calibration_row(calibration(probabilities[chosen], samples.labels[chosen]))])
    return table(rows)


def _calibration_row(result: Calibration) -> list[str]:
    """Write the measures as cells of a table row."""
    return [
        str(result.count),
        *(f"{value:.3f}" for value in (result.nll, result.brier, result.ece)),
        f"{result.classwise_ece:.4f}",
        f"{result.accuracy:.3f}",
    ]

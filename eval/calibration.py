"""Measure calibration: `python -m eval.calibration` evaluates scores, an observation model and beliefs on photographs.

    python -m eval.calibration --data.root DIR --data.annotations instances.json --out runs/calibration

Without photographs it uses the embedded scenes. Every photograph is fixated at random points, and detections are
matched to the annotated boxes. For every level of distance from the fixation, a table gives how well raw and calibrated
scores predict the true class, background included. Use photographs on which the model was not fitted.

Then every photograph is searched for a class that it holds and for a class that it does not hold. Tables and a
reliability diagram show how well the belief's probabilities agree with which cells hold the target, by number of looks
and by distance from the closest fixation. The beliefs use raw scores, calibrated scores as published, tempered scores,
and learned evidence. Detections from every cell are stored and shared with `python -m eval.search`.
"""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
import yaml

import semfov
from semfov.experiments.belief_calibration import LOOKS, BeliefCalibrationRun
from semfov.experiments.belief_calibration_report import write_belief_report
from semfov.experiments.command import run_command
from semfov.experiments.config import (
    BeliefConfig,
    DataConfig,
    DetectorConfig,
    ProtocolConfig,
    SearchConfig,
    SensorConfig,
)
from semfov.experiments.parallel import rank
from semfov.experiments.samples import Samples, SampleSettings, collect
from semfov.experiments.scene_run import finish
from semfov.experiments.settings import Count, Seed, Settings, Share, Side, Workers
from semfov.experiments.setup import make_observation, plain, published_model
from semfov.experiments.summary import announce
from semfov.experiments.tables import table
from semfov.io.files import write_text
from semfov.metrics.calibration import Calibration, calibration
from semfov.viz import plot_reliability
from semfov.viz.style import save_figure


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """Evaluate how well scores, and beliefs about a target, agree with the annotated objects.

    Args:
        data: photographs to evaluate on, by default all of them.
        detector: the detector, which is applied to each foveated view.
        sensor: the foveal sensor.
        model: fitted observation model, by name or file (None: the one shipped for the detector and growth; for the
            published belief, the one fitted by maximum likelihood if it is shipped for the sensor).
        fixations: number of random fixations in each photograph.
        iou: smallest intersection over union at which a detection matches an object.
        seed: random seed of the fixations and of the searches.
        beliefs: evaluate beliefs, too, for which every cell of every photograph is fixated once.
        grid: `[columns, rows]` of the grid of the beliefs.
        target_model: learned target evidence, by name or file (None: the one shipped for the detector and sensor).
        map_model: learned map, by name or file (None: the one shipped for the detector and sensor).
        target_area: a class is searched for only if its boxes cover at most this share of the image.
        out: folder for the tables and the figures.
        cache: folder for the labelled detections and for the stored detections from every cell (None: `out` for the
            former, the user's cache for the latter).
        workers: number of processes (None: one per CPU core).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    model: str | None = None
    fixations: Count = 6
    iou: Share = 0.5
    seed: Seed = 0
    beliefs: bool = True
    grid: tuple[Side, Side] = (10, 10)
    target_model: str | None = None
    map_model: str | None = None
    target_area: Share = 0.2
    out: Path = Path("runs/calibration")
    cache: Path | None = None
    workers: Workers | None = None


def judge(config: CalibrationConfig) -> None:
    """Evaluate scores, then beliefs."""
    judge_scores(config)
    if config.beliefs:
        judge_beliefs(config)


def judge_scores(config: CalibrationConfig) -> None:
    """Collect labelled detections, and write how well raw and calibrated scores predict their classes."""
    settings = SampleSettings(config.data, config.detector, config.sensor, config.fixations, config.iou, config.seed)
    sampler, samples = collect(settings, (config.cache or config.out) / "samples", config.workers, "looking")
    if rank() > 0:
        return
    model = make_observation(config.model, sampler.foveal_eye)
    with torch.inference_mode():
        calibrated = model.calibrate(samples.scores, samples.distance)
    predictions = {"raw": samples.scores, "calibrated": calibrated}
    text = "\n".join(calibration_table(model, predictions, samples)) + "\n"
    write_text(config.out / "calibration.md", text)
    write_text(config.out / "config.yaml", yaml.safe_dump(plain(asdict(config)), sort_keys=False))
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
            model=config.model or published_model(config.detector, config.sensor),
            target_model=config.target_model,
            map_model=config.map_model,
        ),
        protocol=ProtocolConfig(shifts=LOOKS[-1] - 1, seed=config.seed),
        out=config.out,
        cache=config.cache,
        workers=config.workers,
    )
    run = BeliefCalibrationRun(search)
    finish(run, "believing")
    if rank() == 0:
        announce(*write_belief_report(run))


def calibration_table(
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
            rows.append([label, name, *figures(calibration(probabilities[chosen], samples.labels[chosen]))])
    return table(rows)


def figures(result: Calibration) -> list[str]:
    """The measures as cells of a table row."""
    return [
        str(result.count),
        *(f"{value:.3f}" for value in (result.nll, result.brier, result.ece)),
        f"{result.classwise_ece:.4f}",
        f"{result.accuracy:.3f}",
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(judge, CalibrationConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())

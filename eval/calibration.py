"""Calibration: `python -m eval.calibration` judges scores, an observation model and beliefs on photographs with boxes.

    python -m eval.calibration --data.root DIR --data.annotations instances.json --out runs/calibration

Without photographs it uses the embedded scenes. Every photograph is fixated at random points and detections are
matched to the annotated boxes. The table tells, for every level of distance to the fovea, how well raw and calibrated
scores predict the true class, background included. Judge on photographs that the model was not fitted on.

Then every photograph is searched for a class that it holds and for one that it does not hold. Tables and a reliability
diagram tell how well beliefs say which cells hold the target, by number of looks and by distance of the closest look:
of raw scores, of calibrated ones as published, tempered, and learned. What is seen from every cell is shared with
`python -m eval.search`.
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
from semfov.experiments.run import finish
from semfov.experiments.samples import Samples, SampleSettings, collect
from semfov.experiments.settings import Count, Seed, Settings, Share, Side, Workers
from semfov.experiments.setup import make_observation, plain, published_model
from semfov.experiments.summary import announce, table
from semfov.io.files import write_text
from semfov.metrics.calibration import Calibration, calibration
from semfov.viz import plot_reliability
from semfov.viz.style import save_figure


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """Judge how well scores, and beliefs in a target, agree with what is there.

    Args:
        data: photographs to judge on, all of them by default.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        model: fitted observation model, by name or file (None: the one shipped for the detector and growth; for the
            published belief the one of maximum likelihood, where it is shipped for the sensor).
        fixations: random fixations in each photograph.
        iou: overlap from which a detection shows an object.
        seed: of the fixations, and of the searches.
        beliefs: whether beliefs are judged too, for which every cell of every photograph is fixated once.
        grid: `[columns, rows]` of the beliefs.
        target_model: learned target evidence, by name or file (None: the one shipped for detector and sensor).
        map_model: learned map, by name or file (None: the one shipped for detector and sensor).
        target_area: a class whose boxes cover a larger share of the image is not searched for.
        out: folder for the tables and the figures.
        cache: folder for the labelled detections and for what was seen from every cell (None: `out`, and the user's
            cache).
        workers: processes (None: one for each CPU core).
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
    """Judge scores, then beliefs."""
    judge_scores(config)
    if config.beliefs:
        judge_beliefs(config)


def judge_scores(config: CalibrationConfig) -> None:
    """Collect labelled detections and write how well raw and calibrated scores predict their classes."""
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
    """Search, and write how well beliefs tell which cells hold the target."""
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
    """Figures by level of distance and over all, raw and calibrated in turn."""
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
    """Figures as the cells of a table row."""
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

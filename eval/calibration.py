"""Calibration: `python -m eval.calibration` judges scores and an observation model on photographs with boxes.

    python -m eval.calibration --data.root DIR --data.annotations instances.json --out runs/calibration

Without photographs it uses the embedded scenes. Every photograph is fixated at random points and detections are
matched to the annotated boxes. The table tells, for every level of distance to the fovea, how well raw and calibrated
scores predict the true class, background included. Judge on photographs that the model was not fitted on.
"""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
import yaml

import semfov
from semfov.experiments.command import run_command
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.parallel import rank
from semfov.experiments.samples import Samples, SampleSettings, collect
from semfov.experiments.setup import make_observation, plain
from semfov.experiments.summary import save_figure, table
from semfov.io.files import write_text
from semfov.metrics.calibration import Calibration, calibration
from semfov.viz import plot_reliability


@dataclass(frozen=True)
class CalibrationConfig:
    """Judge how well scores agree with what is there.

    Args:
        data: photographs to judge on, all of them by default.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        model: fitted observation model, by name or file (None: the one shipped for the detector and growth).
        fixations: random fixations in each photograph.
        iou: overlap from which a detection shows an object.
        seed: of the fixations.
        out: folder for the table and the figure.
        cache: folder for the labelled detections (None: `out`).
        workers: processes (None: one for each CPU core).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    model: str | None = None
    fixations: int = 6
    iou: float = 0.5
    seed: int = 0
    out: Path = Path("runs/calibration")
    cache: Path | None = None
    workers: int | None = None


def judge(config: CalibrationConfig) -> None:
    """Collect labelled detections and write how well raw and calibrated scores predict their classes."""
    settings = SampleSettings(config.data, config.detector, config.sensor, config.fixations, config.iou, config.seed)
    sampler, samples = collect(settings, (config.cache or config.out) / "samples", config.workers, "looking")
    if rank() > 0:
        return
    model = make_observation(config.model, sampler.eye)
    with torch.inference_mode():
        calibrated = model.calibrate(samples.scores, samples.distance)
    predictions = {"raw": samples.scores, "calibrated": calibrated}
    text = "\n".join(calibration_table(model, predictions, samples)) + "\n"
    print(text)
    write_text(config.out / "calibration.md", text)
    write_text(config.out / "config.yaml", yaml.safe_dump(plain(asdict(config)), sort_keys=False))
    figure = plot_reliability({name: (p, samples.labels) for name, p in predictions.items()})
    written = [config.out / "calibration.md", config.out / "config.yaml"]
    written.append(save_figure(figure, config.out / "reliability.png"))
    print("written:", *(f"  {path}" for path in written), sep="\n")


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

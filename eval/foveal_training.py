"""Calibrate the detector, or train it on foveal views? `python -m eval.foveal_training` compares the two, and both.

    python -m train.finetune_foveal --data.root FIT --data.annotations fit.json --out runs/finetune_foveal
    python -m eval.foveal_training --tuned runs/finetune_foveal/yolov3-tiny-foveal.onnx \
        --fit.root FIT --fit.annotations fit.json --data.root DIR --data.annotations instances.json

Without photographs both use the embedded scenes, which only serves to try it out.

There are four arms: the detector as shipped and the detector trained on foveal views, each with raw scores and with an
observation model, which is fitted here with the same settings on the same photographs. The tables give the computing
time of each arm, recall by distance from the fixation, the calibration of the scores, and search performance. To
continue a stopped run, give the same command again. Evaluate on photographs that were used neither for fitting nor for
training.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml

from semfov.errors import DataError
from semfov.experiments.command import run_command
from semfov.experiments.config import (
    BeliefConfig,
    DataConfig,
    DetectorConfig,
    ProtocolConfig,
    SearchConfig,
    SensorConfig,
)
from semfov.experiments.settings import Count, Positive, Seed, Settings, Side, Workers
from semfov.experiments.setup import plain
from semfov.experiments.summary import announce, percent, table
from semfov.io.files import write_text
from semfov.metrics.averages import Array, standard_error
from semfov.metrics.calibration import calibration
from semfov.training.foveal_comparison import Arm, arms_of
from semfov.training.observation_settings import FitConfig

SHIFTS = (1, 5, 15, 30)
ARMS = {
    ("shipped", "raw"): "as shipped, raw",
    ("shipped", "calibrated"): "calibrated",
    ("tuned", "raw"): "fine-tuned, raw",
    ("tuned", "calibrated"): "fine-tuned and calibrated",
}


@dataclass(frozen=True)
class FovealTrainingConfig(Settings):
    """Compare calibrating a detector with training it on foveal views.

    Args:
        tuned: the detector trained by `train.finetune_foveal`.
        data: photographs to evaluate on, as for `eval.search`.
        fit: photographs on which the observation models are fitted.
        detector: the detector before the training.
        sensor: the foveal sensor with which the detector was trained.
        fit_fixations: number of random fixations in each photograph of the fit.
        fixations: number of random fixations in each photograph for measuring recall and calibration.
        rate: mean number of false boxes per look; it sets the score threshold at which recall is measured.
        searched: search only this many photographs, the first ones (None: all); every cell of these is looked at.
        policy: search policy, as for `eval.search`, without `-raw` or `-calibrated`.
        grid: `[columns, rows]` of the grid of the beliefs.
        protocol: the protocol of the searches.
        seed: random seed of the fixations.
        out: folder for the tables, the models and the labelled detections.
        cache: folder for the stored detections from every cell, shared with `eval.search` (None: the user's cache).
        workers: number of processes (None: one per CPU core).
    """

    tuned: Path = Path("runs/finetune_foveal/yolov3-tiny-foveal.onnx")
    data: DataConfig = field(default_factory=DataConfig)
    fit: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    fit_fixations: Count = 2
    fixations: Count = 6
    rate: Positive = 1.0
    searched: Count | None = None
    policy: str = "non-predictive"
    grid: tuple[Side, Side] = (10, 10)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    seed: Seed = 0
    out: Path = Path("runs/foveal_training")
    cache: Path | None = None
    workers: Workers | None = None


def compare(config: FovealTrainingConfig) -> None:
    """Fit, look and search with both detectors, and write the tables."""
    if not config.tuned.exists():
        raise DataError(f"tuned: no such file: {config.tuned}; make it with python -m train.finetune_foveal")
    names = {"shipped": config.detector, "tuned": replace(config.detector, name=str(config.tuned), weights=None)}
    found = {name: arms(config, name, detector) for name, detector in names.items()}
    chosen = {title: found[detector][scores] for (detector, scores), title in ARMS.items()}
    text = report(config, chosen, training_minutes(config.tuned))
    write_text(config.out / "foveal_training.md", text)
    write_text(config.out / "config.yaml", yaml.safe_dump(plain(asdict(config)), sort_keys=False))
    announce(text, [config.out / "foveal_training.md", config.out / "config.yaml"])


def arms(config: FovealTrainingConfig, name: str, detector: DetectorConfig) -> dict[str, Arm]:
    """The arms of a detector."""
    out = config.out / name
    fit = FitConfig(
        data=config.fit,
        detector=detector,
        sensor=config.sensor,
        fixations=config.fit_fixations,
        seed=config.seed,
        out=out,
        workers=config.workers,
    )
    search = SearchConfig(
        data=config.data,
        detector=detector,
        sensor=config.sensor,
        belief=BeliefConfig(*config.grid),
        protocol=config.protocol,
        out=out,
        cache=config.cache,
        workers=config.workers,
    )
    return arms_of(fit, search, config.policy, config.fixations, config.rate, config.searched)


def training_minutes(tuned: Path) -> float:
    """CPU minutes of looking and training, as recorded by the training; NaN if there is no such record."""
    try:
        told = json.loads((tuned.parent / "training.json").read_text(encoding="utf-8"))
        return float(told["looking_seconds"] + sum(epoch["seconds"] for epoch in told["epochs"])) / 60
    except (OSError, ValueError, KeyError, TypeError):
        return float("nan")


def report(config: FovealTrainingConfig, found: Mapping[str, Arm], minutes: float) -> str:
    """All tables, as Markdown."""
    sensor = config.sensor.make()
    first = next(iter(found.values()))
    what = (
        f"{config.detector.name}, {config.sensor.name} fovea (σ {float(sensor.sigma):g} px, growth {sensor.growth:g})"
    )
    return "\n".join(
        [
            f"{what}. ± is the standard error over photographs.",
            "",
            *table(effort(found, minutes)),
            "",
            f"Objects found and named right (%), at the score threshold that leaves {config.rate:g} false boxes per "
            "look, by their distance from the fixation as a fraction of the image's longer side "
            f"({len(first.recall[1])} photographs, {config.fixations} looks at each):",
            "",
            *table(recall(config, found)),
            "",
            "Scores as probabilities of the true class, background included, over all detections:",
            "",
            *table(calibrations(found)),
            "",
            "Negative log likelihood by distance:",
            "",
            *table(surprise(config, found)),
            "",
            f"Targets found (%) after n gaze shifts of {config.policy} search ({len(first.curves)} photographs, all "
            "legal targets, the same starts for all):",
            "",
            *table(performance(found, config.protocol.shifts)),
            "",
            "Differences in percentage points, paired over photographs:",
            "",
            *table(differences(found, config.protocol.shifts)),
            "",
        ]
    )


def effort(found: Mapping[str, Arm], minutes: float) -> list[list[str]]:
    """CPU minutes that each arm took."""
    rows = [["arm", "training, minutes of a core", "fitting, minutes of a core"]]
    for name, arm in found.items():
        trained = f"{minutes:.1f}" if name.startswith("fine-tuned") else "0"
        rows.append([name, trained, f"{arm.minutes:.1f}" if arm.minutes else "0"])
    return rows


def bounds(config: FovealTrainingConfig) -> list[str]:
    """Names of the levels of distance."""
    edges = ["0", *(f"{edge:.2f}" for edge in FitConfig(sensor=config.sensor).edges), ""]
    return [f"{low} – {high}".strip() for low, high in pairwise(edges)]


def recall(config: FovealTrainingConfig, found: Mapping[str, Arm]) -> list[list[str]]:
    """Recall by level and over all levels, and the numbers of objects."""
    rows = [["arm", *bounds(config), "all"]]
    for name, arm in found.items():
        by_level, whole = arm.recall
        rows.append([name, *(share(level) for level in by_level.T), share(whole)])
    objects = next(iter(found.values())).objects.tolist()
    return [*rows, ["objects", *map(str, objects), str(sum(objects))]]


def share(values: Array) -> str:
    """Mean and standard error in percent, over the photographs that have a value."""
    known = values[~np.isnan(values)]
    return percent(float(known.mean()), float(standard_error(known))) if len(known) else "-"


def calibrations(found: Mapping[str, Arm]) -> list[list[str]]:
    """Measures of calibration over all detections."""
    rows = [["arm", "detections", "of objects (%)", "NLL", "Brier", "ECE", "classwise ECE", "accuracy"]]
    for name, arm in found.items():
        told = calibration(arm.probabilities, arm.labels)
        objects = f"{100 * float((arm.labels > 0).double().mean()):.1f}"
        figures = (*(f"{each:.3f}" for each in (told.nll, told.brier, told.ece)), f"{told.classwise_ece:.4f}")
        rows.append([name, str(told.count), objects, *figures, f"{told.accuracy:.3f}"])
    return rows


def surprise(config: FovealTrainingConfig, found: Mapping[str, Arm]) -> list[list[str]]:
    """Negative log likelihood by level."""
    levels = bounds(config)
    rows = [["arm", *levels]]
    for name, arm in found.items():
        told = [
            calibration(arm.probabilities[at], arm.labels[at]) for at in (arm.level == n for n in range(len(levels)))
        ]
        rows.append([name, *(f"{each.nll:.3f}" for each in told)])
    return rows


def performance(found: Mapping[str, Arm], last: int) -> list[list[str]]:
    """Cumulative performance with standard errors."""
    shifts = [n for n in SHIFTS if n <= last]
    rows = [["arm", *(f"CP@{n}" for n in shifts)]]
    for name, arm in found.items():
        mean, error = arm.curves.mean(0), standard_error(arm.curves)
        rows.append([name, *(percent(mean[n], error[n]) for n in shifts)])
    chance = next(iter(found.values())).chance
    return [*rows, ["random gaze, by formula", *(f"{100 * chance[n]:.1f}" for n in shifts)]]


def differences(found: Mapping[str, Arm], last: int) -> list[list[str]]:
    """Differences of every arm from calibration alone, in recall and in search performance."""
    shifts = [n for n in SHIFTS if n <= last]
    rows = [["arm, less calibrated", "recall", *(f"CP@{n}" for n in shifts)]]
    one = found["calibrated"]
    for name, arm in found.items():
        if arm is one:
            continue
        paired, seen = arm.curves - one.curves, arm.recall[1] - one.recall[1]
        seen = seen[~np.isnan(seen)]
        cells = [(seen.mean(), standard_error(seen)), *((paired.mean(0)[n], standard_error(paired)[n]) for n in shifts)]
        rows.append([name, *(f"{100 * mean:+.1f} ± {100 * error:.1f}" for mean, error in cells)])
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(compare, FovealTrainingConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())

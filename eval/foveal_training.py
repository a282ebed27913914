"""Calibrate the detector, or train it on foveal views? `python -m eval.foveal_training` compares the two, and both.

    python -m train.finetune_foveal --data.root FIT --data.annotations fit.json --out runs/finetune_foveal
    python -m eval.foveal_training --tuned runs/finetune_foveal/yolov3-tiny-foveal.onnx \
        --fit.root FIT --fit.annotations fit.json --data.root DIR --data.annotations instances.json

Without photographs both use the embedded scenes, which is only good for trying it out.

Four arms: the detector as it is and the one trained on foveal views, each with raw scores and with an observation model
that is fitted to it here, by the same settings on the same photographs. The tables tell what each took, which objects
it finds by their distance to the fixation, how far its scores are probabilities, and how soon it finds targets. A run
that was stopped goes on where it was. Judge on photographs that nothing was fitted or trained on.
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
        tuned: the trained detector, of `train.finetune_foveal`.
        data: photographs to judge on, as for `eval.search`.
        fit: photographs that observation models are fitted to.
        detector: the detector as it was before.
        sensor: the foveal sensor, the one that it was trained behind.
        fit_fixations: random fixations in each photograph of the fit.
        fixations: random fixations in each photograph, to measure recall and calibration.
        rate: false boxes in a look, on average, at which found objects are counted.
        searched: search only the first so many photographs, for each of which every cell is looked at (None: all).
        policy: that searches, as for `eval.search`, without `-raw` or `-calibrated`.
        grid: `[columns, rows]` of the beliefs.
        protocol: the searches.
        seed: of the fixations.
        out: folder for the tables, the models and what was seen.
        cache: folder for what was seen from every cell, shared with `eval.search` (None: the user's cache).
        workers: processes (None: one for each CPU core).
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
    """Minutes of processors that looking and training took, as the training told; NaN where it did not."""
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
            f"Objects found and named right (%), at the score that leaves {config.rate:g} false boxes a look, by their "
            f"distance to the fixation in longer sides ({len(first.recall[1])} photographs, {config.fixations} looks "
            "at each):",
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
            "Differences in points, paired over photographs:",
            "",
            *table(differences(found, config.protocol.shifts)),
            "",
        ]
    )


def effort(found: Mapping[str, Arm], minutes: float) -> list[list[str]]:
    """Minutes of processors that each arm took."""
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
    """Recall by level and over all, and how many objects there were."""
    rows = [["arm", *bounds(config), "all"]]
    for name, arm in found.items():
        by_level, whole = arm.recall
        rows.append([name, *(share(level) for level in by_level.T), share(whole)])
    objects = next(iter(found.values())).objects.tolist()
    return [*rows, ["objects", *map(str, objects), str(sum(objects))]]


def share(values: Array) -> str:
    """Mean and error over the photographs that have a value, in percent."""
    known = values[~np.isnan(values)]
    return percent(float(known.mean()), float(standard_error(known))) if len(known) else "-"


def calibrations(found: Mapping[str, Arm]) -> list[list[str]]:
    """Figures of calibration over all detections."""
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
    """Cumulative performance with errors."""
    shifts = [n for n in SHIFTS if n <= last]
    rows = [["arm", *(f"CP@{n}" for n in shifts)]]
    for name, arm in found.items():
        mean, error = arm.curves.mean(0), standard_error(arm.curves)
        rows.append([name, *(percent(mean[n], error[n]) for n in shifts)])
    chance = next(iter(found.values())).chance
    return [*rows, ["random gaze, by formula", *(f"{100 * chance[n]:.1f}" for n in shifts)]]


def differences(found: Mapping[str, Arm], last: int) -> list[list[str]]:
    """Every arm against calibrating alone, of searches and of recall."""
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

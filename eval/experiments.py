"""The experiments of the results page: which policies, detectors and settings."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from eval.config import (
    BeliefConfig,
    DataConfig,
    DetectorConfig,
    ExploreConfig,
    ProtocolConfig,
    RunConfig,
    SaliencyConfig,
    SearchConfig,
    SensorConfig,
)

PUBLISHED = ("random", "non-predictive-raw", "predictive-raw", "non-predictive-calibrated", "predictive-calibrated")
BEYOND = (
    *PUBLISHED,
    "vocus2",
    "itti-koch",
    "non-predictive-raw+tempered",
    "non-predictive-raw+tempered+central",
    "non-predictive-calibrated+tempered+soft",
    "target-evidence",
)
ABLATIONS = (
    "non-predictive-raw+central",
    "non-predictive-raw+closest",
    "non-predictive-calibrated+tempered+soft+misses",
    "neighbourhood-calibrated+tempered+soft",
    "foveal-hit-calibrated+tempered+soft+misses",
    "place-information-calibrated+tempered+soft+misses",
)
EXPLORE = (
    "random-raw",
    "kl-raw",
    "negative-entropy-raw",
    "two-peaks-raw",
    "vocus2-raw",
    "itti-koch-raw",
    "random-calibrated",
    "kl-calibrated",
    "random-raw+mild",
    "expected-accuracy-raw+misses",
    "closer-look-raw",
    "closer-look-raw+mild",
    "closer-look-calibrated",
)

SHARP = (
    "random-raw",
    "kl-raw",
    "negative-entropy-raw",
    "two-peaks-raw",
    "random-calibrated",
    "kl-calibrated",
    "expected-accuracy-raw+misses",
    "closer-look-raw",
    "closer-look-raw+mild",
    "closer-look-calibrated",
)

Changes = dict[str, dict[str, object]]

SENSITIVITY: dict[str, Changes] = {
    "as published": {},
    "fovea 50 px": {"sensor": {"sigma": 50.0}},
    "fovea 200 px": {"sensor": {"sigma": 200.0}},
    "growth 1": {"sensor": {"growth": 1.0}},
    "background policy uniform": {"detector": {"background": "uniform"}},
    "background policy none": {"detector": {"background": "none"}},
    "score threshold 0.1": {"detector": {"threshold": 0.1}},
    "prior 0.1": {"belief": {"prior": 0.1}},
    "prior 2": {"belief": {"prior": 2.0}},
    "footprint centre": {"belief": {"footprint": "centre"}},
    "footprint box_centre": {"belief": {"footprint": "box_centre"}},
    "footprint soft": {"belief": {"footprint": "soft"}},
    "ties by first index": {"protocol": {"ties": "first"}},
    "fusion product": {"belief": {"fusion": "product"}},
    "fusion sum": {"belief": {"fusion": "sum"}},
    "tempering 0.1": {"belief": {"tempering": 0.1}},
    "tempering 0.25": {"belief": {"tempering": 0.25}},
    "tempering 0.5": {"belief": {"tempering": 0.5}},
    "closest look": {"belief": {"memory": "closest"}},
}
"""Settings that change one thing each; of non-predictive search with raw scores."""

FOVEAE: dict[str, Changes] = {
    f"YOLOX-nano, fovea {sigma} px, growth {growth}": {"sensor": {"sigma": float(sigma), "growth": float(growth)}}
    for sigma in (50, 100, 200)
    for growth in (1, 2)
}
"""Sensors."""

SENSORS: dict[str, Changes] = {
    **FOVEAE,
    **{
        f"YOLOv3-tiny at {size} px": {"detector": {"name": "yolov3-tiny", "weights": None, "input_size": size}}
        for size in (320, 416, 608)
    },
}
"""Sensors and working resolutions."""

VIEWS: dict[str, Changes] = {
    "whole photograph, once": {"saliency": {"view": "picture"}},
    "foveated view, as published": {"saliency": {"view": "foveated"}},
}
"""What the saliency models see."""

FIVE_LEVELS = "explore-five-levels-nano"
"""The experiment that needs a model which is not shipped."""


@dataclass(frozen=True)
class Study:
    """Runs on fewer photographs that differ in their settings; a row of its table is a setting and a policy.

    Attributes:
        settings: by name, what changes.
        policies: that are compared.
        explores: whether scenes are explored, or targets searched for.
        shifts: that the table shows.
    """

    settings: dict[str, Changes]
    policies: tuple[str, ...]
    explores: bool = False
    shifts: tuple[int, ...] = (1, 5, 10, 15, 30)


STUDIES = {
    "sensitivity": Study(SENSITIVITY, ("non-predictive-raw",)),
    "saliency": Study(VIEWS, ("vocus2", "itti-koch")),
    "sensor": Study(SENSORS, ("non-predictive-raw", "non-predictive-raw+tempered+central")),
    "explore-sensor": Study(FOVEAE, ("random-raw", "closer-look-raw+mild"), True, (0, 1, 2, 3, 4, 10, 20)),
}


@dataclass(frozen=True)
class ResultsConfig:
    """Which photographs, and where the page goes.

    Args:
        root: folder of the photographs.
        annotations: COCO-format instances file for them.
        yolox: ONNX file of YOLOX-nano (None: the published one).
        limit: only the first so many photographs, for a trial.
        sensitivity: photographs for the studies of settings, which look anew for every one.
        five_levels: observation model of YOLOX-nano with five levels, the last of them empty (None: left out).
        only: experiments to run (None: all); the page says of the others what is there from before, or nothing.
        page: file to write.
        template: its text.
        out: folder for the runs.
        cache: folder for what the detectors saw (None: the user's cache).
        workers: processes (None: one for each CPU core).
    """

    root: Path
    annotations: Path
    yolox: Path | None = None
    limit: int | None = None
    sensitivity: int = 30
    five_levels: Path | None = None
    only: tuple[str, ...] | None = None
    page: Path = Path("docs/results.md")
    template: Path = Path("docs/results.template.md")
    out: Path = Path("runs/results")
    cache: Path | None = None
    workers: int | None = None


def experiments(config: ResultsConfig) -> dict[str, RunConfig]:
    """The experiments of the page, by name."""
    data = DataConfig(root=config.root, annotations=config.annotations, limit=config.limit)
    detectors = {"nano": DetectorConfig(name="yolox-nano", weights=config.yolox), "tiny": DetectorConfig()}
    picture = SaliencyConfig(view="picture")
    runs: dict[str, RunConfig] = {}
    for name, detector in detectors.items():
        common: dict[str, Any] = {"data": data, "detector": detector, "cache": config.cache, "workers": config.workers}
        seek = partial(SearchConfig, **common, saliency=picture)
        runs[f"search-{name}"] = seek(policies=(*ABLATIONS, *BEYOND) if name == "nano" else BEYOND)
        for control in ("wrong-class", "permuted"):
            protocol = ProtocolConfig(control=control)
            runs[f"{control}-{name}"] = seek(policies=("random", "target-evidence"), protocol=protocol, scanpaths=0)
        if name == "tiny":
            policies = ("non-predictive-raw+tempered+central", "learned-raw")
            runs[f"learned-{name}"] = seek(policies=policies, scanpaths=0)
        tour = partial(ExploreConfig, **common, saliency=picture)
        runs[f"explore-{name}"] = tour(policies=EXPLORE)
        # The window of the authors' code, with which one look leaves more to explore.
        runs[f"explore-sharp-{name}"] = tour(policies=SHARP, sensor=SensorConfig(growth=1.0))
        published = BeliefConfig(model=f"{'yolov3-tiny' if name == 'tiny' else 'yolox-nano'}-published")
        models = ("random-calibrated", "kl-calibrated", "negative-entropy-calibrated", "two-peaks-calibrated")
        runs[f"explore-published-{name}"] = tour(policies=models, belief=published)
    if config.five_levels is not None:
        belief = BeliefConfig(model=str(config.five_levels))
        policies = ("random-raw", "kl-raw", "random-calibrated", "kl-calibrated")
        nano: dict[str, Any] = {"data": data, "detector": detectors["nano"], "cache": config.cache}
        runs[FIVE_LEVELS] = ExploreConfig(**nano, workers=config.workers, policies=policies, belief=belief)
    few: dict[str, Any] = {"data": replace(data, limit=config.sensitivity), "detector": detectors["nano"]}
    few |= {"cache": config.cache, "workers": config.workers}
    for title, study in STUDIES.items():
        base = ExploreConfig(**few) if study.explores else SearchConfig(**few, scanpaths=0)
        for label, changes in study.settings.items():
            parts = {part: replace(getattr(base, part), **values) for part, values in changes.items()}
            runs[f"{title} {label}"] = replace(base, **parts, policies=study.policies)
    folder = str.maketrans({" ": "-", ",": None})
    return {name: replace(run, out=config.out / name.translate(folder)) for name, run in runs.items()}

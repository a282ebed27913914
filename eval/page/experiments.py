"""The experiments of the pages of results: their policies, detectors, sensors and settings."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from eval.comparison.settings import ComparedConfig
from eval.comparison.thresholds import ThresholdLooksConfig
from eval.decide.run import DecideConfig
from eval.explore.run import ExploreConfig
from eval.search.run import SearchConfig
from semfov.io.ranges import Count, Workers
from semfov.runs.config import (
    BeliefConfig,
    DataConfig,
    DetectorConfig,
    PolicyConfig,
    ProtocolConfig,
    Scores,
    SensorConfig,
)
from semfov.runs.presets import AGENT
from semfov.runs.settings import Settings
from semfov.sensor.named import SensorName

DETECTORS = {"nano": "YOLOX-nano", "tiny": "YOLOv3-tiny"}
"""Detectors of the page, by their names in experiments."""

FOVEAE: dict[SensorName, str] = {"published": "wide", "published-narrow": "narrow"}
"""Published sensors, in the paper's words."""

CENTRAL = PolicyConfig("non-predictive", tempering=0.25, footprint="box_centre")
"""Non-predictive search with manually chosen settings."""

_GUIDED = (
    PolicyConfig("non-predictive", "calibrated", saliency="vocus2"),
    PolicyConfig("predictive", "calibrated", saliency="vocus2"),
)
"""Searches with saliency as a prior over the cells."""

_PUBLISHED = (
    "random",
    "non-predictive-raw",
    "predictive-raw",
    "non-predictive-calibrated",
    "predictive-calibrated",
    "vocus2",
)
"""Search policies of the paper."""

_PUBLISHED_EXPLORATION = (
    "random-raw",
    "kl-raw",
    "random-calibrated",
    "kl-calibrated",
    "negative-entropy-calibrated",
    "two-peaks-calibrated",
    "vocus2-calibrated",
)
"""Exploration policies of the paper."""

SCORE_THRESHOLDS = (0.02, 0.1, 0.25, 0.5)
"""Score thresholds of the detector at which the page tests the findings of the paper, which gives none."""

_PROPOSED = (
    "random",
    "non-predictive-calibrated",
    "neighbourhood-calibrated",
    *_GUIDED,
    "vocus2",
    "itti-koch",
)
"""Search policies that the paper proposes as future work, with its own sensor and observation model."""

_BEYOND = (
    "random",
    "non-predictive-raw",
    "non-predictive-calibrated",
    PolicyConfig("non-predictive", tempering=0.25),
    CENTRAL,
    PolicyConfig("non-predictive", "calibrated", tempering=0.25, footprint="soft"),
    AGENT,
)
"""Search policies with semfov's own sensor and models."""

_SCORES: tuple[Scores, ...] = ("raw", "calibrated")

_EXPECTED = tuple(PolicyConfig("predictive", scores, samples=samples) for scores in _SCORES for samples in (None, 64))
"""Predictive searches with the expected scores, and with the expectation over drawn looks."""

_EXPECTED_EXPLORATION = tuple(
    PolicyConfig(policy, "calibrated", samples=samples)
    for policy in ("kl", "negative-entropy")
    for samples in (None, 16)
)
"""The same two kinds of explorations."""

Experiment = ComparedConfig | DecideConfig | ThresholdLooksConfig
"""Settings of an experiment of the page."""

_Changes = dict[str, dict[str, object]]

SENSITIVITY: dict[str, _Changes] = {
    "as published": {},
    "OpenCV's pyramid": {"sensor": {"convention": "opencv"}},
    "growth 2": {"sensor": {"growth": 2.0}},
    "background policy normalised": {"detector": {"background": "normalised"}},
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
    "tempering 0.25": {"belief": {"tempering": 0.25}},
    "closest look": {"belief": {"memory": "closest"}},
}
"""Variations of a search on photographs of the fit set; each changes one setting."""

SENSITIVITY_POLICY = "non-predictive-raw"
"""Policy of the study of settings."""


@dataclass(frozen=True)
class ResultsConfig(Settings):
    """The photographs of the pages of results, and the files that are written.

    Args:
        root: folder of the photographs of COCO val2017.
        annotations: their annotation file, in the COCO instances format.
        ids: text file with the ids of the photographs on which results are measured.
        fit_root: folder of the photographs on which the models were fitted, for the study of settings (None: no
            study).
        fit_annotations: their annotation file, in the COCO instances format.
        yolox: ONNX file of YOLOX-nano (None: the published file).
        limit: use only this many photographs, the first ones, for a trial.
        few: number of photographs, the first ones, for the experiments at every score threshold and for those with an
            expectation over drawn looks, of which there are many or which take long.
        study: number of photographs for the study of settings, which computes new looks for every setting of sensor
            and detector.
        only: names of the experiments to run (None: all); for the others the pages show the results of earlier runs,
            if there are any.
        page: file with the findings, whose tables are replaced.
        tables: file with all other tables, which are replaced.
        pictures: folder for the figures of the pages.
        out: folder for the runs.
        cache: folder for the stored detections (None: the user's cache).
        workers: number of processes (None: one per CPU core).
        scheduler: address of a Dask scheduler whose workers do the work instead (docs/guides/cluster.md).
    """

    root: Path
    annotations: Path
    ids: Path = Path("configs/results_photographs.txt")
    fit_root: Path | None = None
    fit_annotations: Path | None = None
    yolox: Path | None = None
    limit: Count | None = None
    few: Count = 100
    study: Count = 30
    only: tuple[str, ...] | None = None
    page: Path = Path("docs/results.md")
    tables: Path = Path("docs/tables.md")
    pictures: Path = Path("docs/pictures")
    out: Path = Path("runs/results")
    cache: Path | None = None
    workers: Workers | None = None
    scheduler: str | None = None


def experiments(config: ResultsConfig) -> dict[str, Experiment]:
    """Return the experiments of the page, by name."""
    runs = dict(_measured(config))
    if config.fit_root is not None:
        runs |= dict(_sensitivity(config))
    folder = str.maketrans({" ": "-", ",": None, "'": None})
    return {name: replace(run, out=config.out / name.translate(folder)) for name, run in runs.items()}


def detector(name: str, config: ResultsConfig) -> DetectorConfig:
    """Return settings of a detector of the page."""
    return (
        DetectorConfig(name="yolox-nano", weights=config.yolox)
        if name == "nano"
        else DetectorConfig(name="yolov3-tiny")
    )


def _measured(config: ResultsConfig) -> Iterator[tuple[str, Experiment]]:
    """Yield the experiments on the photographs on which results are measured; those of the paper come first."""
    for name in DETECTORS:
        settings = detector(name, config)
        common, few = _common(settings, config)
        seek = partial(SearchConfig, **common)
        tour = partial(ExploreConfig, **common)
        for fovea in FOVEAE:
            sensor = SensorConfig(name=fovea)
            belief = BeliefConfig(model=f"{settings.name}-{fovea}")
            yield f"search-{fovea}-{name}", seek(sensor=sensor, belief=belief, policies=_PUBLISHED)
            yield f"explore-{fovea}-{name}", tour(sensor=sensor, belief=belief, policies=_PUBLISHED_EXPLORATION)
        yield from _thresholds(name, settings, few)
    yield from _beyond(config)


def _common(settings: DetectorConfig, config: ResultsConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what experiments with a detector share, and the same with few photographs."""
    data = DataConfig(root=config.root, annotations=config.annotations, ids=config.ids, limit=config.limit)
    work = {"cache": config.cache, "workers": config.workers, "scheduler": config.scheduler}
    common: dict[str, Any] = {"data": data, "detector": settings, **work}
    return common, {**common, "data": replace(data, limit=min(config.few, config.limit or config.few))}


def _beyond(config: ResultsConfig) -> Iterator[tuple[str, Experiment]]:
    """Yield the experiments beyond the paper, with YOLOX-nano."""
    settings = detector("nano", config)
    common, few = _common(settings, config)
    seek = partial(SearchConfig, **common)
    sensor = SensorConfig(name="published")
    belief = BeliefConfig(model=f"{settings.name}-published")
    yield "proposed-nano", seek(sensor=sensor, belief=belief, policies=_PROPOSED)
    # One start: an expectation takes ten times as long as the published decision.
    options: dict[str, Any] = {**few, "sensor": sensor, "belief": belief}
    yield "expected-search", SearchConfig(**options, protocol=ProtocolConfig(1), policies=_EXPECTED)
    once = ProtocolConfig(1, shifts=20)
    yield "expected-explore", ExploreConfig(**options, protocol=once, policies=_EXPECTED_EXPLORATION)
    yield "beyond-search-nano", seek(policies=_BEYOND)
    yield "decide-nano", DecideConfig(**common)


def at_threshold(kind: str, threshold: float, name: str) -> str:
    """Name of the experiment of a kind at a score threshold, with a detector of `DETECTORS`."""
    return f"{kind}-threshold-{threshold:g}-{name}"


AT_THRESHOLDS = tuple(
    at_threshold(kind, threshold, name)
    for kind in ("search", "explore")
    for threshold in SCORE_THRESHOLDS
    for name in DETECTORS
)
"""Names of the experiments at all score thresholds."""


def _thresholds(name: str, settings: DetectorConfig, common: dict[str, Any]) -> Iterator[tuple[str, Experiment]]:
    """Return the paper's searches and explorations at each score threshold, after the looks, which share a pass."""
    sensor = SensorConfig(name="published")
    yield f"looks-threshold-{name}", ThresholdLooksConfig(**common, sensor=sensor, thresholds=SCORE_THRESHOLDS)
    for threshold in SCORE_THRESHOLDS:
        # Without a name, the observation model is the one that was fitted at the threshold.
        own = {**common, "detector": replace(settings, threshold=threshold), "sensor": sensor}
        seek = SearchConfig(**own, policies=tuple(p for p in _PUBLISHED if p != "vocus2"))
        tour = ExploreConfig(**own, policies=_PUBLISHED_EXPLORATION[:4])
        yield at_threshold("search", threshold, name), seek
        yield at_threshold("explore", threshold, name), tour


def _sensitivity(config: ResultsConfig) -> Iterator[tuple[str, ComparedConfig]]:
    """Yield searches on photographs of the fit set, each with one setting changed."""
    base = SearchConfig(
        data=DataConfig(root=config.fit_root, annotations=config.fit_annotations, limit=config.study),
        detector=detector("nano", config),
        sensor=SensorConfig(name="published"),
        cache=config.cache,
        workers=config.workers,
        scheduler=config.scheduler,
    )
    for setting, changes in SENSITIVITY.items():
        sections = {section: replace(getattr(base, section), **values) for section, values in changes.items()}
        yield f"sensitivity {setting}", replace(base, **sections, policies=(SENSITIVITY_POLICY,))

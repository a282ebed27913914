"""Settings of the evaluation, as dataclasses that the command line and YAML files fill in."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from semfov.belief.grid import Footprint
from semfov.belief.observers import Memory
from semfov.detection.onnx_twin import Runtime
from semfov.detection.scores import BackgroundPolicy
from semfov.experiments.settings import (
    Count,
    Positive,
    Range,
    Seed,
    Settings,
    Share,
    Shifts,
    Side,
    Weight,
    Whole,
    Workers,
)
from semfov.gaze.saliency.cells import Reduction
from semfov.sensor import SENSORS, Foveation, named_sensor
from semfov.sensor.named import SensorName

SaliencyModel = Literal["vocus2", "itti-koch"]
Context = Literal["none", "place", "cooccurrence", "both"]
Scores = Literal["raw", "calibrated", "learned"]


@dataclass(frozen=True)
class DataConfig(Settings):
    """Which scenes to search.

    Args:
        root: folder of the photographs; None uses the embedded scenes, which need no data set.
        annotations: COCO-format instances file for the photographs.
        limit: use only the first so many scenes (None: all of the photographs, 8 embedded scenes).
        min_instances: leave out photographs with fewer objects (published: 8).
        ids: text file with the ids of the photographs to take, one a line, before any other selection (None: all).
        max_target_area: a class whose boxes cover a larger share of the image is not searched for, unless this is null
            (published: 0.2 for a target object).
        scene_seed: seed that the embedded scenes are composed by.
    """

    root: Path | None = None
    annotations: Path | None = None
    limit: Count | None = None
    ids: Path | None = None
    min_instances: Whole = 8
    max_target_area: Positive | None = 0.2
    scene_seed: Seed = 0


@dataclass(frozen=True)
class DetectorConfig(Settings):
    """Which detector looks through the fovea.

    Args:
        name: `yolov3-tiny`, `yolov3`, `yolov3-spp`, `yolox-nano`, `yolox-tiny`, `yolox-s`, a Darknet cfg file, an
            ONNX model, or `torchvision:<model>`.
        weights: file with the weights (None: those registered for the name).
        background: where the background score comes from (`semfov.detection.scores`; None: what suits the network).
        threshold: boxes with a lower confidence are dropped.
        iou: class-agnostic non-maximum suppression drops boxes that overlap a better one by more.
        limit: most boxes kept in a view.
        stride: pad the view only to a multiple of this (None: to the detector's square input, as Darknet pads it;
            `auto`: what is fastest, 32 for Darknet's networks).
        input_size: longer side in pixels at which it works, for Darknet's networks (None: its own, 416).
        runtime: what computes Darknet's networks: `torch`, `onnxruntime`, or what is faster (`auto`).
        classes: names of the classes in the order of the scores (None: those that the network comes with, or COCO's).
        head: of an ONNX model, where it is not recognised (docs/detectors.md).
    """

    name: str = "yolov3-tiny"
    weights: Path | None = None
    background: BackgroundPolicy | None = "residual"
    threshold: Share = 0.02
    iou: Share = 0.5
    limit: Count = 100
    stride: Annotated[int, Range(1, 4096)] | Literal["auto"] | None = "auto"
    input_size: Annotated[int, Range(1, 65_536)] | None = None
    runtime: Runtime = "auto"
    classes: tuple[str, ...] | None = None
    head: str | None = None


@dataclass(frozen=True)
class SensorConfig(Settings):
    """The foveal sensor.

    Args:
        name: `published` or `published-narrow`, for the wide and the narrow fovea of the paper, or `gradual`, the
            agent's (`semfov.sensor.SENSORS`).
        sigma: width of the fovea in pixels of an image whose longer side is `reference` (None: that of the name).
        growth: how much wider the window of each coarser band is (None: that of the name).
        levels: number of bands of the Laplacian pyramid.
        convention: `kornia` or `opencv` pyramid.
        reference: longer side in pixels that sigma is meant for.
    """

    name: SensorName = "gradual"
    sigma: Positive | None = None
    growth: Positive | None = None
    levels: Annotated[int, Range(1, 30)] = 5
    convention: Literal["kornia", "opencv"] = "kornia"
    reference: Positive = 640.0

    def make(self) -> Foveation:
        """The sensor."""
        given = {"sigma": self.sigma, "growth": self.growth}
        changes = {name: value for name, value in given.items() if value is not None}
        return named_sensor(self.name, levels=self.levels, convention=self.convention, **changes)

    @property
    def fovea(self) -> float:
        """Width of the fovea in longer sides of the image."""
        return (SENSORS[self.name]["sigma"] if self.sigma is None else self.sigma) / self.reference


@dataclass(frozen=True)
class BeliefConfig(Settings):
    """The grid of beliefs.

    Args:
        columns: cells in a row.
        rows: cells in a column.
        prior: Dirichlet parameter of every class before the first look.
        fusion: `kaplan` (published), `product` or `sum`.
        footprint: which cells a detection updates: `overlap` (published), `centre`, `box_centre` or `soft`.
        tempering: exponent of the likelihoods (published: 1).
        memory: fuse `all` looks (published), or keep what the `closest` look at each cell says.
        misses: take account of cells in which nothing was detected, by the observation model's miss rates.
        model: fitted observation model, by name or file (None: our own for the detector and growth; published: the
            detector's name and `-published` or `-published-narrow`).
        target_model: learned target evidence, by name or file (None: the one shipped for detector and sensor).
        map_model: learned map, by name or file (None: the one shipped for detector and sensor).
        context: what is added to the log odds of a target: `none`, its usual `place`, its `cooccurrence` with what was
            seen, or `both`; for `target-evidence` and `non-predictive`.
        context_model: fitted context, by name or file.
    """

    columns: Side = 10
    rows: Side = 10
    prior: Positive = 0.5
    fusion: Literal["kaplan", "product", "sum"] = "kaplan"
    footprint: Footprint = "overlap"
    tempering: Positive = 1.0
    memory: Memory = "all"
    misses: bool = False
    model: str | None = None
    target_model: str | None = None
    map_model: str | None = None
    context: Context = "none"
    context_model: str = "coco"


@dataclass(frozen=True)
class SaliencyConfig(Settings):
    """The saliency baselines, `vocus2` and `itti-koch`.

    Args:
        view: `foveated`, the saliency of what the sensor shows from each fixation (published), or `picture`, that of
            the whole photograph, once. Neither depends on the detector.
        reduction: a cell is as salient as its most salient pixel (`max`) or as the `mean` of its pixels.
        weight: of a saliency map as a prior over the cells, for policies that have one.
    """

    view: Literal["foveated", "picture"] = "foveated"
    reduction: Reduction = "max"
    weight: Weight = 1.0


@dataclass(frozen=True)
class PolicyConfig(Settings):
    """A policy under comparison: where it looks, and what it believes. What is null is as `belief` has it for the run.

    Args:
        policy: name of a registered policy (`semfov.gaze.policies`), `saliency`, which goes by a saliency map alone, or
            `target-evidence`, which goes by learned evidence for the target, or `ivsn`, which goes by class templates.
        scores: whether scores are likelihoods as they are, `raw`, or go through the observation model, `calibrated`;
            or the belief is a `learned` one, the map of explorations or the evidence for a target.
        tempering: exponent of the likelihoods.
        footprint: which cells a detection updates: `overlap`, `centre`, `box_centre` or `soft`.
        memory: fuse `all` looks, or keep what the `closest` look at each cell says.
        misses: take account of cells in which nothing was detected.
        saliency: saliency map that it goes by, or has as a prior over the cells: `vocus2` or `itti-koch`.
        context: what is added to the log odds of a target: `none`, `place`, `cooccurrence` or `both`.
        context_model: fitted context, by name or file.
    """

    policy: str
    scores: Scores = "raw"
    tempering: Positive | None = None
    footprint: Footprint | None = None
    memory: Memory | None = None
    misses: bool | None = None
    saliency: SaliencyModel | None = None
    context: Context | None = None
    context_model: str | None = None


@dataclass(frozen=True)
class ProtocolConfig(Settings):
    """The experiment.

    Args:
        starts: episodes for each image (and target of a search), each from another cell; no search starts on its
            target.
        shifts: gaze shifts of an episode.
        ties: equal cells are chosen at `random`, or the `first` by number.
        control: `none`; `wrong-class`, the searcher is told another class than the one that counts, drawn at random; or
            `permuted`, the cells that count are drawn at random, as many as hold the target.
        seed: seed of starts and tie-breaking (what it promises: docs/guides/evaluation.md).
        batch: episodes that are run as one tensor (no influence on the result).
    """

    starts: Annotated[int, Range(1, 10_000)] = 10
    shifts: Shifts = 30
    ties: Literal["random", "first"] = "random"
    control: Literal["none", "wrong-class", "permuted"] = "none"
    seed: Seed = 0
    batch: Count = 1024


@dataclass(frozen=True)
class SearchConfig(Settings):
    """Visual search: find a target class by moving a fovea, and count the gaze shifts that it takes.

    Args:
        data: which scenes to search.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        belief: the grid of beliefs.
        saliency: the saliency baselines.
        protocol: the experiment.
        policies: policies to compare, each a preset by name or a mapping of settings such as `{policy: non-predictive,
            scores: calibrated, tempering: 0.25}` (`PolicyConfig`). Presets: `recommended` (target-evidence),
            `published` (predictive-calibrated), `target-evidence`, `learned`, `ivsn`, `random`, `vocus2`, `itti-koch`,
            `non-predictive` (also as `maximum-a-posteriori`), `predictive`, `neighbourhood`, `foveal-hit`,
            `place-information`, `entropy-limit` or `ideal-observer` followed by `-raw` or `-calibrated`; the last four
            also by `-learned`, with the evidence of `target-evidence`, which is `maximum-a-posteriori-learned`.
        gaze_model: learned gaze policy of `learned`, by name or file (None: the one shipped for the detector).
        templates: class templates of `ivsn`, by name or file (None: those shipped for the detector).
        out: folder for tables, figures, per-episode records and the manifest.
        cache: folder for what the detector saw from every cell, shared between runs (None: the user's cache).
        store: keep what the detector saw on disk; false recomputes it (the result is the same).
        workers: processes (None: one for each CPU core).
        scanpaths: draw this many episodes.
        models: folder of `train.fit_detector` that names detector, sensor, grid and fitted models.
    """

    data: DataConfig = field(default_factory=DataConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    saliency: SaliencyConfig = field(default_factory=SaliencyConfig)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    policies: tuple[str | PolicyConfig, ...] = (
        "random",
        "non-predictive-raw",
        "predictive-raw",
        "non-predictive-calibrated",
        "predictive-calibrated",
        "target-evidence",
    )
    gaze_model: str | None = None
    templates: str | None = None
    out: Path = Path("runs/search")
    cache: Path | None = None
    store: bool = True
    workers: Workers | None = None
    scanpaths: Whole = 3
    models: Path | None = None


@dataclass(frozen=True)
class ExploreConfig(Settings):
    """Scene exploration: learn what is where by moving a fovea, and count the cells whose class is right.

    Args:
        data: which scenes to explore.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        belief: the grid of beliefs.
        saliency: the saliency baselines.
        protocol: the experiment.
        policies: policies to compare, each a preset by name or a mapping of settings such as `{policy: kl, scores:
            calibrated, memory: closest}` (`PolicyConfig`). Presets: `recommended` (closer-look-learned), `published`
            (kl-calibrated), and `random`, `kl`, `negative-entropy`, `two-peaks`, `surprise`,
            `upper-confidence-bound`, `probability-of-improvement`, `expected-accuracy`, `closer-look`, `objects`,
            `vocus2` or `itti-koch` followed by `-raw` or `-calibrated`. With a learned map there are `random-learned`,
            `closer-look-learned`, `objects-learned`, `expected-gain-learned`, `vocus2-learned` and
            `itti-koch-learned`.
        out: folder for tables, figures, per-episode records and the manifest.
        cache: folder for what was seen from every cell, shared between runs (None: the user's cache).
        store: keep what was seen on disk; false recomputes it (the result is the same).
        workers: processes (None: one for each CPU core).
        models: folder of `train.fit_detector` that names detector, sensor, grid and fitted models.
    """

    data: DataConfig = field(default_factory=DataConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    saliency: SaliencyConfig = field(default_factory=SaliencyConfig)
    protocol: ProtocolConfig = field(default_factory=lambda: ProtocolConfig(shifts=20))
    policies: tuple[str | PolicyConfig, ...] = (
        "random-raw",
        "kl-raw",
        "negative-entropy-raw",
        "two-peaks-raw",
        "vocus2-raw",
        "random-calibrated",
        "kl-calibrated",
        "negative-entropy-calibrated",
        "two-peaks-calibrated",
        "vocus2-calibrated",
        "recommended",
    )
    out: Path = Path("runs/explore")
    cache: Path | None = None
    store: bool = True
    workers: Workers | None = None
    models: Path | None = None


RunConfig = SearchConfig | ExploreConfig

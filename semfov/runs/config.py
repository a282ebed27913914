"""Settings of the evaluation: dataclasses that are filled in from the command line and from YAML files."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Protocol

from semfov.belief.grid import Footprint
from semfov.belief.observers import CellMemory
from semfov.detection.scores import BackgroundPolicy
from semfov.detection.yolo import Runtime
from semfov.errors import lookup
from semfov.gaze.acquisition.base import Task
from semfov.io.files import JsonObject
from semfov.io.ranges import Count, Positive, Range, Seed, Share, Shifts, Side, Whole, Workers
from semfov.runs.settings import Settings
from semfov.runs.workers import Where
from semfov.sensor import SENSORS, Sensor
from semfov.sensor.named import SensorName

SaliencyModel = Literal["vocus2", "itti-koch", "people"]
Scores = Literal["raw", "calibrated", "learned"]


@dataclass(frozen=True)
class DataConfig(Settings):
    """The scenes of the experiment.

    Args:
        root: folder of the photographs (None: the embedded scenes, which need no data set).
        annotations: annotation file of the photographs, in the COCO instances format.
        limit: use only this many scenes, the first ones (None: all photographs, or 8 embedded scenes).
        min_instances: leave out photographs with fewer annotated objects than this (published: 8).
        ids: text file with the ids of the photographs to use, one per line; the other settings select among these
            (None: all photographs).
        max_target_area: a class is searched for only if its boxes cover at most this share of the image (published: 0.2
            for a target object; null: no limit).
        scene_seed: random seed from which the embedded scenes are composed.
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
    """The detector, which is applied to each foveated view.

    Args:
        name: `yolox-nano`, `yolox-tiny`, `yolox-s`, `yolov3-tiny`, `yolov3`, `yolov3-spp`, `nanodet-plus-m-1.5x`, a
            Darknet cfg file, an ONNX model, or `torchvision:<model>`.
        weights: file with the weights (None: the weights registered for the name).
        background: how the background score is computed (`semfov.detection.scores`; None: the policy that suits the
            network).
        threshold: drop boxes whose confidence is lower than this.
        iou: class-agnostic non-maximum suppression drops a box whose intersection over union with a more confident box
            is larger than this.
        limit: keep at most this many boxes per view, the most confident ones.
        stride: pad the view to a multiple of this number of pixels (None: to the detector's square input, as Darknet
            pads it; `auto`: whatever is fastest, 32 for Darknet's networks).
        input_size: longer side in pixels of the network's input, for networks that take any size, such as Darknet's,
            NanoDet-Plus and YOLOX (None: the network's own).
        runtime: what runs a Darknet network: `torch`, `onnxruntime`, or the faster of the two (`auto`).
        classes: names of the classes in the order of the scores (None: the network's own names, or those of COCO).
        head: output format of an ONNX model whose format is not recognised (docs/detectors.md).
        colour: order of the channels that an ONNX model takes, `rgb` or `bgr` (None: that of its head).
        logits: whether an ONNX model returns scores before their sigmoid.
        per_class: let boxes suppress boxes of their own class alone.
    """

    name: str = "yolox-nano"
    weights: Path | None = None
    background: BackgroundPolicy | None = None
    threshold: Share = 0.02
    iou: Share = 0.5
    limit: Count = 100
    stride: Annotated[int, Range(1, 4096)] | Literal["auto"] | None = "auto"
    input_size: Annotated[int, Range(1, 65_536)] | None = None
    runtime: Runtime = "auto"
    classes: tuple[str, ...] | None = None
    head: str | None = None
    colour: Literal["rgb", "bgr"] | None = None
    logits: bool = False
    per_class: bool = False


@dataclass(frozen=True)
class SensorConfig(Settings):
    """The foveal sensor.

    Args:
        name: `published` (the paper's wide fovea), `published-narrow` (the paper's narrow fovea), `gradual` (the
            agent's fovea), or another of `semfov.sensor.SENSORS`.
        sigma: width of the fovea in pixels of an image whose longer side is `reference` (None: that of the named
            sensor).
        growth: factor by which the window of each coarser band is wider than that of the next finer band (None: that of
            the named sensor).
        levels: number of bands of the Laplacian pyramid.
        convention: whether the pyramid is computed as `kornia` or as `opencv` does it.
        reference: longer side, in pixels, of the images for which sigma is given.
        settings: changed settings by name, of a sensor that has others than these (None: those of the named sensor).
    """

    name: SensorName = "gradual"
    sigma: Positive | None = None
    growth: Positive | None = None
    levels: Annotated[int, Range(1, 30)] = 5
    convention: Literal["kornia", "opencv"] = "kornia"
    reference: Positive = 640.0
    settings: dict[str, float] | None = None

    @property
    def kind(self) -> type[Sensor]:
        return SENSORS[lookup(self.name, SENSORS, "sensor")].make

    def whole(self) -> JsonObject:
        """List all settings of the sensor: those of its name, changed by those that are given."""
        changes = {}
        for field_ in fields(self):
            value = getattr(self, field_.name)
            if field_.name not in ("name", "reference", "settings") and value != field_.default:
                changes[field_.name] = value
        named = SENSORS[lookup(self.name, SENSORS, "sensor")]
        return named.changed({**changes, **(self.settings or {})})

    def make(self) -> Sensor:
        return self.kind.from_settings(self.whole())

    @property
    def fovea(self) -> float:
        """Width of the fovea as a fraction of the image's longer side."""
        return self.kind.width(self.whole()) / self.reference

    def level_edges(self, levels: int = 8, width: float = 50.0) -> list[float]:
        """Find the borders between levels of distance: those of the sensor, or at equal distances.

        Args:
            levels: number of levels, where the sensor has no borders of its own.
            width: width of a level then, in pixels of an image of 640, for a fovea of 100 pixels.

        Returns:
            The borders, in longer sides of the image.
        """
        borders = self.kind.borders(self.whole())
        if borders is not None:
            # Farther away than the longer side there is hardly anything.
            return [edge / self.reference for edge in borders if edge < self.reference]
        return [width / 100.0 * self.fovea * n for n in range(1, levels)]

    def record(self) -> JsonObject:
        """List the name, all settings and the reference, as a model folder keeps them."""
        return {"name": self.name, **self.whole(), "reference": self.reference}


@dataclass(frozen=True)
class BeliefConfig(Settings):
    """The belief: a grid of cells over the image, with a distribution over the classes in each cell.

    Args:
        columns: number of columns of the grid.
        rows: number of rows of the grid.
        prior: Dirichlet parameter of every class before the first look.
        fusion: rule that updates the belief with a detection: `kaplan` (published), `product`, `sum`, or `semba`, the
            form in the code of SemBA. Looks that a policy simulates are fused by Kaplan's rule, whatever is given here.
        footprint: which cells a detection updates: `overlap` (published), `centre`, `box_centre` or `soft`.
        tempering: exponent of the likelihoods (published: 1).
        memory: fuse `all` looks (published), or keep only the evidence of the `closest` look at each cell.
        misses: also update cells in which nothing was detected, with the miss rates of the observation model.
        model: fitted observation model, by name or file (None: the one shipped for the detector and sensor; for a
            published sensor it is the published one, for others one of our own).
        search_model: observation model fitted through the belief, by name or file (None: the one shipped for the
            detector).
        map_model: observation model of the semantic map, by name or file, or a folder of models (None: ours for the
            detector and sensor).
    """

    columns: Side = 10
    rows: Side = 10
    prior: Positive = 0.5
    fusion: Literal["kaplan", "product", "sum", "semba"] = "kaplan"
    footprint: Footprint = "overlap"
    tempering: Positive = 1.0
    memory: CellMemory = "all"
    misses: bool = False
    model: str | None = None
    search_model: str | None = None
    map_model: str | None = None


@dataclass(frozen=True)
class PolicyConfig(Settings):
    """A policy under comparison: how it chooses fixations, and which belief it uses.

    A setting that is null is taken from the `belief` settings of the run.

    Args:
        policy: name of a registered policy (`semfov.gaze.policies`), such as `saliency`, which fixates the most salient
            cell.
        scores: `raw` uses the detector's scores as likelihoods; `calibrated` passes them through the observation model
            first; `learned` uses the belief of the agent, with an observation model that was fitted through it: the
            semantic search in searches (`belief.search_model`), the semantic map in explorations (`belief.map_model`).
        tempering: exponent of the likelihoods.
        footprint: which cells a detection updates: `overlap`, `centre`, `box_centre` or `soft`.
        memory: fuse `all` looks, or keep only the evidence of the `closest` look at each cell.
        misses: also update cells in which nothing was detected.
        saliency: saliency map that `saliency` uses, or that another policy has as a prior over the cells: `vocus2`,
            `itti-koch`, or `people`, the density of fixations from the features of the detector (`FixationDensity`).
        samples: number of drawn looks for each class and level of distance, over which `predictive`, `kl`,
            `negative-entropy`, `surprise` and `two-peaks` take the expectation; null takes the look with the expected
            scores, as published. The observation model must be one of the densities of scores (`...-published`).
    """

    policy: str
    scores: Scores = "raw"
    tempering: Positive | None = None
    footprint: Footprint | None = None
    memory: CellMemory | None = None
    misses: bool | None = None
    saliency: SaliencyModel | None = None
    samples: Annotated[int, Range(1, 100_000)] | None = None


@dataclass(frozen=True)
class ProtocolConfig(Settings):
    """The protocol of the experiment.

    Args:
        starts: number of episodes per image (and per target, in searches), each from a different cell; no search starts
            on its target.
        shifts: number of gaze shifts per episode.
        ties: among equally good cells choose one at `random`, or the `first` by number.
        control: `none`; `wrong-class`: the searcher is given a randomly drawn wrong class, while the true class decides
            what counts as found; `permuted`: the cells that count as the target are drawn at random, as many as truly
            hold it.
        seed: random seed of starts and tie-breaking (docs/guides/evaluation.md says what it reproduces).
        batch: number of episodes computed together (does not change the result).
    """

    starts: Annotated[int, Range(1, 10_000)] = 10
    shifts: Shifts = 30
    ties: Literal["random", "first"] = "random"
    control: Literal["none", "wrong-class", "permuted"] = "none"
    seed: Seed = 0
    batch: Count = 1024


@dataclass(frozen=True)
class WorkConfig(Settings):
    """Settings of every run and every fit with a detector.

    Args:
        detector: the detector, which is applied to each view.
        out: folder of the outcomes.
        cache: folder for what is stored, shared between runs (None: the user's cache).
        workers: number of processes (None: one per CPU core).
        scheduler: address of a Dask scheduler whose workers do the work instead (docs/guides/cluster.md).
    """

    detector: DetectorConfig = field(default_factory=DetectorConfig)
    out: Path = Path("runs")
    cache: Path | None = None
    workers: Workers | None = None
    scheduler: str | None = None

    @property
    def where(self) -> Where:
        return self.workers if self.scheduler is None else self.scheduler


WHERE = ("out", "cache", "workers", "scheduler")  # settings of folders and processes, which do not change results


class EyeSettings(Protocol):
    """Protocol of settings of an eye and its scenes: an `EyeConfig`, or the settings of a fit."""

    @property
    def data(self) -> DataConfig:
        """The scenes."""

    @property
    def detector(self) -> DetectorConfig:
        """The detector."""

    @property
    def sensor(self) -> SensorConfig:
        """The sensor."""


@dataclass(frozen=True)
class EyeConfig(WorkConfig):
    """Looks at scenes through a fovea.

    Args:
        data: the scenes.
        sensor: the foveal sensor.
    """

    data: DataConfig = field(default_factory=DataConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)


@dataclass(frozen=True)
class LookingConfig(EyeConfig):
    """Looks at scenes from every cell of a grid.

    Args:
        belief: the belief, a grid of class distributions; its columns and rows are the cells.
        store: keep detections on disk; false computes them anew in each run (the result is the same).
    """

    belief: BeliefConfig = field(default_factory=BeliefConfig)
    store: bool = True

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the belief."""
        return self.belief.columns, self.belief.rows


@dataclass(frozen=True)
class RunConfig(LookingConfig):
    """Policies that choose among the cells of scenes, in the episodes of a protocol.

    Args:
        protocol: the protocol of the episodes.
        policies: the policies, each a preset by name or a mapping of settings (`PolicyConfig`).
    """

    task: ClassVar[Task] = "search"
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    policies: tuple[str | PolicyConfig, ...] = ("recommended",)

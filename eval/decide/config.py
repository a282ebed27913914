"""Settings of decisions."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from eval.search.config import SearchConfig
from semfov.decision import MOST
from semfov.runs.config import BeliefConfig, DataConfig, DetectorConfig, PolicyConfig, ProtocolConfig, SensorConfig
from semfov.runs.settings import Range, Settings, Share, Workers


@dataclass(frozen=True)
class DecidingConfig(Settings):
    """Settings of decisions.

    Args:
        confirm: the target counts as found when its probability reaches this value: at the place of a closer look, or
            in the image for a search without closer looks (None: the model's own threshold).
        give_up: a search gives up when, in every cell not fixated yet, the probability of the target is below this
            value (None: the model's own threshold).
        place: least probability of a cell that is worth a closer look, or, without closer looks, of the fixated cell
            for a find (None: the model's own threshold).
        closer: largest number of closer looks in a search; 0 decides without them.
        verification: model of verification, by name or file (None: the one of `models` if its agent uses it, or the
            one that is shipped for detector and sensor, if there is one).
    """

    confirm: Share | None = None
    give_up: Share | None = None
    place: Share | None = None
    closer: Annotated[int, Range(0, 100)] = MOST
    verification: str | None = None


@dataclass(frozen=True)
class DecisionConfig(DecidingConfig, SearchConfig):
    """Searches that end in a decision. `policies` is ignored."""

    policies: tuple[str | PolicyConfig, ...] = ("target-evidence",)


@dataclass(frozen=True)
class DecideConfig(DecidingConfig):
    """Search for present and for absent classes, each until a decision.

    Args:
        data: the scenes to search.
        detector: the detector, which is applied to each foveated view.
        sensor: the foveal sensor.
        belief: the belief, a grid of class distributions; `target_model` is the learned evidence.
        protocol: the protocol; `shifts` and `seed` are used.
        out: folder for tables, records and the figure.
        cache: folder for the stored detections from every cell, shared between runs (None: the user's cache).
        workers: number of processes (None: one per CPU core).
        models: folder written by `train.fit_detector`, which defines detector, sensor, grid, learned evidence and
            verification.
    """

    data: DataConfig = field(default_factory=DataConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    out: Path = Path("runs/decide")
    cache: Path | None = None
    workers: Workers | None = None
    models: Path | None = None

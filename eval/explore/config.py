"""Settings of scene exploration."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from semfov.gaze.policies import Task
from semfov.runs.config import PolicyConfig, ProtocolConfig, RunConfig


@dataclass(frozen=True)
class ExploreConfig(RunConfig):
    """Scene exploration: learn what is where by moving a fovea, and count the cells whose class is right.

    Args:
        policies: policies to compare, each a preset by name or a mapping of settings such as `{policy: kl, scores:
            calibrated, memory: closest}` (`PolicyConfig`). Presets: `recommended` (closer-look-learned), `published`
            (kl-calibrated); and `random`, `kl`, `negative-entropy`, `two-peaks`, `surprise`,
            `upper-confidence-bound`, `probability-of-improvement`, `expected-accuracy`, `closer-look`, `objects`,
            `vocus2` or `itti-koch`, each followed by `-raw` or `-calibrated`. With the learned map: `random-learned`,
            `closer-look-learned`, `objects-learned`, `expected-gain-learned`, `vocus2-learned` and
            `itti-koch-learned`.
        out: folder for tables, figures, per-episode records and the manifest.
    """

    task: ClassVar[Task] = "exploration"
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

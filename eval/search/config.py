"""Settings of visual search."""

from dataclasses import dataclass
from pathlib import Path

from semfov.runs.config import PolicyConfig, RunConfig
from semfov.runs.settings import Whole


@dataclass(frozen=True)
class SearchConfig(RunConfig):
    """Visual search: find a target class by moving a fovea, and count the gaze shifts that this takes.

    Args:
        policies: policies to compare, each a preset by name or a mapping of settings such as `{policy: non-predictive,
            scores: calibrated, tempering: 0.25}` (`PolicyConfig`). Presets: `recommended` (target-evidence),
            `published` (predictive-calibrated), `target-evidence`, `ivsn`, `random`, `vocus2`, `itti-koch`;
            and `non-predictive` (also called `maximum-a-posteriori`), `predictive`, `neighbourhood`, `foveal-hit`,
            `place-information`, `entropy-limit` or `ideal-observer`, each followed by `-raw` or `-calibrated`. The last
            four also take `-learned`, which uses the same evidence as `target-evidence`;
            `maximum-a-posteriori-learned` is `target-evidence` itself.
        templates: class templates of `ivsn`, by name or file (None: those shipped for the detector).
        out: folder for tables, figures, per-episode records and the manifest.
        scanpaths: number of episodes to draw as figures.
    """

    policies: tuple[str | PolicyConfig, ...] = (
        "random",
        "non-predictive-raw",
        "predictive-raw",
        "non-predictive-calibrated",
        "predictive-calibrated",
        "target-evidence",
    )
    templates: str | None = None
    out: Path = Path("runs/search")
    scanpaths: Whole = 3

    @property
    def class_templates(self) -> str | None:
        """Class templates of `ivsn`, by name or file; None takes those shipped for the detector."""
        return self.templates

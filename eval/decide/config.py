"""Settings of decisions."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Self

from eval.search.config import SearchConfig
from semfov.decision import MOST_CLOSER
from semfov.model_folder import ModelFolder
from semfov.runs.config import PolicyConfig, ProtocolConfig, ScenesConfig
from semfov.runs.settings import Range, Share


@dataclass(frozen=True)
class DecideConfig(ScenesConfig):
    """Search for present and for absent classes, each until a decision.

    Args:
        belief: the belief, a grid of class distributions; `target_model` is the learned evidence.
        protocol: the protocol; `shifts` and `seed` are used.
        confirm: the target counts as found when its probability reaches this value: at the place of a closer look, or
            in the image for a search without closer looks (None: the model's own threshold).
        give_up: a search gives up when, in every cell not fixated yet, the probability of the target is below this
            value (None: the model's own threshold).
        place: least probability of a cell that is worth a closer look, or, without closer looks, of the fixated cell
            for a find (None: the model's own threshold).
        closer: largest number of closer looks in a search; 0 decides without them.
        verification: model of verification, by name or file (None: the one of `models` if its agent uses it, or the
            one that is shipped for detector and sensor, if there is one).
        references: also search without closer looks, with random gaze and with the published belief, for which
            photographs are looked at from every cell, and look sharply at their quarters; without them the agent's
            looks and one sharp look suffice.
        out: folder for tables, records and the figure.
        models: folder written by `semfov fit`, which defines detector, sensor, grid, learned evidence and
            verification.
    """

    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    confirm: Share | None = None
    give_up: Share | None = None
    place: Share | None = None
    closer: Annotated[int, Range(0, 100)] = MOST_CLOSER
    verification: str | None = None
    references: bool = True
    out: Path = Path("runs/decide")
    models: Path | None = None


@dataclass(frozen=True)
class DecisionConfig(DecideConfig, SearchConfig):
    """Searches that end in a decision. `policies` is ignored."""

    policies: tuple[str | PolicyConfig, ...] = ("target-evidence",)

    def complete(self, folder: ModelFolder) -> Self:
        """The settings with the folder's model of verification, if its agent uses one and none is given explicitly."""
        if self.verification is not None or not folder.used("verification"):
            return self
        return replace(self, verification=str(folder.file("verification")))

"""Decide whether a target is present, where, and how surely: `python -m eval.decide` measures the agent's decisions.

    python -m eval.decide --data.root DIR --data.annotations instances.json --out runs/decide

Without photographs it uses the embedded scenes. In every photograph the agent searches for a class that is present and
for a class that is absent, until it decides. The tables give the area under the ROC curve of the final probability, hit
rates at several false alarm rates, and the decisions. For comparison they have the same belief with random gaze, the
published belief with the same thresholds and with the rule of the published agent, and one sharp look at the whole
photograph. Detections from every cell are stored and shared with `python -m eval.search`.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import torch

from semfov.errors import DataError
from semfov.experiments.command import run_command
from semfov.experiments.config import (
    BeliefConfig,
    DataConfig,
    DecidingConfig,
    DetectorConfig,
    ProtocolConfig,
    SensorConfig,
)
from semfov.experiments.decision_report import SHARES, telling
from semfov.experiments.decisions import (
    AGENT,
    LANDINGS,
    LANDINGS_TOLD,
    UNVERIFIED,
    DecisionConfig,
    DecisionRun,
    landing_cells,
)
from semfov.experiments.fitted import with_models
from semfov.experiments.parallel import rank
from semfov.experiments.parts import Record
from semfov.experiments.scene_run import finish, gather
from semfov.experiments.settings import Workers
from semfov.experiments.summary import announce, sensing
from semfov.experiments.tables import mean, share, table
from semfov.io.files import write_text
from semfov.metrics.calibration import calibration_error
from semfov.viz.presence import plot_roc
from semfov.viz.style import save_figure


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


def search_and_decide(config: DecideConfig) -> None:
    """Run the searches, and write their tables, records and ROC curves."""
    settings = {each.name: getattr(config, each.name) for each in fields(config)}
    run = DecisionRun(with_models(DecisionConfig(**settings)))
    finish(run, "deciding")
    if rank() > 0:
        return
    records, _ = gather(run)
    if not records:
        raise DataError("data: no scene has a class that may be searched for; raise data.max_target_area")
    text = summary(records, sensing(run))
    files = {"decisions.md": text, "episodes.jsonl": "".join(json.dumps(record) + "\n" for record in records)}
    for name, content in files.items():
        write_text(config.out / name, content)
    picture = save_figure(plot_roc(*probabilities(records)), config.out / "roc.png")
    announce(text, [*(config.out / name for name in files), picture])


def probabilities(records: Sequence[Record]) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Probability or score `(M,)` of presence by way to search, and whether the target is present, `(M,)`."""
    names = list(dict.fromkeys(record["policy"] for record in records))
    groups = {name: [record for record in records if record["policy"] == name] for name in names}
    first = groups[names[0]]
    told = {name: torch.tensor([record["probability"] for record in group]) for name, group in groups.items()}
    told["one sharp look, highest score"] = torch.tensor([record["sharp"] for record in first])
    told["sharp look and its quarters, highest score"] = torch.tensor([record["tiled"] for record in first])
    return told, torch.tensor([record["present"] for record in first])


def summary(records: Sequence[Record], sensed: str) -> str:
    """The tables, as Markdown."""
    names = list(dict.fromkeys(record["policy"] for record in records))
    groups = {name: [record for record in records if record["policy"] == name] for name in names}
    told, there = probabilities(records)
    rows = [["", "area under ROC", *(f"hits at {share:.0%}" for share in SHARES), "ECE"]]
    # The references give scores, not probabilities.
    errors = [f"{calibration_error(told[name], there):.3f}" if name in groups else "-" for name in told]
    rows += [[name, *figures, error] for name, figures, error in zip(told, telling(told, there), errors, strict=True)]
    decided = [["", "found, there", "found, not there", "undecided", "looks, there", "looks, not there", "place right",
                "expected", "IoU"]]  # fmt: skip
    for name, group in groups.items():
        present = [record for record in group if record["present"]]
        absent = [record for record in group if not record["present"]]
        found = [record for record in present if record["outcome"] == "found"]
        places = [record["right_place"] for record in group if record["outcome"] == "found"]
        expected = [100 * record["place"] for record in group if record["place"] is not None]
        decided.append(
            [
                name,
                share(len(found), len(present)),
                share(sum(record["outcome"] == "found" for record in absent), len(absent)),
                share(sum(record["outcome"] == "undecided" for record in group), len(group)),
                mean([record["looks"] for record in present]),
                mean([record["looks"] for record in absent]),
                share(sum(places), len(places)),
                mean(expected),
                mean([record["overlap"] for record in found if record["overlap"] is not None], 2),
            ]
        )
    decided.append(sharp_decisions(groups[names[0]]))
    closely = ""
    if UNVERIFIED in groups:
        each = mean([record["closer"] for record in groups[AGENT]], 2)
        closely = f" Closer looks count as looks; {AGENT} makes {each} of them in a search."
    return "\n".join(
        [
            f"Is the target present? {len(there)} searches ({sensed}), {int(there.sum())} of them for a present class. "
            "Hit rates in % at the given false alarm rates, and the expected calibration error (ECE) of the final "
            "probability.",
            "",
            *table(rows),
            "",
            f"Decisions in %, and mean numbers of looks.{closely} `place right`: the target overlaps the reported "
            "cell, in % of the searches that report one. `expected`: mean probability of these places by closer "
            "looks, in %. In the row with a detection at the gaze, a search ends when such a detection has a score of "
            "0.5 or more. All other searches end at thresholds. The threshold of the sharp look's score is chosen so "
            f"that it has as many hits as {names[0]}.",
            "",
            *table(decided),
            "",
            LANDINGS_TOLD,
            "",
            *table([["", *LANDINGS], *landings(groups)]),
            "",
        ]
    )


def sharp_decisions(records: Sequence[Record]) -> list[str]:
    """Row of one sharp look, with the threshold of its score chosen for as many hits as these searches have."""
    present = [record for record in records if record["present"]]
    hits = sum(record["outcome"] == "found" for record in present)
    least = sorted((record["sharp"] for record in present), reverse=True)[hits - 1] if hits else float("inf")
    told = [record for record in records if record["sharp"] >= least and record["sharp_place"] is not None]
    there = [record["sharp_place"]["overlap"] for record in told if record["present"]]
    return [
        "one sharp look",
        share(len(there), len(present)),
        share(len(told) - len(there), len(records) - len(present)),
        "-",
        "1.0",
        "1.0",
        share(sum(record["sharp_place"]["right"] for record in told), len(told)),
        "-",
        mean(there, 2),
    ]


def landings(groups: dict[str, list[Record]]) -> list[list[str]]:
    """Rows of the table about the first look on the target (`landing`)."""
    landed = {name: [each for each in group if each["landing"] is not None] for name, group in groups.items()}
    return [
        [name, *landing_cells([(each["landing"], each["landing_seen"]) for each in group])]
        for name, group in landed.items()
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(search_and_decide, DecideConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())

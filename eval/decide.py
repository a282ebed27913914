"""Is it there, where, and how sure: `python -m eval.decide` searches for what is there and for what is not.

    python -m eval.decide --data.root DIR --data.annotations instances.json --out runs/decide

Without photographs it uses the embedded scenes. In every photograph a class that is there and one that is not are
searched for until the agent decides. The table has the area under the ROC of the last probability, hits at some shares
of false alarms, and what came of the decisions; beside it the same belief under random gaze, the published belief by
the same rule and by that of its agent, and one sharp look at the whole photograph. What is seen from every cell is
shared with `python -m eval.search`.
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
    DetectorConfig,
    ProtocolConfig,
    SensorConfig,
)
from semfov.experiments.decision_report import SHARES, mean, percent, telling
from semfov.experiments.decisions import AGENT, LANDINGS, LANDINGS_TOLD, DecisionConfig, DecisionRun, landing_cells
from semfov.experiments.fitted import with_models
from semfov.experiments.parallel import rank
from semfov.experiments.parts import Record
from semfov.experiments.run import finish
from semfov.experiments.settings import Positive, Settings, Share, Workers
from semfov.experiments.summary import announce, gather, sensing, table
from semfov.io.files import write_text
from semfov.viz.presence import plot_roc
from semfov.viz.style import save_figure


@dataclass(frozen=True)
class DecideConfig(Settings):
    """Searches for what is there and for what is not, each until it decides.

    Args:
        data: which scenes to search.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        belief: the grid of beliefs; `target_model` is the learned evidence.
        protocol: gaze shifts, seed.
        confirm: probability that the image holds the target, from which on it counts as found (None: the model's).
        give_up: probability below which a cell is not worth a look (None: the model's).
        place: probability that the cell must have that is named (None: the model's).
        prices: of a look in right decisions; for each, searches that end when looking on is not worth it.
        out: folder for table and records.
        cache: folder for what was seen from every cell, shared between runs (None: the user's cache).
        workers: processes (None: one for each CPU core).
        models: folder of `train.fit_detector` that names detector, sensor, grid and learned evidence.
    """

    data: DataConfig = field(default_factory=DataConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    confirm: Share | None = None
    give_up: Share | None = None
    place: Share | None = None
    prices: tuple[Positive, ...] = (0.002, 0.005, 0.01, 0.02, 0.05)
    out: Path = Path("runs/decide")
    cache: Path | None = None
    workers: Workers | None = None
    models: Path | None = None


def search_and_decide(config: DecideConfig) -> None:
    """Run the searches and write their table and records."""
    settings = {each.name: getattr(config, each.name) for each in fields(config)}
    run = DecisionRun(with_models(DecisionConfig(**settings)))
    finish(run, "deciding")
    if rank() > 0:
        return
    records, _ = gather(run)
    if not records:
        raise DataError("data: no scene has a class that may be searched for; raise data.max_target_area")
    text = summary(records, sensing(run), config.prices)
    files = {"decisions.md": text, "episodes.jsonl": "".join(json.dumps(record) + "\n" for record in records)}
    for name, content in files.items():
        write_text(config.out / name, content)
    # Searches that differ in their price alone would only crowd the figure.
    scores, there = probabilities([record for record in records if not record["policy"].startswith("price")])
    picture = save_figure(plot_roc(scores, there), config.out / "roc.png")
    announce(text, [*(config.out / name for name in files), picture])


def probabilities(records: Sequence[Record]) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """What each way to search, and sharp looks, say of presence, `(M,)`, and whether the target is there, `(M,)`."""
    names = list(dict.fromkeys(record["policy"] for record in records))
    groups = {name: [record for record in records if record["policy"] == name] for name in names}
    first = groups[names[0]]
    told = {name: torch.tensor([record["probability"] for record in group]) for name, group in groups.items()}
    told["one sharp look, highest score"] = torch.tensor([record["sharp"] for record in first])
    told["sharp look and its quarters, highest score"] = torch.tensor([record["tiled"] for record in first])
    return told, torch.tensor([record["present"] for record in first])


def summary(records: Sequence[Record], sensed: str, prices: Sequence[float]) -> str:
    """The tables, as Markdown."""
    names = list(dict.fromkeys(record["policy"] for record in records))
    groups = {name: [record for record in records if record["policy"] == name] for name in names}
    told, there = probabilities(records)
    rows = [["", "area under ROC", *(f"hits at {share:.0%}" for share in SHARES)]]
    rows += [[name, *figures] for name, figures in zip(told, telling(told, there), strict=True)]
    decided = [["", "found, there", "found, not there", "undecided", "looks, there", "looks, not there", "place right",
                "IoU"]]  # fmt: skip
    for name, group in groups.items():
        present = [record for record in group if record["present"]]
        absent = [record for record in group if not record["present"]]
        found = [record for record in present if record["outcome"] == "found"]
        places = [record["right_place"] for record in group if record["outcome"] == "found"]
        decided.append(
            [
                name,
                percent(len(found), len(present)),
                percent(sum(record["outcome"] == "found" for record in absent), len(absent)),
                percent(sum(record["outcome"] == "undecided" for record in group), len(group)),
                mean([record["looks"] for record in present]),
                mean([record["looks"] for record in absent]),
                percent(sum(places), len(places)),
                mean([record["overlap"] for record in found if record["overlap"] is not None], 2),
            ]
        )
    decided.append(sharp_decisions(groups[names[0]]))
    return "\n".join(
        [
            f"Is the target there? {len(there)} searches ({sensed}), {int(there.sum())} for a class that is. "
            "Hits at a share of false alarms in %.",
            "",
            *table(rows),
            "",
            "Decisions in %, and mean looks; the place is right where the target overlaps the cell that is named, in "
            "all searches that name one. Rows with a price end when looking on is not worth that, in right decisions a "
            "look, and a detection at the gaze ends a search from a score of 0.5; the others end at thresholds. The "
            f"sharp look says found from the score that gives it as many hits as {names[0]} has.",
            "",
            *table(decided),
            "",
            LANDINGS_TOLD,
            "",
            *table([["", *LANDINGS], *landings(groups)]),
            "",
            *worth(groups, prices),
        ]
    )


def sharp_decisions(records: Sequence[Record]) -> list[str]:
    """What one sharp look says, at the score from which it has as many hits as these searches."""
    present = [record for record in records if record["present"]]
    hits = sum(record["outcome"] == "found" for record in present)
    least = sorted((record["sharp"] for record in present), reverse=True)[hits - 1] if hits else float("inf")
    told = [record for record in records if record["sharp"] >= least and record["sharp_place"] is not None]
    there = [record["sharp_place"]["overlap"] for record in told if record["present"]]
    return [
        "one sharp look",
        percent(len(there), len(present)),
        percent(len(told) - len(there), len(records) - len(present)),
        "-",
        "1.0",
        "1.0",
        percent(sum(record["sharp_place"]["right"] for record in told), len(told)),
        mean(there, 2),
    ]


def landings(groups: dict[str, list[Record]]) -> list[list[str]]:
    """Rows of the table of landings."""
    landed = {name: [each for each in group if each["landing"] is not None] for name, group in groups.items()}
    return [
        [name, *landing_cells([(each["landing"], each["landing_seen"]) for each in group])]
        for name, group in landed.items()
    ]


def worth(groups: dict[str, list[Record]], prices: Sequence[float]) -> list[str]:
    """Right decisions less the price of their looks, of searches by thresholds and of those by price."""
    if not prices:
        return []
    head = ["price of a look", "by thresholds", "by price"]
    rows = [head]
    for price in prices:
        names = (AGENT, f"price {price:g}")
        rows.append([f"{price:g}", *(f"{utility(groups[name], price):.4f}" for name in names)])
    return [
        "Mean worth of a search: 1 where the decision is right, less the price of its looks; undecided is not right.",
        "",
        *table(rows),
        "",
    ]


def utility(records: Sequence[Record], price: float) -> float:
    """Mean of 1 for each right decision less the price of the looks."""
    right = [record["outcome"] == ("found" if record["present"] else "absent") for record in records]
    looks = [record["looks"] for record in records]
    return sum(each - price * count for each, count in zip(right, looks, strict=True)) / len(records)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(search_and_decide, DecideConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())

"""Searches of large pictures for present and for absent classes, each until it reaches a decision."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch

from eval.comparison.telling import CALIBRATED, ERRORS_TEXT, FREQUENCY, TELLING, Telling, calibrated
from eval.decide.run import overlap
from semfov.agents.episode import EpisodeLimits, Goal
from semfov.agents.window_episode import WindowEpisode, WindowTask
from semfov.data.scene import Annotation
from semfov.decision import OUTCOMES
from semfov.metrics.calibration import BinarySums
from semfov.runs.results import ResultRecord
from semfov.runs.tables import mean_or_dash, share, table
from semfov.settings import DecisionSettings
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.looks import Window, WindowLooks

OURS, UNVERIFIED = "semfov", "semfov, without closer looks"
"""Names of searches with closer looks at places that seem to hold the target, and of searches without them."""


def decide_all(
    source: WindowLooks,
    evidence: GlimpseEvidence,
    classes: tuple[str, ...],
    targets: Sequence[int],
    annotation: Annotation,
    slices: Sequence[Window],
    *,
    passes: int,
    closer: int,
) -> list[ResultRecord]:
    """Search a picture until a decision, for each target, with closer looks and without them.

    Args:
        source: the looks at the picture.
        evidence: learned evidence by magnification.
        classes: names of the classes, background first.
        targets: classes to search for, 1..K.
        annotation: the annotated objects.
        slices: the slices of the picture.
        passes: largest number of passes of a search.
        closer: largest number of closer looks.

    Returns:
        Records for each target: the decision and, for comparison, the target's highest score in the overview, and in
        the overview and all slices. Evidence without fitted verification makes no closer looks.
    """
    slice_scores = torch.stack([look.show for look in source.see(slices)])
    records: list[ResultRecord] = []
    ways = {OURS: closer} if evidence.verification is None else {OURS: closer, UNVERIFIED: 0}
    for target, (way, most) in product(targets, ways.items()):
        task = WindowTask(Goal.of(classes, target), evidence, DecisionSettings(closer=most, prior="fit"))
        path = WindowEpisode(task, source, EpisodeLimits(passes)).run()
        decision = path.decision
        assert decision is not None
        there = annotation.boxes[annotation.labels == target]
        first = float(path.window_looks[0].show[target - 1])
        records.append(
            {
                "measure": "decision",
                "way": way,
                "target": classes[target],
                "present": len(there) > 0,
                "outcome": decision.outcome,
                "probability": decision.probability,
                "passes": path.passes,
                "overlap": overlap(decision.box, there),
                "overview": first,
                "slices": max(first, float(slice_scores[:, target - 1].max())),
                "count": len(slices) + 1,
            }
        )
    return records


def by_way(records: Sequence[ResultRecord]) -> dict[str, list[ResultRecord]]:
    """Read the records of each way of searching; all ways have the same searches in the same order."""
    ways: dict[str, list[ResultRecord]] = {}
    for record in records:
        ways.setdefault(record["way"], []).append(record)
    return ways


def presence_scores(records: Sequence[ResultRecord]) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Scores `(M,)` by name that predict whether the target is present, and whether it is, `(M,)`."""
    ways = by_way(records)
    by_name = {way: torch.tensor([record["probability"] for record in of]) for way, of in ways.items()}
    searches = next(iter(ways.values()))
    scores = {"the overview, highest score": "overview", "all slices, highest score": "slices", FREQUENCY: "frequency"}
    for name, key in scores.items():
        by_name[name] = torch.tensor([record[key] for record in searches])
    return by_name, torch.tensor([record["present"] for record in searches])


def decision_tables(records: Sequence[ResultRecord]) -> list[str]:
    """Tables of how well scores predict the target's presence, and of the decisions, as Markdown."""
    scores, there = presence_scores(records)
    ways = by_way(records)
    searches = next(iter(ways.values()))
    passes = {way: mean_or_dash([record["passes"] for record in of]) for way, of in ways.items()}
    passes["the overview, highest score"] = "1"
    passes["all slices, highest score"] = mean_or_dash([record["count"] for record in searches])
    passes[FREQUENCY] = "-"
    places = {way: torch.tensor([right_box(record) for record in of]) for way, of in ways.items()}
    telling = Telling(scores, there, [record["scene"] for record in searches], places)
    rows = [["", "passes", *TELLING, *CALIBRATED, "Brier"]]
    for (name, score), figures in zip(scores.items(), telling.rows(), strict=True):
        brier = f"{BinarySums.of(score, there).brier:.3f}"
        rows.append([name, passes[name], *figures, *calibrated(score, there), brier])
    decided = [["", "found", "box right", "absent", "undecided", "passes, mean", "probability, mean"]]
    for way, of in ways.items():
        for kind in (True, False):
            group = [r for r in of if r["present"] is kind]
            counts = [share(sum(r["outcome"] == each for r in group), len(group)) for each in OUTCOMES[1:]]
            right = telling.place(way) if kind else ""
            looks, chance = (
                mean_or_dash([r["passes"] for r in group]),
                mean_or_dash([r["probability"] for r in group], 2),
            )
            name = f"it is {'there' if kind else 'not'}{way.removeprefix(OURS)}"
            decided.append([name, counts[0], right, *counts[1:], looks, chance])
    return [
        f"Is the target present? {len(searches)} searches, {int(there.sum())} of them for a present class; hit rates "
        f"in % at the given false alarm rates. `semfov` is the probability at the end of a search. {ERRORS_TEXT} "
        f"`{FREQUENCY}`: the share of the other pictures that hold the class.",
        "",
        *table(rows),
        "",
        "Decisions in %, and the share of finds of present targets whose box is right (IoU 0.5).",
        "",
        *table(decided),
        "",
        f"The same searches compared with {OURS}, paired over pictures: differences of the area, and of the hit rates "
        "and the share of right boxes in percentage points.",
        "",
        *telling.differences(OURS),
        "",
    ]


def right_box(record: ResultRecord) -> float:
    """1 if the box of a find of a present target is right (IoU 0.5), 0 if it is wrong, and NaN without such a find."""
    found = record["present"] and record["outcome"] == "found"
    return float((record["overlap"] or 0) >= 0.5) if found else torch.nan

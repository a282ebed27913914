"""Searches of large pictures for present and for absent classes, each until it reaches a decision."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor

from eval.comparison.records import grouped
from eval.comparison.telling import CALIBRATED, ERRORS_TEXT, FREQUENCY, TELLING, Telling, calibrated
from eval.decide.run import overlap
from semfov.agents.episode import EpisodeLimits, Goal
from semfov.agents.window_episode import WindowEpisode, WindowTask
from semfov.data.scene import Annotation
from semfov.metrics.calibration import BinarySums
from semfov.runs.results import ResultRecord
from semfov.runs.tables import mean_or_dash, share, table
from semfov.settings import DecisionSettings
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.looks import Window, WindowLooks

OURS = "semfov"
"""Name of searches with closer looks at places that seem to hold the target."""

UNVERIFIED = f"{OURS}, without closer looks"
"""Name of searches without them."""

_OVERVIEW = "the overview, highest score"
_SLICES = "all slices, highest score"

_DECISIONS = ["", "found", "box right", "absent", "undecided", "passes, mean", "probability, mean"]
"""Column headings of the table of decisions."""


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
        the overview and all slices. Evidence without thresholds of places makes no closer looks.
    """
    slice_scores = torch.stack([look.show for look in source.see(slices)])
    records: list[ResultRecord] = []
    ways = {OURS: closer} if evidence.places is None else {OURS: closer, UNVERIFIED: 0}
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


def presence_scores(records: Sequence[ResultRecord]) -> tuple[dict[str, Tensor], Tensor]:
    """Compare what ways of searching and their references say of presence.

    Args:
        records: the searches of all ways.

    Returns:
        The probability or score of each way `(M,)`; and whether the target is present, `(M,)`.
    """
    ways = grouped(records, "way")  # all ways have the same searches in the same order
    searches = next(iter(ways.values()))
    scores = {way: torch.tensor([record["probability"] for record in group]) for way, group in ways.items()}
    for name, field in ((_OVERVIEW, "overview"), (_SLICES, "slices"), (FREQUENCY, "frequency")):
        scores[name] = torch.tensor([record[field] for record in searches])
    return scores, torch.tensor([record["present"] for record in searches])


def decision_tables(records: Sequence[ResultRecord]) -> list[str]:
    """Write the tables of how well scores predict the target's presence, and of the decisions, as Markdown."""
    scores, there = presence_scores(records)
    ways = grouped(records, "way")  # all ways have the same searches in the same order
    searches = next(iter(ways.values()))
    places = {way: torch.tensor([right_box(record) for record in group]) for way, group in ways.items()}
    telling = Telling(scores, there, [record["scene"] for record in searches], places)

    passes = {way: mean_or_dash([record["passes"] for record in group]) for way, group in ways.items()}
    passes[_OVERVIEW] = "1"
    passes[_SLICES] = mean_or_dash([record["count"] for record in searches])
    passes[FREQUENCY] = "-"
    rows = [["", "passes", *TELLING, *CALIBRATED, "Brier"]]
    for (name, score), figures in zip(scores.items(), telling.rows(), strict=True):
        brier = BinarySums.of(score, there).brier
        rows.append([name, passes[name], *figures, *calibrated(score, there), f"{brier:.3f}"])

    decided = [_DECISIONS]
    for way, group in ways.items():
        variant = way.removeprefix(OURS)
        present = [record for record in group if record["present"]]
        absent = [record for record in group if not record["present"]]
        decided.append(_decision_row(f"it is there{variant}", present, telling.place(way)))
        decided.append(_decision_row(f"it is not{variant}", absent, ""))
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


def _decision_row(name: str, searches: Sequence[ResultRecord], box_right: str) -> list[str]:
    """Write the cells of searches under `_DECISIONS`."""
    outcomes = Counter(record["outcome"] for record in searches)
    return [
        name,
        share(outcomes["found"], len(searches)),
        box_right,
        share(outcomes["absent"], len(searches)),
        share(outcomes["undecided"], len(searches)),
        mean_or_dash([record["passes"] for record in searches]),
        mean_or_dash([record["probability"] for record in searches], 2),
    ]


def right_box(record: ResultRecord) -> float:
    """Return 1 if the box of a find of a present target is right (IoU 0.5), 0 if not, and NaN without such a find."""
    if not record["present"] or record["outcome"] != "found":
        return torch.nan
    return float((record["overlap"] or 0) >= 0.5)

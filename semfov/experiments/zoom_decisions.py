"""Searches of large pictures for present and for absent classes, each until it reaches a decision."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from semfov.data.scene import Annotation
from semfov.experiments.decision_report import SHARES, mean, percent, telling
from semfov.experiments.decisions import overlap
from semfov.experiments.parts import Record
from semfov.experiments.summary import table
from semfov.metrics.calibration import BinarySums
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glances, Window
from semfov.zoom.search import search


def decide_all(
    glances: Glances,
    evidence: GlimpseEvidence,
    classes: tuple[str, ...],
    targets: Sequence[int],
    annotation: Annotation,
    slices: Sequence[Window],
    *,
    passes: int,
) -> list[Record]:
    """Search a picture until a decision, for each target.

    Args:
        glances: the looks at the picture.
        evidence: learned evidence by magnification.
        classes: names of the classes, background first.
        targets: classes to search for, 1..K.
        annotation: the annotated objects.
        slices: the slices of the picture.
        passes: largest number of passes of a search.

    Returns:
        A record for each target: the decision and, for comparison, the target's highest score in the overview, and in
        the overview and all slices.
    """
    shown = torch.stack([glance.show for glance in glances.see(slices)])
    records: list[Record] = []
    for target in targets:
        path = search(glances, evidence, classes, target, passes=passes)
        decision = path.decision
        assert decision is not None
        there = annotation.boxes[annotation.labels == target]
        first = float(path.glances[0].show[target - 1])
        records.append(
            {
                "measure": "decision",
                "way": "ours",
                "target": classes[target],
                "present": len(there) > 0,
                "outcome": decision.outcome,
                "probability": decision.probability,
                "passes": path.passes,
                "overlap": overlap(decision.box, there),
                "overview": first,
                "slices": max(first, float(shown[:, target - 1].max())),
                "count": len(slices) + 1,
            }
        )
    return records


def probabilities(records: Sequence[Record]) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Scores `(M,)` by name that predict whether the target is present, and whether it is, `(M,)`."""
    names = {"ours": "probability", "the overview, highest score": "overview", "all slices, highest score": "slices"}
    told = {name: torch.tensor([record[key] for record in records]) for name, key in names.items()}
    return told, torch.tensor([record["present"] for record in records])


def decision_tables(records: Sequence[Record]) -> list[str]:
    """Tables of how well scores predict the target's presence, and of the decisions, as Markdown."""
    told, there = probabilities(records)
    passes = {
        "ours": mean([record["passes"] for record in records]),
        "the overview, highest score": "1",
        "all slices, highest score": mean([record["count"] for record in records]),
    }
    rows = [["", "passes", "area under ROC", *(f"hits at {share:.0%}" for share in SHARES), "ECE", "Brier"]]
    for (name, score), figures in zip(told.items(), telling(told, there), strict=True):
        sums = BinarySums.of(score, there)
        rows.append([name, passes[name], *figures, f"{sums.ece:.3f}", f"{sums.brier:.3f}"])
    present, absent = ([r for r in records if r["present"] is kind] for kind in (True, False))
    decided = [["", "found", "absent", "undecided", "passes, mean", "probability, mean"]]
    for name, group in (("it is there", present), ("it is not", absent)):
        counts = [percent(sum(r["outcome"] == each for r in group), len(group)) for each in decided[0][1:4]]
        looks = mean([r["passes"] for r in group])
        decided.append([name, *counts, looks, mean([r["probability"] for r in group], 2)])
    found = [r for r in present if r["outcome"] == "found"]
    right = percent(sum((r["overlap"] or 0) >= 0.5 for r in found), len(found))
    return [
        f"Is the target present? {len(records)} searches, {len(present)} of them for a present class; hit rates in % "
        "at the given false alarm rates. `ours` is the probability at the end of a search.",
        "",
        *table(rows),
        "",
        f"Decisions in %. Among the finds of present targets, the reported box is right (IoU 0.5) in {right} %.",
        "",
        *table(decided),
        "",
    ]

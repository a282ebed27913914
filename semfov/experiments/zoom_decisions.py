"""Searches of large pictures for what is there and for what is not, each until it decides."""

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
    """What searches of a picture decide, beside the highest score of its overview, and of all slices and the overview.

    Args:
        glances: of the picture.
        evidence: learned, by magnification.
        classes: names, background first.
        targets: classes to search for, 1..K.
        annotation: what is really there.
        slices: of the picture.
        passes: of a search, at most.
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
    """What tells whether the target is there, `(M,)` each, and whether it is, `(M,)`."""
    names = {"ours": "probability", "the overview, highest score": "overview", "all slices, highest score": "slices"}
    told = {name: torch.tensor([record[key] for record in records]) for name, key in names.items()}
    return told, torch.tensor([record["present"] for record in records])


def decision_tables(records: Sequence[Record]) -> list[str]:
    """How well presence is told, and what was decided, as Markdown."""
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
        f"Is it there? {len(records)} searches, {len(present)} for a class that is; hits at a share of false alarms in "
        "%. Ours is the probability that a search ends with.",
        "",
        *table(rows),
        "",
        f"Decisions in %. Of what was found and is there, the box that is named is right (IoU 0.5) in {right} %.",
        "",
        *table(decided),
        "",
    ]

"""Tables of decisions."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from eval.decide.run import AGENT, LANDINGS, LANDINGS_TOLD, UNVERIFIED, landing_cells
from semfov.metrics.calibration import calibration_error
from semfov.metrics.presence import area_under_roc, hits_at
from semfov.runs.results import ResultRecord
from semfov.runs.tables import mean_or_dash, share, table

SHARES = (0.01, 0.02, 0.05)
"""False alarm rates at which the tables give the hit rate."""


def telling(told: Mapping[str, Tensor], there: Tensor) -> list[list[str]]:
    """How well scores tell whether the target is present.

    Args:
        told: scores `(M,)` of the searches, by name.
        there: `(M,)` boolean, whether the target is present.

    Returns:
        A row for each name: area under the ROC curve, then hit rates in percent at the false alarm rates `SHARES`.
    """
    if not there.any() or there.all():
        return [["-"] * (1 + len(SHARES)) for _ in told]
    return [
        [f"{area_under_roc(score, there):.3f}", *(f"{100 * hits_at(score, there, share):.0f}" for share in SHARES)]
        for score in told.values()
    ]


def probabilities(records: Sequence[ResultRecord]) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Probability or score `(M,)` of presence by way to search, and whether the target is present, `(M,)`."""
    names = list(dict.fromkeys(record["policy"] for record in records))
    groups = {name: [record for record in records if record["policy"] == name] for name in names}
    first = groups[names[0]]
    told = {name: torch.tensor([record["probability"] for record in group]) for name, group in groups.items()}
    told["one sharp look, highest score"] = torch.tensor([record["sharp"] for record in first])
    told["sharp look and its quarters, highest score"] = torch.tensor([record["tiled"] for record in first])
    return told, torch.tensor([record["present"] for record in first])


def decision_summary(records: Sequence[ResultRecord], sensed: str) -> str:
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
                mean_or_dash([record["looks"] for record in present]),
                mean_or_dash([record["looks"] for record in absent]),
                share(sum(places), len(places)),
                mean_or_dash(expected),
                mean_or_dash([record["overlap"] for record in found if record["overlap"] is not None], 2),
            ]
        )
    decided.append(sharp_decisions(groups[names[0]]))
    closely = ""
    if UNVERIFIED in groups:
        each = mean_or_dash([record["closer"] for record in groups[AGENT]], 2)
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
            *table([["", *LANDINGS], *landing_rows(groups)]),
            "",
        ]
    )


def sharp_decisions(records: Sequence[ResultRecord]) -> list[str]:
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
        mean_or_dash(there, 2),
    ]


def landing_rows(groups: dict[str, list[ResultRecord]]) -> list[list[str]]:
    """Rows of the table about the first look on the target (`landing`)."""
    landed = {name: [each for each in group if each["landing"] is not None] for name, group in groups.items()}
    return [
        [name, *landing_cells([(each["landing"], each["landing_seen"]) for each in group])]
        for name, group in landed.items()
    ]

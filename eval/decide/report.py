"""Tables of decisions."""

from collections.abc import Sequence

import torch
from torch import Tensor

from eval.comparison.telling import CALIBRATED, ERRORS_TEXT, FREQUENCY, TELLING, Telling, calibrated
from eval.decide.plain import PLAIN, plain_rules
from eval.decide.run import LANDINGS, LANDINGS_TEXT, landing_cells
from semfov.runs.presets import AGENT
from semfov.runs.results import ResultRecord
from semfov.runs.tables import mean_or_dash, share, table

SHARP = "one unfoveated pass, highest score"
"""Name of the highest score of the target in a sharp look at the whole scene."""


def probabilities(records: Sequence[ResultRecord]) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Probability or score `(M,)` of presence by way to search, and whether the target is present, `(M,)`."""
    names = list(dict.fromkeys(record["policy"] for record in records))
    groups = {name: [record for record in records if record["policy"] == name] for name in names}
    first = groups[names[0]]
    scores = {name: torch.tensor([record["probability"] for record in group]) for name, group in groups.items()}
    scores[SHARP] = torch.tensor([record["sharp"] for record in first])
    if first[0]["tiled"] is not None:
        scores["unfoveated pass and its quarters, highest score"] = torch.tensor([record["tiled"] for record in first])
    if first[0]["plain"] is not None:
        scores |= {name: rule[0] for name, rule in plain_rules(first).items()}
    scores[FREQUENCY] = torch.tensor([record["frequency"] for record in first])
    return scores, torch.tensor([record["present"] for record in first])


def decision_summary(records: Sequence[ResultRecord], sensed: str) -> str:
    """Write the tables, as Markdown."""
    names = list(dict.fromkeys(record["policy"] for record in records))
    groups = {name: [record for record in records if record["policy"] == name] for name in names}
    scores, there = probabilities(records)
    first = groups[names[0]]
    places = {name: torch.tensor([reported(record) for record in group]) for name, group in groups.items()}
    plain = plain_decisions(first)
    places |= {SHARP: sharp_places(first), **{name: right for name, (right, _) in plain.items()}}
    telling = Telling(scores, there, [record["scene"] for record in first], places)
    rows = [["", *TELLING, *CALIBRATED]]
    # The other references give scores, not probabilities.
    sure = {*groups, *plain}
    errors = [calibrated(scores[name], there) if name in sure else ["-", "-"] for name in scores]
    rows += [[name, *figures, *error] for name, figures, error in zip(scores, telling.rows(), errors, strict=True)]
    decided = [["", "hit rate", "false-alarm rate", "undecided", "looks, target present", "looks, target absent",
                "place right", "expected", "IoU"]]  # fmt: skip
    for name, group in groups.items():
        present = [record for record in group if record["present"]]
        absent = [record for record in group if not record["present"]]
        found = [record for record in present if record["outcome"] == "found"]
        expected = [100 * record["place"] for record in group if record["place"] is not None]
        decided.append(
            [
                name,
                share(len(found), len(present)),
                share(sum(record["outcome"] == "found" for record in absent), len(absent)),
                share(sum(record["outcome"] == "undecided" for record in group), len(group)),
                mean_or_dash([record["looks"] for record in present]),
                mean_or_dash([record["looks"] for record in absent]),
                telling.place(name),
                mean_or_dash(expected),
                mean_or_dash([record["overlap"] for record in found if record["overlap"] is not None], 2),
            ]
        )
    decided.append(sharp_decisions(first, telling.place(SHARP)))
    for name, (right, passes) in plain.items():
        finds = ~right.isnan()
        shares = ["-", "-"]  # without closer looks nothing is found
        if PLAIN[name]:
            shares = [share(int((finds & kind).sum()), int(kind.sum())) for kind in (there, ~there)]
        means = [mean_or_dash(passes[kind].tolist()) for kind in (there, ~there)]
        decided.append([name, *shares, "-", *means, telling.place(name) if bool(finds.any()) else "-", "-", "-"])
    closely = ""
    if any(record["closer"] for record in groups.get(AGENT, [])):
        each = mean_or_dash([record["closer"] for record in groups[AGENT]], 2)
        closely = f" Closer looks count as looks; {AGENT} makes {each} of them in a search."
    return "\n".join(
        [
            f"Is the target present? {len(there)} searches ({sensed}), {int(there.sum())} of them for a present class. "
            "Hit rates in % at the given false alarm rates, and the expected calibration error (ECE) of the final "
            f"probability. {ERRORS_TEXT} `{FREQUENCY}`: the share of the other scenes that hold the class; absent "
            "classes are drawn with equal probability.",
            "",
            *table(rows),
            "",
            f"Decisions in %, and mean numbers of looks.{closely} `place right`: the target overlaps the reported "
            "cell, in % of the searches that report one. `expected`: mean probability of these places by closer "
            "looks, in %. In the row with a detection at the gaze, a search ends when such a detection has a score of "
            "0.5 or more. All other searches end at thresholds. Those of the sharp look's score and of the plain rules "
            f"are chosen so that they have as many hits as {names[0]}.",
            "",
            *table(decided),
            "",
            f"The same searches compared with {names[0]}, paired over scenes: differences of the area, and of the hit "
            "rates and the share of right places in percentage points.",
            "",
            *telling.differences(names[0]),
            "",
            LANDINGS_TEXT,
            "",
            *table([["", *LANDINGS], *landing_rows(groups)]),
            "",
        ]
    )


def plain_decisions(records: Sequence[ResultRecord]) -> dict[str, tuple[Tensor, Tensor]]:
    """By plain rule, right places as in `reported`, with as many hits as the searches have, and passes; each `(M,)`."""
    if records[0]["plain"] is None:
        return {}
    there = torch.tensor([record["present"] for record in records])
    hits = sum(record["outcome"] == "found" for record in records if record["present"])
    decisions = {}
    for name, (_, place, right, passes) in plain_rules(records).items():
        ranked = place[there].sort(descending=True).values
        least = float(ranked[hits - 1]) if hits and float(ranked[hits - 1]) > 0 else float("inf")
        decisions[name] = torch.where(place >= least, (right & there).float(), torch.nan), passes
    return decisions


def reported(record: ResultRecord) -> float:
    """1 if a search has found the target at the right place, 0 at a wrong one, and NaN if it has not found it."""
    return float(record["right_place"]) if record["outcome"] == "found" else torch.nan


def sharp_finds(records: Sequence[ResultRecord]) -> list[bool]:
    """Whether a sharp look reports the target, with a threshold of its score for as many hits as the searches have."""
    present = [record for record in records if record["present"]]
    hits = sum(record["outcome"] == "found" for record in present)
    least = sorted((record["sharp"] for record in present), reverse=True)[hits - 1] if hits else float("inf")
    return [record["sharp"] >= least and record["sharp_place"] is not None for record in records]


def sharp_places(records: Sequence[ResultRecord]) -> Tensor:
    """Return the same as `reported` for one unfoveated pass, `(M,)`."""
    pairs = zip(records, sharp_finds(records), strict=True)
    return torch.tensor([float(record["sharp_place"]["right"]) if found else torch.nan for record, found in pairs])


def sharp_decisions(records: Sequence[ResultRecord], place: str) -> list[str]:
    """Row of one unfoveated pass (`sharp_finds`), whose share of right places is `place`."""
    finds = [record for record, found in zip(records, sharp_finds(records), strict=True) if found]
    there = [record["sharp_place"]["overlap"] for record in finds if record["present"]]
    present = sum(record["present"] for record in records)
    return [
        "one unfoveated pass",
        share(len(there), present),
        share(len(finds) - len(there), len(records) - present),
        "-",
        "1.0",
        "1.0",
        place,
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

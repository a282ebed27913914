"""Tables of decisions."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from eval.comparison.records import grouped
from eval.comparison.telling import CALIBRATED, ERRORS_TEXT, FREQUENCY, TELLING, Telling, calibrated
from eval.decide.plain import PLAIN, PlainDecisions, plain_rules
from eval.decide.run import LANDINGS, LANDINGS_TEXT, landing_cells
from semfov.runs.presets import AGENT
from semfov.runs.results import ResultRecord
from semfov.runs.tables import mean_or_dash, share, table

SHARP = "one unfoveated pass, highest score"
"""Name of the highest score of the target in a sharp look at the whole scene."""

_TILED = "unfoveated pass and its quarters, highest score"

_DECISIONS = [
    "",
    "hit rate",
    "false-alarm rate",
    "undecided",
    "looks, target present",
    "looks, target absent",
    "place right",
    "expected",
    "IoU",
]
"""Column headings of the table of decisions."""


def probabilities(records: Sequence[ResultRecord]) -> tuple[dict[str, Tensor], Tensor]:
    """Compare what ways to search and their references say of presence.

    Args:
        records: the searches of all ways.

    Returns:
        By way to search, the probability or score of presence `(M,)`; and whether the target is present, `(M,)`.
    """
    groups = grouped(records, "policy")  # all ways make the same searches, in the same order
    searches = next(iter(groups.values()))
    scores = {name: torch.tensor([record["probability"] for record in group]) for name, group in groups.items()}
    scores[SHARP] = torch.tensor([record["sharp"] for record in searches])
    if searches[0]["tiled"] is not None:
        scores[_TILED] = torch.tensor([record["tiled"] for record in searches])
    scores |= {name: decisions.presence for name, decisions in plain_rules(searches).items()}
    scores[FREQUENCY] = torch.tensor([record["frequency"] for record in searches])
    return scores, torch.tensor([record["present"] for record in searches])


def decision_summary(records: Sequence[ResultRecord], sensed: str) -> str:
    """Write the tables of presence, decisions, differences and landings.

    Args:
        records: the searches of all ways.
        sensed: the sensor and the grid, in words.

    Returns:
        The tables, as Markdown.
    """
    groups = grouped(records, "policy")  # all ways make the same searches, in the same order
    reference = next(iter(groups))  # the way with which the others are compared
    searches = groups[reference]
    plain = plain_rules(searches)
    scores, there = probabilities(records)
    right = {name: torch.tensor([reported(record) for record in group]) for name, group in groups.items()}
    right[SHARP] = sharp_places(searches)
    right |= {name: plain_places(decisions, searches) for name, decisions in plain.items()}
    telling = Telling(scores, there, [record["scene"] for record in searches], right)

    presence = [["", *TELLING, *CALIBRATED]]
    for name, figures in zip(scores, telling.rows(), strict=True):
        # The other references give scores, not probabilities.
        is_probability = name in groups or name in plain
        errors = calibrated(scores[name], there) if is_probability else ["-", "-"]
        presence.append([name, *figures, *errors])

    decided = [_DECISIONS]
    decided += [decision_row(name, group, telling.place(name)) for name, group in groups.items()]
    decided.append(sharp_decisions(searches, telling.place(SHARP)))
    for name, decisions in plain.items():
        decided.append(plain_row(name, decisions, right[name], there, telling.place(name)))
    return "\n".join(
        [
            f"Is the target present? {len(there)} searches ({sensed}), {int(there.sum())} of them for a present class. "
            "Hit rates in % at the given false alarm rates, and the expected calibration error (ECE) of the final "
            f"probability. {ERRORS_TEXT} `{FREQUENCY}`: the share of the other scenes that hold the class; absent "
            "classes are drawn with equal probability.",
            "",
            *table(presence),
            "",
            f"Decisions in %, and mean numbers of looks.{_closer_looks_text(groups)} `place right`: the target "
            "overlaps the reported cell, in % of the searches that report one. `expected`: mean probability of these "
            "places by closer looks, in %. In the row with a detection at the gaze, a search ends when such a "
            "detection has a score of 0.5 or more. All other searches end at thresholds. Those of the sharp look's "
            f"score and of the plain rules are chosen so that they have as many hits as {reference}.",
            "",
            *table(decided),
            "",
            f"The same searches compared with {reference}, paired over scenes: differences of the area, and of the hit "
            "rates and the share of right places in percentage points.",
            "",
            *telling.differences(reference),
            "",
            LANDINGS_TEXT,
            "",
            *table([["", *LANDINGS], *landing_rows(groups)]),
            "",
        ]
    )


def _closer_looks_text(groups: Mapping[str, Sequence[ResultRecord]]) -> str:
    """Say how many closer looks the agent makes; nothing if it makes none."""
    closer = [record["closer"] for record in groups.get(AGENT, [])]
    if not any(closer):
        return ""
    return f" Closer looks count as looks; {AGENT} makes {mean_or_dash(closer, 2)} of them in a search."


def decision_row(name: str, searches: Sequence[ResultRecord], place: str) -> list[str]:
    """Write the cells of a way to search under `_DECISIONS`, whose share of right places is `place`."""
    present = [record for record in searches if record["present"]]
    absent = [record for record in searches if not record["present"]]
    hits = [record for record in present if record["outcome"] == "found"]
    false_alarms = [record for record in absent if record["outcome"] == "found"]
    undecided = [record for record in searches if record["outcome"] == "undecided"]
    return [
        name,
        share(len(hits), len(present)),
        share(len(false_alarms), len(absent)),
        share(len(undecided), len(searches)),
        mean_or_dash([record["looks"] for record in present]),
        mean_or_dash([record["looks"] for record in absent]),
        place,
        mean_or_dash([100 * record["place"] for record in searches if record["place"] is not None]),
        mean_or_dash([record["overlap"] for record in hits if record["overlap"] is not None], 2),
    ]


def plain_row(name: str, decisions: PlainDecisions, right: Tensor, there: Tensor, place: str) -> list[str]:
    """Write the cells of a plain rule under `_DECISIONS`.

    Args:
        name: its name.
        decisions: what it says of M searches.
        right: `(M,)`, its right places (`plain_places`).
        there: `(M,)`, whether the target is there.
        place: share of right places.
    """
    hit_rate = "-"  # without closer looks nothing is found
    false_alarm_rate = "-"
    if PLAIN[name]:
        finds = ~right.isnan()
        hit_rate = share(int((finds & there).sum()), int(there.sum()))
        false_alarm_rate = share(int((finds & ~there).sum()), int((~there).sum()))
    passes_present = mean_or_dash(decisions.passes[there].tolist())
    passes_absent = mean_or_dash(decisions.passes[~there].tolist())
    return [name, hit_rate, false_alarm_rate, "-", passes_present, passes_absent, place, "-", "-"]


def plain_places(decisions: PlainDecisions, searches: Sequence[ResultRecord]) -> Tensor:
    """Return the same as `reported` for a plain rule that has as many hits as the searches, `(M,)`."""
    there = torch.tensor([record["present"] for record in searches])
    threshold = _score_for_hits(decisions.place[there].tolist(), _hits(searches))
    # A probability of 0 is that of no place.
    finds = (decisions.place >= threshold) & (threshold > 0)
    return torch.where(finds, (decisions.right & there).float(), torch.nan)


def reported(record: ResultRecord) -> float:
    """Return 1 if a search has found the target at the right place, 0 at a wrong one, and NaN without a find."""
    return float(record["right_place"]) if record["outcome"] == "found" else torch.nan


def _hits(searches: Sequence[ResultRecord]) -> int:
    """Count the present targets that searches have found."""
    return sum(record["outcome"] == "found" for record in searches if record["present"])


def _score_for_hits(scores: Sequence[float], hits: int) -> float:
    """Find the threshold with which scores of present targets give a number of hits; infinite for none."""
    if hits == 0:
        return math.inf
    return sorted(scores, reverse=True)[hits - 1]


def sharp_finds(records: Sequence[ResultRecord]) -> list[bool]:
    """Tell whether a sharp look reports the target, with a threshold for as many hits as the searches have."""
    threshold = _score_for_hits([record["sharp"] for record in records if record["present"]], _hits(records))
    return [record["sharp"] >= threshold and record["sharp_place"] is not None for record in records]


def sharp_places(records: Sequence[ResultRecord]) -> Tensor:
    """Return the same as `reported` for one unfoveated pass, `(M,)`."""
    right = torch.full((len(records),), torch.nan)
    for number, found in enumerate(sharp_finds(records)):
        if found:
            right[number] = float(records[number]["sharp_place"]["right"])
    return right


def sharp_decisions(records: Sequence[ResultRecord], place: str) -> list[str]:
    """Write the cells of one unfoveated pass (`sharp_finds`), whose share of right places is `place`."""
    finds = [record for record, found in zip(records, sharp_finds(records), strict=True) if found]
    overlaps_of_hits = [record["sharp_place"]["overlap"] for record in finds if record["present"]]
    hits = len(overlaps_of_hits)
    present = sum(record["present"] for record in records)
    return [
        "one unfoveated pass",
        share(hits, present),
        share(len(finds) - hits, len(records) - present),
        "-",
        "1.0",
        "1.0",
        place,
        "-",
        mean_or_dash(overlaps_of_hits, 2),
    ]


def landing_rows(groups: Mapping[str, Sequence[ResultRecord]]) -> list[list[str]]:
    """Write the rows of the table about the first look on the target (`landing`)."""
    rows = []
    for name, group in groups.items():
        landings = [(record["landing"], record["landing_seen"]) for record in group if record["landing"] is not None]
        rows.append([name, *landing_cells(landings)])
    return rows

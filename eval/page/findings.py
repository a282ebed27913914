"""Whether the paper's findings hold here: for each finding, numbers and a verdict by detector and fovea."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.page.curves import behind, difference, per_image, records_of, spans
from eval.page.tables import Runs, published_columns
from semfov.metrics.averages import FloatArray
from semfov.runs.tables import table

LAST = {"search": 30, "explore": 20}

Answer = Callable[[Path], str]


@dataclass(frozen=True)
class Finding:
    """A finding of the paper.

    Attributes:
        text: the finding.
        kind: kind of the experiment that tests it.
        shown: description of the numbers.
        answer: gives numbers and verdict for the folder of a run.
    """

    text: str
    kind: str
    shown: str
    answer: Answer


def gain(one: str, other: str, shifts: tuple[int, ...], kind: str, *, expected: int = 1) -> Answer:
    """Test whether the paired difference of two policies has the expected sign.

    A sign holds if the difference is more than two standard errors away from zero; otherwise the policies are level.

    Args:
        one: the first policy.
        other: the policy that is subtracted.
        shifts: gaze shifts at which the policies are compared.
        kind: kind of the experiment.
        expected: 1 if the finding is that the first policy is better, 0 if it is that the two are level.

    Returns:
        A function that gives the differences in percentage points and a verdict.
    """

    def answer(folder: Path) -> str:
        mean, error = paired_difference(folder, one, other, kind)
        figures = " / ".join(f"{100 * mean[n]:+.1f}" for n in shifts)
        signs = {int(np.sign(mean[n])) if abs(mean[n]) > 2 * error[n] else 0 for n in shifts}
        return f"{figures}: {verdict(signs, expected)}"

    return answer


def verdict(signs: set[int], expected: int) -> str:
    """The verdict on a finding.

    Args:
        signs: the signs of the differences; 0 for a difference within two standard errors of zero.
        expected: the sign that the finding claims.

    Returns:
        The verdict.

    >>> verdict({1}, 1), verdict({1, 0}, 1), verdict({0}, 1), verdict({-1}, 1), verdict({-1, 0}, 1), verdict({0}, 0)
    ('holds', 'holds in part', 'level', 'reversed', 'reversed in part', 'holds')
    """
    if signs == {expected}:
        return "holds"
    if expected == 0:
        return "does not hold"
    words = {
        frozenset({0}): "level",
        frozenset({-expected}): "reversed",
        frozenset({expected, 0}): "holds in part",
        frozenset({-expected, 0}): "reversed in part",
    }
    return words.get(frozenset(signs), "mixed")


def overtaken(policy: str, baseline: str, kind: str) -> Answer:
    """Test whether a policy first leads its baseline and is then overtaken, each by more than two standard errors."""

    def answer(folder: Path) -> str:
        mean, error = paired_difference(folder, policy, baseline, kind)
        leads, trails = behind(-mean, error), behind(mean, error)
        first = bool(leads) and (not trails or leads[0] < trails[0])
        told = f"ahead at {spans(leads) or 'no shift'}, behind at {spans(trails) or 'no shift'}"
        return f"{told}: {'holds' if first and trails else 'leads, not overtaken' if first else 'does not hold'}"

    return answer


def paired_difference(folder: Path, one: str, other: str, kind: str) -> tuple[FloatArray, FloatArray]:
    """Paired difference of two policies of a run; for searches over all legal targets, of which there are most."""
    curves = [per_image(records_of(folder, policy), LAST[kind]) for policy in (one, other)]
    return difference(*curves)


SEARCH, EXPLORE = (5, 15, 30), (1, 5, 15)

FINDINGS = (
    Finding(
        "Calibration is considerably beneficial for non-predictive search.",
        "search",
        "calibrated less raw at 5 / 15 / 30 shifts",
        gain("non-predictive-calibrated", "non-predictive-raw", SEARCH, "search"),
    ),
    Finding(
        "Calibration does not influence predictive search.",
        "search",
        "calibrated less raw at 5 / 15 / 30 shifts",
        gain("predictive-calibrated", "predictive-raw", SEARCH, "search", expected=0),
    ),
    Finding(
        "Predictive search comfortably outperforms non-predictive search on raw scores",
        "search",
        "predictive less non-predictive at 5 / 15 / 30 shifts",
        gain("predictive-raw", "non-predictive-raw", SEARCH, "search"),
    ),
    Finding(
        "… and on calibrated scores.",
        "search",
        "the same",
        gain("predictive-calibrated", "non-predictive-calibrated", SEARCH, "search"),
    ),
    Finding(
        "Calibrated predictive search leads random gaze at first (to the 13th iteration) and is overtaken",
        "search",
        "gaze shifts",
        overtaken("predictive-calibrated", "random", "search"),
    ),
    Finding(
        "… calibrated non-predictive search too (to the 10th),",
        "search",
        "gaze shifts",
        overtaken("non-predictive-calibrated", "random", "search"),
    ),
    Finding(
        "… and raw non-predictive search.",
        "search",
        "gaze shifts",
        overtaken("non-predictive-raw", "random", "search"),
    ),
    Finding(
        "VOCUS2 is far below random gaze in search.",
        "search",
        "random less VOCUS2 at 5 / 15 / 30 shifts",
        gain("random", "vocus2", SEARCH, "search"),
    ),
    Finding(
        "KL divergence consistently outperforms negative entropy (calibrated).",
        "explore",
        "KL less negative entropy at 1 / 5 / 15 shifts",
        gain("kl-calibrated", "negative-entropy-calibrated", EXPLORE, "explore"),
    ),
    Finding(
        "KL divergence collects more in the first iterations than the two-peak difference (calibrated).",
        "explore",
        "KL less two-peak at 1 / 2 / 4 shifts",
        gain("kl-calibrated", "two-peaks-calibrated", (1, 2, 4), "explore"),
    ),
    Finding(
        "KL divergence outperforms VOCUS2 in exploration (calibrated).",
        "explore",
        "KL less VOCUS2 at 1 / 5 / 15 shifts",
        gain("kl-calibrated", "vocus2-calibrated", EXPLORE, "explore"),
    ),
    Finding(
        "KL divergence leads random gaze at first; random gaze overtakes it after about 4 saccades (calibrated).",
        "explore",
        "gaze shifts",
        overtaken("kl-calibrated", "random-calibrated", "explore"),
    ),
    Finding("The same with raw scores.", "explore", "gaze shifts", overtaken("kl-raw", "random-raw", "explore")),
    Finding(
        "Exploration has no particular advantage from calibration.",
        "explore",
        "KL, calibrated less raw at 1 / 5 / 15 shifts",
        gain("kl-calibrated", "kl-raw", EXPLORE, "explore", expected=0),
    ),
)
"""Findings that can be tested on curves; costs are measured by `python -m benchmarks.decisions`."""


def findings(runs: Runs) -> list[str]:
    """The table of all findings."""
    folders = {kind: published_columns(kind, runs) for kind in LAST}
    rows = [["the paper finds", "shown", *folders["search"]]]
    for finding in FINDINGS:
        answers = [finding.answer(folder) for folder in folders[finding.kind].values()]
        rows.append([finding.text, finding.shown, *answers])
    return table(rows)

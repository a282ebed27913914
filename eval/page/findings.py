"""The paper's findings, and whether they hold here: sizes and verdicts by detector, fovea and measure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.page import paper
from eval.page.curves import OBJECTS, behind, corrected_signs, paired_difference, points, spans
from eval.page.experiments import DETECTORS
from eval.page.tables import Runs, published_columns
from semfov.metrics.episodes import FloatArray
from semfov.runs.tables import table

LAST = {"search": 30, "explore": 20}

_NO_DETECTOR = ("random", "vocus2")
"""Policies that use no detector."""


@dataclass(frozen=True)
class Answer:
    """The answer of a run to a finding."""

    sizes: str
    verdict: str

    def __str__(self) -> str:
        return f"{self.sizes}: {self.verdict}"


VERDICTS = {
    "holds": "every difference is as the finding says, or the policy is first ahead and later behind",
    "holds in part": "some differences have the sign, and none the opposite one",
    "not overtaken": "ahead at some shifts, and behind at none",
    "level": "every difference is within two standard errors of zero",
    "open": "some difference is beyond two standard errors, and none survives the correction",
    "differs": "the finding is that there is no difference, and there is one",
    "reversed in part": "some differences have the opposite sign, and none that of the finding",
    "reversed": "every difference has the opposite sign, or behind from the first shift on and never ahead",
    "behind later": "behind at later shifts, and at none ahead beyond the correction",
    "mixed": "both signs, in another order than the finding has them",
}
"""Verdicts and their meanings; signs are corrected for all differences that are shown."""


def _gain_verdict(signs: set[int], expected: int, within: bool) -> str:
    """Compute the verdict on a finding about differences.

    >>> [_gain_verdict(signs, 1, False) for signs in ({1}, {1, 0}, {-1}, {-1, 0}, {1, -1}, {0})]
    ['holds', 'holds in part', 'reversed', 'reversed in part', 'mixed', 'open']
    >>> _gain_verdict({0}, 1, True), _gain_verdict({0}, 0, True), _gain_verdict({1, 0}, 0, False)
    ('level', 'holds', 'differs')
    """
    if signs == {0}:
        return "open" if not within else "level" if expected else "holds"
    if not expected:
        return "differs"
    words = {frozenset({1}): "holds", frozenset({1, 0}): "holds in part"}
    words |= {frozenset({-1}): "reversed", frozenset({-1, 0}): "reversed in part"}
    return words.get(frozenset(signs), "mixed")


def _overtaken_verdict(leads: Sequence[int], trails: Sequence[int], within: bool) -> str:
    """Compute the verdict on a finding about who leads at first; shifts are counted from 1.

    >>> _overtaken_verdict([1, 2], [9], False), _overtaken_verdict([1], [], False), _overtaken_verdict([], [1], False)
    ('holds', 'not overtaken', 'reversed')
    >>> _overtaken_verdict([], [], True), _overtaken_verdict([5], [2], False), _overtaken_verdict([], [4], False)
    ('level', 'mixed', 'behind later')
    """
    if not leads and not trails:
        return "level" if within else "open"
    if not trails:
        return "not overtaken"
    if not leads:
        return "reversed" if trails[0] == 1 else "behind later"
    return "holds" if leads[-1] < trails[0] else "mixed"


def legend(used: Iterable[str]) -> list[str]:
    """Verdicts and their meanings, in the order of `VERDICTS`."""
    return table([["verdict", "meaning"], *([word, VERDICTS[word]] for word in VERDICTS if word in set(used))])


@dataclass(frozen=True)
class Measure:
    """What is counted in episodes of a kind."""

    text: str
    commonest: bool = False
    field: str = "right"


COUNTED = {
    "search": (Measure("one target", commonest=True), Measure("all targets")),
    "explore": (Measure("with background"), Measure("without background", field=OBJECTS)),
}
"""Ways to count, by the kind of the experiment; the paper's way comes first."""


@dataclass(frozen=True)
class _Advantage:
    """The finding that one policy is better than another by so much, or no better."""

    one: str
    other: str
    shifts: tuple[int, ...]
    expected: int = 1

    def answer(self, mean: FloatArray, error: FloatArray) -> Answer:
        """Sizes in percentage points, with standard errors, and the verdict."""
        chosen, errors = mean[list(self.shifts)], error[list(self.shifts)]
        sizes = " / ".join(points(mean, error, self.shifts))
        within = bool((np.abs(chosen) <= 2 * errors).all())
        signs = {int(sign) for sign in corrected_signs(chosen, errors)}
        return Answer(sizes, _gain_verdict(signs, self.expected, within))

    def published(self) -> str:
        """Return the paper's sizes, where it prints both policies."""
        printed = paper.TABLE_II | paper.TABLE_I
        if self.one not in printed or self.other not in printed or self.shifts != paper.TABLE_SHIFTS:
            return "-"
        pairs = zip(printed[self.one], printed[self.other], strict=True)
        return " / ".join(f"{one - other:+.1f}" for one, other in pairs)


@dataclass(frozen=True)
class _Overtaken:
    """The finding that a policy first leads another and is overtaken by it."""

    one: str
    other: str
    paper: str

    def answer(self, mean: FloatArray, error: FloatArray) -> Answer:
        """Gaze shifts at which it is ahead and behind, and the verdict."""
        leads, trails = behind(-mean, error), behind(mean, error)
        text = f"ahead at {spans(leads) or 'no shift'}, behind at {spans(trails) or 'no shift'}"
        within = bool((np.abs(mean) <= 2 * error).all())
        return Answer(text, _overtaken_verdict(leads, trails, within))

    def published(self) -> str:
        """Until when it leads in the paper."""
        return self.paper


@dataclass(frozen=True)
class Finding:
    """A finding of the paper."""

    text: str
    kind: str
    sizes: str
    test: _Advantage | _Overtaken

    def difference(self, folder: Path, measure: Measure) -> tuple[FloatArray, FloatArray]:
        """Difference of the policies in a run, by a measure, with its standard error, by gaze shift."""
        last, policies = LAST[self.kind], (self.test.one, self.test.other)
        return paired_difference(folder, *policies, last, measure.field, commonest=measure.commonest)

    def answer(self, folder: Path, measure: Measure) -> Answer:
        """Compute the answer of a run, by a measure."""
        return self.test.answer(*self.difference(folder, measure))

    @property
    def detects(self) -> bool:
        """Whether a policy of the finding uses a detector."""
        return not {self.test.one, self.test.other} <= set(_NO_DETECTOR)


SEARCH, EXPLORE = paper.TABLE_SHIFTS, (1, 5, 15)

_CALIBRATED = "calibrated − raw at 5 / 15 / 30 shifts"

TESTED = (
    Finding("Calibration is considerably beneficial for non-predictive search.", "search", _CALIBRATED,
            _Advantage("non-predictive-calibrated", "non-predictive-raw", SEARCH)),
    Finding("Calibration does not influence predictive search.", "search", _CALIBRATED,
            _Advantage("predictive-calibrated", "predictive-raw", SEARCH, expected=0)),
    Finding("Predictive search comfortably outperforms non-predictive search on raw scores", "search",
            "predictive less non-predictive at 5 / 15 / 30 shifts",
            _Advantage("predictive-raw", "non-predictive-raw", SEARCH)),
    Finding("… and on calibrated scores.", "search", "the same",
            _Advantage("predictive-calibrated", "non-predictive-calibrated", SEARCH)),
    Finding("Calibrated predictive search leads random gaze at first and is overtaken", "search", "gaze shifts",
            _Overtaken("predictive-calibrated", "random", "ahead to the 13th")),
    Finding("… calibrated non-predictive search too,", "search", "gaze shifts",
            _Overtaken("non-predictive-calibrated", "random", "ahead to the 10th")),
    Finding("… and raw non-predictive search.", "search", "gaze shifts",
            _Overtaken("non-predictive-raw", "random", "ahead initially")),
    Finding("KL divergence leads random gaze at first; random gaze overtakes it (calibrated).", "explore",
            "gaze shifts", _Overtaken("kl-calibrated", "random-calibrated", "ahead to about the 4th")),
    Finding("The same with raw scores.", "explore", "gaze shifts",
            _Overtaken("kl-raw", "random-raw", "ahead to about the 4th")),
    Finding("Exploration has no particular advantage from calibration.", "explore",
            "KL, calibrated − raw at 1 / 5 / 15 shifts", _Advantage("kl-calibrated", "kl-raw", EXPLORE, expected=0)),
)  # fmt: skip
"""Findings that are tested at every score threshold."""

_BASELINES = (
    Finding("VOCUS2 is far below random gaze in search.", "search", "random less VOCUS2 at 5 / 15 / 30 shifts",
            _Advantage("random", "vocus2", SEARCH)),
    Finding("KL divergence consistently outperforms negative entropy (calibrated).", "explore",
            "KL less negative entropy at 1 / 5 / 15 shifts",
            _Advantage("kl-calibrated", "negative-entropy-calibrated", EXPLORE)),
    Finding("KL divergence collects more in the first iterations than the two-peak difference (calibrated).",
            "explore", "KL less two-peak at 1 / 2 / 4 shifts",
            _Advantage("kl-calibrated", "two-peaks-calibrated", (1, 2, 4))),
    Finding("KL divergence outperforms VOCUS2 in exploration (calibrated).", "explore",
            "KL less VOCUS2 at 1 / 5 / 15 shifts", _Advantage("kl-calibrated", "vocus2-calibrated", EXPLORE)),
)  # fmt: skip
"""Findings that are tested at the default threshold alone."""

_FINDINGS = (*TESTED[:7], *_BASELINES, *TESTED[7:])
"""Findings that can be tested on curves; costs are measured by `python -m benchmarks.decisions`."""


def findings(runs: Runs) -> list[str]:
    """Write the table of findings at the default threshold: sizes and verdicts for both detectors and both foveas."""
    folders = {kind: published_columns(kind, runs) for kind in LAST}
    rows = [["the paper finds", "shown", "in the paper", *folders["search"]]]
    for finding in _FINDINGS:
        measure = COUNTED[finding.kind][-1 if finding.kind == "search" else 0]
        answers: dict[str, str] = {}
        for heading, folder in folders[finding.kind].items():
            first = heading.startswith(next(iter(DETECTORS.values())))
            answers[heading] = str(finding.answer(folder, measure)) if first or finding.detects else "no detector"
        rows.append([finding.text, finding.sizes, finding.test.published(), *answers.values()])
    return table(rows)

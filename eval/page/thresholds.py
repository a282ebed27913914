"""The paper's findings at every score threshold: differences, and verdicts with the thresholds at which they hold."""

from dataclasses import dataclass

from eval.page.curves import points
from eval.page.experiments import DETECTORS, SCORE_THRESHOLDS, at_threshold
from eval.page.findings import COUNTED, TESTED, VERDICTS, Answer, Finding, Measure, legend
from eval.page.tables import Runs
from semfov.metrics.episodes import FloatArray
from semfov.runs.tables import table


def verdicts(runs: Runs) -> list[str]:
    """Write the table of verdicts by detector and measure, each with the score thresholds at which it is reached."""
    rows = [["the paper finds", "in the paper", "counted", *DETECTORS.values()]]
    for finding in TESTED:
        for number, measure in enumerate(COUNTED[finding.kind]):
            head = [finding.text, finding.test.published()] if number == 0 else ["", ""]
            cells = (_verdict_text(_answers_at(finding, measure, name, runs)) for name in DETECTORS)
            rows.append([*head, measure.text, *cells])
    return table(rows)


def _answers_at(finding: Finding, measure: Measure, name: str, runs: Runs) -> dict[float, Answer]:
    """Compute the answers to a finding at each score threshold, with one of `DETECTORS`."""
    return {t: finding.answer(runs[at_threshold(finding.kind, t, name)].out, measure) for t in SCORE_THRESHOLDS}


def _verdict_text(answers: dict[float, Answer]) -> str:
    """Write the verdicts, each with the thresholds at which it is reached.

    >>> _verdict_text({0.02: Answer("", "holds"), 0.1: Answer("", "holds"), 0.25: Answer("", "level")})
    'holds at 0.02, 0.1; level at 0.25'
    """
    thresholds: dict[str, list[str]] = {}
    for threshold, answer in answers.items():
        thresholds.setdefault(answer.verdict, []).append(f"{threshold:g}")
    if len(thresholds) == 1 and len(answers) == len(SCORE_THRESHOLDS):
        return f"{next(iter(thresholds))} at all four"
    return "; ".join(f"{verdict} at {', '.join(listed)}" for verdict, listed in thresholds.items())


def words_of_verdicts(runs: Runs) -> list[str]:
    """Return the verdicts that the table by score threshold uses, and their meanings."""
    cells = "\n".join(verdicts(runs))
    return legend({word for word in VERDICTS if f" {word} at " in cells})


@dataclass(frozen=True)
class Contrast:
    """The difference of the policies of a finding, as the page shows it at every score threshold."""

    text: str
    finding: Finding
    measure: Measure
    shifts: tuple[int, ...]

    def difference(self, threshold: float, name: str, runs: Runs) -> tuple[FloatArray, FloatArray]:
        """Paired difference and its standard error by gaze shift, at a threshold with one of `DETECTORS`."""
        return self.finding.difference(runs[at_threshold(self.finding.kind, threshold, name)].out, self.measure)


CONTRASTS = tuple(
    Contrast(text.format(measure.text), finding, measure, shifts)
    for text, finding, shifts in (
        ("search, {}: calibrated − raw", TESTED[0], (30,)),
        ("exploration, {}: KL − random, calibrated", TESTED[7], (1, 10)),
        ("exploration by KL, {}: calibrated − raw", TESTED[9], (15,)),
    )
    for measure in COUNTED[finding.kind]
)
"""Differences on which the two headlines of the paper rest."""


def by_threshold(runs: Runs) -> list[str]:
    """Write the table of the differences at each score threshold, in percentage points, for both detectors.

    It has what counts last: all targets, and cells without background as an answer. The figure has the others, too.
    """
    shown = [contrast for contrast in CONTRASTS if contrast.measure is COUNTED[contrast.finding.kind][-1]]
    rows = [["detector", "difference", "shifts", *(f"{threshold:g}" for threshold in SCORE_THRESHOLDS)]]
    for name, title in DETECTORS.items():
        for contrast in shown:
            differences = [contrast.difference(threshold, name, runs) for threshold in SCORE_THRESHOLDS]
            columns = [points(mean, error, contrast.shifts) for mean, error in differences]
            rows += [[title, contrast.text, *map(str, row)] for row in zip(contrast.shifts, *columns, strict=True)]
    return table(rows)

"""The paper's findings at every score threshold: differences, and verdicts with the thresholds at which they hold."""

from dataclasses import dataclass

from eval.page.curves import difference, per_image, records_of
from eval.page.experiments import DETECTORS, SCORE_THRESHOLDS, at_threshold
from eval.page.findings import COUNTED, EXPLORE, LAST, SEARCH, TESTED, Finding, Measure
from eval.page.tables import Runs
from eval.page.verdicts import VERDICTS, Answer, legend
from semfov.metrics.averages import FloatArray
from semfov.runs.tables import table


def verdicts(runs: Runs) -> list[str]:
    """The table of verdicts by detector and measure: each verdict with the score thresholds at which it is reached."""
    rows = [["the paper finds", "in the paper", "counted", *DETECTORS.values()]]
    for finding in TESTED:
        for number, measure in enumerate(COUNTED[finding.kind]):
            head = [finding.text, finding.test.published()] if number == 0 else ["", ""]
            cells = (told_by_verdict(answers_at(finding, measure, name, runs)) for name in DETECTORS)
            rows.append([*head, measure.text, *cells])
    return table(rows)


def answers_at(finding: Finding, measure: Measure, name: str, runs: Runs) -> dict[float, Answer]:
    """The answers to a finding at each score threshold, with one of `DETECTORS`."""
    return {t: finding.answer(runs[at_threshold(finding.kind, t, name)].out, measure) for t in SCORE_THRESHOLDS}


def told_by_verdict(answers: dict[float, Answer]) -> str:
    """Verdicts, each with the thresholds at which it is reached.

    Args:
        answers: the answers by threshold.

    Returns:
        The text.

    >>> told_by_verdict({0.02: Answer("", "holds"), 0.1: Answer("", "holds"), 0.25: Answer("", "level")})
    'holds at 0.02, 0.1; level at 0.25'
    """
    verdicts = dict.fromkeys(answer.verdict for answer in answers.values())
    at = {word: ", ".join(f"{t:g}" for t, answer in answers.items() if answer.verdict == word) for word in verdicts}
    return "; ".join(f"{word} at {thresholds}" for word, thresholds in at.items())


def words_of_verdicts(runs: Runs) -> list[str]:
    """The verdicts that the table by score threshold uses, and their meanings."""
    cells = "\n".join(verdicts(runs))
    return legend({word for word in VERDICTS if f" {word} at " in cells})


@dataclass(frozen=True)
class Contrast:
    """A difference of two policies that the page shows at every score threshold.

    Attributes:
        text: its description.
        kind: kind of the experiment.
        one: the first policy.
        other: the policy that is subtracted.
        measure: what is counted.
        shifts: gaze shifts that the table shows.
    """

    text: str
    kind: str
    one: str
    other: str
    measure: Measure
    shifts: tuple[int, ...]

    def difference(self, threshold: float, name: str, runs: Runs) -> tuple[FloatArray, FloatArray]:
        """Paired difference and its standard error by gaze shift, at a threshold with one of `DETECTORS`."""
        folder, last = runs[at_threshold(self.kind, threshold, name)].out, LAST[self.kind]
        both = (records_of(folder, policy, commonest=self.measure.commonest) for policy in (self.one, self.other))
        return difference(*(per_image(records, last, self.measure.field) for records in both))


CONTRASTS = (
    *(
        Contrast(
            f"search, {measure.text}: calibrated less raw",
            "search",
            "non-predictive-calibrated",
            "non-predictive-raw",
            measure,
            SEARCH,
        )
        for measure in COUNTED["search"]
    ),
    *(
        Contrast(
            f"exploration, {measure.text}: KL less random, {scores}",
            "explore",
            f"kl-{scores}",
            f"random-{scores}",
            measure,
            (1, 5, 10, 20),
        )
        for scores in ("calibrated", "raw")
        for measure in COUNTED["explore"]
    ),
    *(
        Contrast(
            f"exploration by KL, {measure.text}: calibrated less raw",
            "explore",
            "kl-calibrated",
            "kl-raw",
            measure,
            EXPLORE,
        )
        for measure in COUNTED["explore"]
    ),
)
"""Differences on which the two headlines of the paper rest."""


def by_threshold(runs: Runs) -> list[str]:
    """The table of the differences at each score threshold, in percentage points, for both detectors."""
    rows = [["detector", "difference", "shifts", *(f"{threshold:g}" for threshold in SCORE_THRESHOLDS)]]
    for name, title in DETECTORS.items():
        for contrast in CONTRASTS:
            told = [contrast.difference(threshold, name, runs) for threshold in SCORE_THRESHOLDS]
            for n in contrast.shifts:
                cells = (f"{100 * mean[n]:+.1f} ± {100 * error[n]:.1f}" for mean, error in told)
                rows.append([title, contrast.text, str(n), *cells])
    return table(rows)

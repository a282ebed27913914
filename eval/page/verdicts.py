"""Verdicts on findings, and their meanings."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from semfov.runs.tables import table


@dataclass(frozen=True)
class Answer:
    """The answer of a run to a finding.

    Attributes:
        sizes: sizes of the difference, or the gaze shifts at which it is found.
        verdict: one of `VERDICTS`.
    """

    sizes: str
    verdict: str

    def __str__(self) -> str:
        return f"{self.sizes}: {self.verdict}"


VERDICTS = {
    "holds": "every difference is as the finding says, or the policy is first ahead and later behind",
    "holds in part": "some differences have the sign, and none the opposite one",
    "not overtaken": "ahead at some shifts, and behind at none",
    "level": "every difference is within two standard errors of zero",
    "open": "some difference is beyond two standard errors, and none stands the correction",
    "differs": "the finding is that there is no difference, and there is one",
    "reversed in part": "some differences have the opposite sign, and none that of the finding",
    "reversed": "every difference has the opposite sign, or behind from the first and never ahead",
    "mixed": "both signs, in another order than the finding has them",
}
"""Verdicts and their meanings; signs are corrected for all differences that are shown."""


def gain_verdict(signs: set[int], expected: int, within: bool) -> str:
    """The verdict on a finding about differences.

    Args:
        signs: the signs of the differences; 0 for a difference that the correction does not tell from zero.
        expected: the sign that the finding claims.
        within: whether every difference is within two standard errors of zero.

    Returns:
        The verdict.

    >>> [gain_verdict(signs, 1, False) for signs in ({1}, {1, 0}, {-1}, {-1, 0}, {1, -1}, {0})]
    ['holds', 'holds in part', 'reversed', 'reversed in part', 'mixed', 'open']
    >>> gain_verdict({0}, 1, True), gain_verdict({0}, 0, True), gain_verdict({1, 0}, 0, False)
    ('level', 'holds', 'differs')
    """
    if signs == {0}:
        return "open" if not within else "level" if expected else "holds"
    if not expected:
        return "differs"
    words = {frozenset({1}): "holds", frozenset({1, 0}): "holds in part"}
    words |= {frozenset({-1}): "reversed", frozenset({-1, 0}): "reversed in part"}
    return words.get(frozenset(signs), "mixed")


def overtaken_verdict(leads: Sequence[int], trails: Sequence[int], within: bool) -> str:
    """The verdict on a finding about who leads at first.

    Args:
        leads: gaze shifts at which the policy is ahead.
        trails: gaze shifts at which it is behind.
        within: whether it is within two standard errors at all shifts.

    Returns:
        The verdict.

    >>> overtaken_verdict([1, 2], [9], False), overtaken_verdict([1], [], False), overtaken_verdict([], [4], False)
    ('holds', 'not overtaken', 'reversed')
    >>> overtaken_verdict([], [], True), overtaken_verdict([5], [2], False)
    ('level', 'mixed')
    """
    if not leads and not trails:
        return "level" if within else "open"
    if not trails:
        return "not overtaken"
    if not leads:
        return "reversed"
    return "holds" if leads[-1] < trails[0] else "mixed"


def legend(used: Iterable[str]) -> list[str]:
    """Verdicts and their meanings, in the order of `VERDICTS`."""
    return table([["verdict", "meaning"], *([word, VERDICTS[word]] for word in VERDICTS if word in set(used))])

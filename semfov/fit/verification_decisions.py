"""Searches that verify their target by closer looks, and the choice of the threshold of their decisions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from semfov.belief.observers import Target
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.belief.verification import Verification
from semfov.decision import OUTCOMES, CandidateCells, Verifier, conclude, decide, verified
from semfov.episode import Step
from semfov.fit.closer_looks import Photograph, Sought, search
from semfov.fit.verification_settings import FitVerificationConfig
from semfov.runs.progress import track

LEVELS = tuple(number / 100 for number in range(50, 100))
"""Values from which the threshold `confirm` is chosen."""

Ended = tuple[bool | None, int]
"""End of a search: whether the place that it found is right (None: not found), and the number of looks until then."""


@dataclass(frozen=True)
class Verified:
    """A search in which all closer looks were made, whatever they showed.

    Attributes:
        photograph: number of the photograph.
        present: whether the photograph holds the target.
        spare: whether the search only serves to choose thresholds.
        places: for each closer look, the probability that the target is there, and whether it is.
        ends: for each closer look, the number of looks of both kinds that were made up to it.
        presence: probability that the image holds the target, at the end.
        looks: number of looks of both kinds.
        unverified: end of the same search without closer looks, by the thresholds of the target evidence.
    """

    photograph: int
    present: bool
    spare: bool
    places: tuple[tuple[float, bool], ...]
    ends: tuple[int, ...]
    presence: float
    looks: int
    unverified: Ended

    def found(self, confirm: float) -> Ended:
        """Return the end of the search at a threshold."""
        chances = [chance for chance, _ in self.places]
        for number, end in enumerate(self.ends, 1):
            if verified(chances[:number], self.presence, confirm, over=False):
                return self.places[number - 1][1], end
        if OUTCOMES[verified(chances, self.presence, confirm, over=True)] != "found":
            return None, self.looks
        return self.places[chances.index(max(chances))][1], self.looks


def verify(
    seen: Sequence[Photograph], folds: Sequence[Verification], evidence: TargetEvidence, config: FitVerificationConfig
) -> Iterator[Verified]:
    """Search every photograph with the model that was not fitted to it, and make all closer looks.

    Args:
        seen: the photographs.
        folds: for each fold, the model fitted to the others.
        evidence: the target evidence.
        config: the settings.

    Yields:
        The searches.
    """
    always, observer = Thresholds(1.0, config.give_up, config.place), Target(evidence)
    for photograph in track(seen, "verifying", "photograph"):
        model = folds[photograph.number % config.folds]
        for sought in photograph.sought:
            # Decisions do not move the gaze, so all of them are made along the same looks.
            steps = list(search(photograph, sought, observer, config.looks))
            verifier = Verifier(model, CandidateCells(photograph.grid, sought.target), photograph.close_up, always)
            end = next((number for number, step in enumerate(steps, 1) if int(verifier(step))), len(steps))
            decision = verifier.conclude()
            places = tuple((look.place, bool(sought.goal[look.cell])) for look in verifier.looks)
            yield Verified(
                photograph=photograph.number,
                present=sought.present,
                spare=sought.spare,
                places=places,
                ends=tuple(
                    look.fixation + 1 + number
                    for number, look in enumerate(verifier.looks, 1)
                    if look.fixation is not None
                ),
                presence=decision.probability,
                looks=end + len(verifier.looks),
                unverified=unverified(steps, photograph, sought, evidence.thresholds),
            )
        photograph.close()


def unverified(steps: Sequence[Step], photograph: Photograph, sought: Sought, thresholds: Thresholds | None) -> Ended:
    """Decide along the looks of a search by the belief alone; nothing is found without thresholds.

    Args:
        steps: all steps of the search.
        photograph: the photograph.
        sought: the class that is searched for.
        thresholds: thresholds of the target evidence.

    Returns:
        The end of the search.
    """
    if thresholds is None:
        return None, len(steps)
    for number, step in enumerate(steps, 1):
        outcome = int(decide(step, sought.target, thresholds))
        if outcome:
            shown = [each.detections for each in steps[:number]]
            cell = conclude(outcome, step.belief, shown, photograph.grid, sought.target).cell
            return (None if cell is None else bool(sought.goal[cell])), number
    return None, len(steps)


def choose_confirm(searches: Sequence[Verified], false_alarms: float, surest: float = LEVELS[-1]) -> float:
    """Choose the least threshold at which few enough absent targets are found.

    Args:
        searches: the searches.
        false_alarms: maximum share of absent targets that may be found.
        surest: upper limit of the threshold.

    Returns:
        The threshold, from `LEVELS`; `surest` if no smaller one suffices.
    """
    absent = [each for each in searches if not each.present]
    for confirm in LEVELS:
        if sum(each.found(confirm)[0] is not None for each in absent) <= false_alarms * len(absent):
            return min(confirm, surest)
    return surest

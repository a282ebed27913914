"""Searches that verify their target by closer looks, and the choice of the threshold of their decisions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from semfov.belief.observers import Target
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.belief.verification import Verification
from semfov.decision import OUTCOMES, conclude, decide
from semfov.episode import Step
from semfov.experiments.progress import track
from semfov.training.closer_looks import Photograph, Sought, search
from semfov.training.verification_settings import FitVerificationConfig
from semfov.verifier import Verifier, surely

LEVELS = tuple(number / 100 for number in range(50, 100))
"""Values from which the threshold `confirm` is chosen."""

Place = tuple[float, bool]
"""The probability that the target is at a place, and whether it is."""


@dataclass(frozen=True)
class Unverified:
    """A search in which the target evidence alone decides, by its thresholds.

    Attributes:
        place: at the end, the most evident place of the target: the probability that it is there, and whether it is.
        found: whether the search ends with `found`.
        looks: number of looks.
    """

    place: Place
    found: bool
    looks: int


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
        unverified: the same search without closer looks.
    """

    photograph: int
    present: bool
    spare: bool
    places: tuple[Place, ...]
    ends: tuple[int, ...]
    presence: float
    looks: int
    unverified: Unverified

    @property
    def best(self) -> Place:
        """The most probable place after a closer look; probability 0 if none was made."""
        return max(self.places, default=(0.0, False))

    def found(self, confirm: float) -> tuple[bool | None, int]:
        """Decision at a threshold: whether the place is right (None: not found), and the number of looks until then."""
        for (place, right), end in zip(self.places, self.ends, strict=True):
            if place >= surely(confirm):
                return right, end
        place, right = self.best
        return (right if place >= confirm else None), self.looks


def value(place: Place) -> float:
    r"""Value of decisions about a place, averaged over all thresholds from 0 to 1.

    At the threshold c, `found` is worth 1 - c if the place is right and -c if it is wrong, and no find is worth 0. So
    a find pays off exactly if its probability is larger than c. For a place with probability p, which is right
    (r = 1) or wrong (r = 0), twice the average is

    .. math:: 2 \int_0^p (r - c) \, dc = 2 p r - p^2 = r - (r - p)^2,

    the quadratic score (Brier, 1950) relative to that of saying nothing (Schervish, 1989, *A general method for
    comparing probability assessors*).

    Args:
        place: the probability of the place, and whether it is right.

    Returns:
        The value: 1 for a certain find that is right, -1 for one that is wrong.

    >>> value((1.0, True)), value((0.5, True)), value((0.5, False)), value((0.0, True))
    (1.0, 0.75, -0.25, 0.0)
    """
    probability, right = place
    return 2 * probability * right - probability**2


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
            verifier = Verifier(model, photograph.close_up, photograph.grid, sought.target, always)
            end = next((number for number, step in enumerate(steps, 1) if int(verifier(step))), len(steps))
            decision = verifier.conclude(steps[end - 1])
            places = tuple((look.place, bool(sought.goal[look.cell])) for look in verifier.looks)
            yield Verified(
                photograph=photograph.number,
                present=sought.present,
                spare=sought.spare,
                places=places,
                ends=tuple(look.fixation + 1 + number for number, look in enumerate(verifier.looks, 1)),
                presence=decision.probability,
                looks=end + len(verifier.looks),
                unverified=unverified(steps, photograph, sought, evidence.thresholds),
            )
        photograph.close()


def unverified(
    steps: Sequence[Step], photograph: Photograph, sought: Sought, thresholds: Thresholds | None
) -> Unverified:
    """Decide along the looks of a search by the belief alone; without thresholds no search ends before its last look.

    Args:
        steps: all steps of the search.
        photograph: the photograph.
        sought: the class that is searched for.
        thresholds: thresholds of the target evidence.

    Returns:
        The search.
    """
    outcomes = [0 if thresholds is None else int(decide(step, sought.target, thresholds)) for step in steps]
    end = next((number for number, outcome in enumerate(outcomes, 1) if outcome), len(steps))
    belief, shown = steps[end - 1].belief, [step.detections for step in steps[:end]]
    found = OUTCOMES.index("found")
    cell = conclude(found, belief, shown, photograph.grid, sought.target).cell
    assert cell is not None
    place = float(belief.probability(sought.target)[0, cell]), bool(sought.goal[cell])
    return Unverified(place, outcomes[end - 1] == found, end)


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

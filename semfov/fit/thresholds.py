"""Thresholds of decisions without closer looks, chosen on searches whose looks are known."""

from typing import Protocol

import torch
from torch import Tensor

from semfov.decision import OUTCOMES, settle
from semfov.observation.thresholds import Thresholds

SUREST = 0.99
"""Upper limit of the threshold for found targets."""
SUREST_OF_FEW = 0.9
"""That for few searches, in which one false alarm pushes the threshold up."""

_FOUND = OUTCOMES.index("found")
_CONFIRMS = torch.arange(0.99, 0.49, -0.01).tolist()  # the highest first
_PLACES = torch.arange(0.95, 0.04, -0.05).tolist()
_STOPS_BELOW = (0.3, 0.25, 0.2, 0.15, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01, 0.007, 0.005, 0.003, 0.002, 0.001)


class Bounds(Protocol):
    """Shares of wrong decisions within which thresholds are chosen, as those of a `FitSearchConfig`."""

    @property
    def false_alarms(self) -> float:
        """Largest share of absent targets that may be reported as found."""

    @property
    def surest(self) -> float:
        """Upper limit of the threshold `confirm`, even if more false alarms result."""

    @property
    def lost(self) -> float:
        """Largest share of targets that may be missed because of `place`, and then because of `stop_below`."""


class _Searches:
    """E searches with the probabilities after each of n looks, decided by thresholds.

    Attributes:
        presence: `(n, E)`, probability that the picture holds the target.
        place: `(n, E)`, probability of the target at the place that is known, 0 where none is.
        hit_chance: `(n, E)`, probability of the best place that is left to look at.
        there: `(E,)` boolean, whether the picture holds the target.
    """

    def __init__(self, presence: Tensor, place: Tensor, hit_chance: Tensor, there: Tensor) -> None:
        self.presence = presence
        self.place = place
        self.hit_chance = hit_chance
        self.there = there

    def found(self, thresholds: Thresholds) -> Tensor:
        """Tell which searches find their target, `(E,)` boolean: their first look that ends them says so."""
        # A place of 0 is none, and with a threshold of 0 would pass for one.
        known = (self.place > 0) & (self.place >= thresholds.place)
        outcomes = settle(self.presence, known, self.hit_chance, thresholds)
        first = (outcomes > 0).int().argmax(0)
        return outcomes.gather(0, first[None])[0] == _FOUND

    def hits(self, thresholds: Thresholds) -> int:
        """Count the targets that are there and found."""
        return int(self.found(thresholds)[self.there].sum())

    def false_alarms(self, thresholds: Thresholds) -> float:
        """Compute the share of the absent targets that are found."""
        return float(self.found(thresholds)[~self.there].double().mean())

    def confirming(self, place: float, bounds: Bounds) -> Thresholds:
        """Return the lowest `confirm` with few enough false alarms, for a `place`."""
        # False alarms never rise with `confirm`, as nothing but a find ends a search here. So a scan from below would
        # choose the same (`semfov.fit.verification.choose_confirm`).
        confirm = 1.0
        for candidate in _CONFIRMS:
            if self.false_alarms(Thresholds(candidate, 0.0, place)) > bounds.false_alarms:
                break
            confirm = candidate
        return Thresholds(min(confirm, bounds.surest), 0.0, place)


def choose_thresholds(bounds: Bounds, presence: Tensor, place: Tensor, hit_chance: Tensor, there: Tensor) -> Thresholds:
    """Choose thresholds with few false alarms and few missed targets.

    `confirm` is the lowest with few enough false alarms, `place` the highest that misses few of the targets that are
    found without one, and `stop_below` the highest that misses few of those.

    Args:
        bounds: shares of false alarms and missed targets.
        presence: `(n, E)`, probability that the picture holds the target, after each look of each search.
        place: `(n, E)`, probability of the target at the place that is known, 0 where none is.
        hit_chance: `(n, E)`, probability of the best place that is left to look at.
        there: `(E,)` boolean, whether the picture holds the target.

    Returns:
        The thresholds.
    """
    searches = _Searches(presence, place, hit_chance, there)
    most_lost = bounds.lost * int(there.sum())
    chosen = without_place = searches.confirming(0.0, bounds)
    for candidate in (searches.confirming(least, bounds) for least in _PLACES):
        if searches.hits(without_place) - searches.hits(candidate) <= most_lost:
            chosen = candidate
            break
    for stop_below in _STOPS_BELOW:
        candidate = chosen.changed(stop_below=stop_below)
        if searches.hits(chosen) - searches.hits(candidate) <= most_lost:
            return candidate
    return chosen

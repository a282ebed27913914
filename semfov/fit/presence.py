"""Fit the probability that a picture holds a class, and the thresholds of decisions, to searches."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.decision import place_known
from semfov.errors import DataError
from semfov.fit.logistic import logistic_regression
from semfov.fit.thresholds import Bounds, choose_thresholds
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import area_under_roc
from semfov.observation.presence import Presence, log_odds_of_cells
from semfov.observation.thresholds import Thresholds

COUNTED = (1, 3, 5, 8, 12)
"""Numbers of looks after which a belief counts in the fits of searches."""

_RIDGE = 1e-3
_LEAST_SLOPE = 0.1  # of the log odds of cells; those of shipped models are near 0.9


@dataclass(frozen=True)
class BeliefsOfSearches:
    """Beliefs of E searches after each of n looks; no search ends before its last look.

    Probabilities of cells are those of the belief, which no fit has made true yet (`Presence.of_cells`).

    Attributes:
        facts: `(2, n, E)`, what the probability of presence depends on (`semfov.observation.presence.presence_facts`).
        place: `(n, E)`, largest probability of a fixated cell.
        hit_chance: `(n, E)`, largest probability of a cell that was not fixated, given that no fixated one holds it.
        holds: `(n, E)` boolean, whether the most probable cell holds the target.
        hits: `(n, E)` boolean, whether the cell of the hit chance holds it.
        on_target: `(n, E)` boolean, whether the gaze has reached the target.
        there: `(E,)` boolean, whether the photograph holds the target.
        photograph: `(E,)`, number of the photograph.
        target: `(E,)`, class 1..K.
    """

    facts: Tensor
    place: Tensor
    hit_chance: Tensor
    holds: Tensor
    hits: Tensor
    on_target: Tensor
    there: Tensor
    photograph: Tensor
    target: Tensor

    def __len__(self) -> int:
        return len(self.there)

    def _columns(self) -> list[Tensor]:
        """List the tensors, whose last side are the searches, in the order of the attributes."""
        return [getattr(self, field.name) for field in fields(self)]

    def __getitem__(self, chosen: Tensor) -> "BeliefsOfSearches":
        """Select searches."""
        return BeliefsOfSearches(*(column[..., chosen] for column in self._columns()))

    @classmethod
    def join(cls, parts: Sequence["BeliefsOfSearches"]) -> "BeliefsOfSearches":
        """Concatenate the searches of several photographs."""
        columns = zip(*(part._columns() for part in parts), strict=True)
        return cls(*(torch.cat(of_parts, -1) for of_parts in columns))

    @property
    def counted(self) -> list[int]:
        """Numbers of looks after which the beliefs count in the fit, as many as there are."""
        return [number for number in COUNTED if number <= len(self.place)]


def fit_presence(searches: BeliefsOfSearches, shares: Tensor, bounds: Bounds) -> Presence:
    """Fit presence and probabilities of cells by logistic regression, and choose the thresholds of decisions.

    How often searches for a class were drawn with their target in the photograph says nothing of the belief: its log
    odds are given to the regression, which fits what remains.

    Args:
        searches: searches of photographs.
        shares: `(K,)`, by class, shares of these searches whose target is there.
        bounds: shares of wrong decisions within which the thresholds are chosen.

    Returns:
        The presence with its thresholds.

    Raises:
        DataError: all searches have their target in the photograph, or none has.
    """
    _check_both_kinds(searches)
    counted = torch.tensor(searches.counted) - 1
    facts = searches.facts[:, counted].flatten(1).mT.double()
    answers = searches.there.repeat(len(counted))
    of_class = shares[searches.target - 1].double().logit()
    known = of_class.repeat(len(counted))
    times = torch.full_like(known, 1 / len(counted))  # all looks of a search are one case
    slopes = torch.zeros(2)
    numbers = [0, 1]  # of the facts that count
    while True:
        offset, *weights = logistic_regression(facts[:, numbers], answers, times=times, known=known, ridge=_RIDGE)
        least = min(weights, default=0.0)
        if least >= 0:
            break
        # A surer cell, or a higher score, must not speak against the class: few searches may say so by chance.
        del numbers[weights.index(least)]
    slopes[numbers] = torch.tensor(weights)
    centre = _fit_cells(searches, of_class)
    presence = Presence(torch.tensor(offset), slopes, shares, centre=centre).requires_grad_(False)
    presence.thresholds = thresholds_of_searches(presence, searches, bounds)
    return presence


def _fit_cells(searches: BeliefsOfSearches, of_class: Tensor) -> Tensor:
    """Fit what makes the probabilities of the cells true that decisions read: of the most probable, and of the next.

    Args:
        searches: searches of photographs.
        of_class: `(E,)`, log odds that a search for the class has its target in the photograph.

    Returns:
        Offset and slope of the log odds, `(2,)`; the slope is at least `_LEAST_SLOPE`.
    """
    counted = torch.tensor(searches.counted) - 1
    share = torch.full_like(searches.place[counted].double(), 1 / len(counted))  # all looks of a search are one case
    log_odds = torch.stack(
        [searches.facts[0, counted].double(), log_odds_of_cells(searches.hit_chance[counted]).double()]
    )
    answers = torch.stack([searches.holds[counted], searches.hits[counted]])
    # The chance of a hit is that of a search that goes on.
    times = torch.stack([share, share * ~searches.on_target[counted]])
    known = of_class.expand_as(log_odds).flatten()
    regression = partial(logistic_regression, right=answers.flatten(), times=times.flatten(), ridge=_RIDGE)
    offset, slope = regression(log_odds.flatten()[:, None], known=known)
    if slope < _LEAST_SLOPE:
        # A surer cell must not be less probable, nor all of them alike: few searches may say so by chance.
        slope = _LEAST_SLOPE
        (offset,) = regression(log_odds.new_zeros(len(known), 0), known=known + slope * log_odds.flatten())
    return torch.tensor([offset, slope])


@torch.no_grad()
def thresholds_of_searches(presence: Presence, searches: BeliefsOfSearches, bounds: Bounds) -> Thresholds:
    """Choose the thresholds of decisions on searches.

    Args:
        presence: tells how probably a photograph holds the class.
        searches: searches of photographs.
        bounds: shares of wrong decisions within which the thresholds are chosen.

    Returns:
        The thresholds.
    """
    probability = presence(searches.facts.movedim(0, -1)).sigmoid()
    cells = presence.of_cells(torch.stack([searches.place, searches.facts[0].sigmoid()], -1), "box_centre")
    place = cells[..., 0] * place_known(cells, torch.tensor([True, False]))
    hit_chance = presence.of_cells(searches.hit_chance, "box_centre")
    return choose_thresholds(bounds, probability, place, hit_chance, searches.there)


@torch.no_grad()
def judge_presence(presence: Presence, searches: BeliefsOfSearches) -> list[dict[str, float]]:
    """Measure a presence on searches of other photographs, with the shares of the fit as the prior.

    Args:
        presence: fitted to searches of some photographs.
        searches: searches of others.

    Returns:
        After each number of looks that counts: `looks`; `found`, the share of the targets that the gaze has reached;
        `area`, area under the ROC of the presence; `ece`, its expected calibration error; and `nll`, its mean negative
        log likelihood.

    Raises:
        DataError: all searches have their target in the photograph, or none has.
    """
    _check_both_kinds(searches)
    rows = []
    for looks in searches.counted:
        log_odds = presence(searches.facts[:, looks - 1].mT) + presence.shares[searches.target - 1].logit()
        probability = log_odds.sigmoid()
        rows.append(
            {
                "looks": looks,
                "found": float(searches.on_target[looks - 1, searches.there].double().mean()),
                "area": area_under_roc(probability, searches.there),
                "ece": float(calibration_error(probability, searches.there)),
                "nll": float(F.binary_cross_entropy_with_logits(log_odds, searches.there.to(log_odds))),
            }
        )
    return rows


def _check_both_kinds(searches: BeliefsOfSearches) -> None:
    """Raise `DataError` unless the photographs of some searches hold the class, and those of others lack it."""
    if searches.there.all() or not searches.there.any():
        raise DataError(
            "data: expected photographs that hold a class to search for, and others that lack it, got only one kind; "
            "give more photographs"
        )

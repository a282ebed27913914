"""Fit the verification of targets by closer looks, from searches of photographs with boxes."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from semfov.belief.prior import with_prior
from semfov.belief.verification import CLOSER_FEATURES, Verification
from semfov.decision import FOUND, Verifier, final_outcome, found_at_once
from semfov.decision.candidates import CandidatePlace
from semfov.detection.detections import Detections
from semfov.errors import DataError
from semfov.fit.logistic import logistic_regression
from semfov.fit.searches import SearchedPhotograph, SearchEnd, TargetSearch, photograph_searches
from semfov.fit.settings import VerificationConfig
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.thresholds import Thresholds

_LEVELS = tuple(number / 100 for number in range(50, 100))  # values from which the threshold `confirm` is chosen
_STRENGTH = 10.0
"""Strength of a prior, chosen on photographs that no result is reported on (docs/decisions/closer_looks.md)."""

_PLACES = 3  # places examined after some looks
_LEAST_CHANCE = 0.01  # least probability of these places
_RIDGE = 1e-4


class OneKindError(DataError):
    """There are only closer looks, or places, of one kind, to which nothing can be fitted."""


class VerifiedSearch(NamedTuple):
    """A search in which all closer looks were made, whatever they showed.

    Attributes:
        picture: number of the picture.
        present: whether it holds the target.
        spare: whether the search serves only to choose thresholds.
        places: probability of each place that was looked at closely, and whether the target is there.
        ends: number of looks up to each closer look, itself included.
        presence: probability that the picture holds the target, at the end.
        looks: number of all looks.
        unverified: end of the search without closer looks; None where the belief alone does not decide.
    """

    picture: int
    present: bool
    spare: bool
    places: tuple[tuple[float, bool], ...]
    ends: tuple[int, ...]
    presence: float
    looks: int
    unverified: SearchEnd | None

    def found(self, confirm: float) -> SearchEnd:
        """Return the end of the search at a threshold."""
        chances = [chance for chance, _ in self.places]
        for number, end in enumerate(self.ends, 1):
            if found_at_once(chances[:number], confirm, number):
                return SearchEnd(self._is_surest_right(number), end)
        if final_outcome(chances, self.presence, confirm) != FOUND:
            return SearchEnd(None, self.looks)
        return SearchEnd(self._is_surest_right(len(chances)), self.looks)

    def _is_surest_right(self, number: int) -> bool:
        """Tell whether the target is at the surest of the first places that were looked at closely."""
        _, right = max(self.places[:number], key=lambda place: place[0])
        return right


class CloserLookSamples(NamedTuple):
    """Closer looks at N places that seemed to hold a target.

    Attributes:
        features: `(N, 7)`, what the verification reads.
        right: `(N,)` boolean, whether the target is at the place.
        present: `(N,)` boolean, whether the picture holds the target.
        fold: `(N,)`, number of the fold of the picture.
        known: `(N,)`, log odds that a search for the class has its target in the picture, before any look.
    """

    features: Tensor
    right: Tensor
    present: Tensor
    fold: Tensor
    known: Tensor


class ExaminedLook(NamedTuple):
    """A closer look at a place of a search.

    Attributes:
        looks: number of looks of the search before it.
        candidate: the place.
        detections: what the look shows, a batch of one.
        features: `(7,)`, what the verification reads.
        box: `(4,)`, box of the target in it.
    """

    looks: int
    candidate: CandidatePlace
    detections: Detections
    features: Tensor
    box: Tensor


class VerificationInFolds(NamedTuple):
    """A fitted verification, and what it is evaluated with.

    Attributes:
        model: fitted to all closer looks, with its thresholds.
        folds: models that are fitted to the other folds, one for each fold.
        closer_looks: what all of them are fitted to.
        searches: searches with the model that was not fitted to their photograph.
    """

    model: Verification
    folds: list[Verification]
    closer_looks: CloserLookSamples
    searches: list[VerifiedSearch]


def fit_in_folds(
    photographs: Sequence[SearchedPhotograph],
    searching: FovealObservationModel,
    config: VerificationConfig,
    prior: Verification | None = None,
    surest: float = _LEVELS[-1],
) -> VerificationInFolds:
    """Fit a verification to searches of photographs by a fovea (`fit_verification`).

    Args:
        photographs: photographs with the classes to search for.
        searching: leads the searches, and decides those without closer looks.
        config: settings of searches and folds.
        prior: centre of the prior of the parameters (None: a weak one around 0).
        surest: upper limit of `confirm`.

    Returns:
        The model, with thresholds, and what its report is made of.

    Raises:
        OneKindError: the closer looks are of one kind.
    """
    # The searches are made twice: all of them with their looks would not stay in memory.
    first = photograph_searches(photographs, searching, config.looks, "looking")
    again = photograph_searches(photographs, searching, config.looks, "verifying")
    limits = Thresholds(1.0, config.stop_below, config.place)
    return fit_verification(first, again, config.folds, limits, config.false_alarms, surest, prior)


def fit_verification(
    first: Iterable[TargetSearch],
    again: Iterable[TargetSearch],
    folds: int,
    limits: Thresholds,
    false_alarms: float,
    surest: float,
    prior: Verification | None = None,
) -> VerificationInFolds:
    """Fit the model and those of folds to closer looks, decide searches in the folds, and choose `confirm` on that.

    Args:
        first: searches in which closer looks are made to fit to.
        again: the same searches, to be decided.
        folds: number of parts of the pictures.
        limits: `stop_below` and `place` of the model, with `confirm` 1.
        false_alarms: largest share of the absent targets that may be found.
        surest: upper limit of `confirm`.
        prior: centre of the prior of the parameters (None: a weak one around 0).

    Returns:
        The model, with thresholds, and what its report is made of.

    Raises:
        OneKindError: the closer looks are of one kind.
    """
    closer_looks = examine(first, folds)
    if closer_looks.present.all() or not closer_looks.present.any():
        raise OneKindError(
            "data: expected closer looks in photographs that hold the target and in others, got one kind"
        )
    models = [fit_to_closer_looks(closer_looks, closer_looks.fold != fold, prior) for fold in range(folds)]
    model = fit_to_closer_looks(closer_looks, closer_looks.fold >= 0, prior)
    decided = list(verify(again, models, limits))
    model.thresholds = limits.changed(confirm=choose_confirm(decided, false_alarms, surest))
    return VerificationInFolds(model, models, closer_looks, decided)


@torch.inference_mode()
def examine(searches: Iterable[TargetSearch], folds: int = 1) -> CloserLookSamples:
    """Look closely at the most evident places of every search.

    Args:
        searches: searches for a class; spare ones are left out.
        folds: number of folds of the pictures.

    Returns:
        The closer looks.

    Raises:
        OneKindError: no place is right, or none is wrong.
    """
    features: list[Tensor] = []
    right: list[bool] = []
    present: list[bool] = []
    fold: list[int] = []
    known: list[float] = []
    for search in searches:
        if search.spare:
            continue
        prior = search.candidates().prior
        for look in examined_places(search):
            features.append(look.features)
            right.append(search.right(look.box))
            present.append(search.present)
            fold.append(search.picture % folds)
            known.append(with_prior(0.0, prior.share, prior.fitted))
    if len({*right}) < 2:
        raise OneKindError("data: expected places that hold the target and places that do not, got only one kind")
    answers = torch.tensor(right), torch.tensor(present)
    return CloserLookSamples(torch.stack(features), *answers, torch.tensor(fold), torch.tensor(known))


def examined_places(search: TargetSearch) -> Iterator[ExaminedLook]:
    """Look closely at the most evident places after some numbers of looks.

    Args:
        search: a search for a class.

    Yields:
        The closer looks.
    """
    least = Thresholds(confirm=1.0, stop_below=_LEAST_CHANCE, place=_LEAST_CHANCE)
    for looks in search.after:
        if looks > len(search.steps):
            return
        candidates = search.candidates()
        for step in search.steps[:looks]:
            candidates.see(step)
        for _ in range(_PLACES):
            candidate = candidates.due(least, last=True)
            if candidate is None:
                break
            detections = search.close_up(candidate.box)
            yield ExaminedLook(looks, candidate, detections, *candidates.examine(candidate, detections))


@torch.inference_mode()
def verify(
    searches: Iterable[TargetSearch],
    folds: Sequence[Verification],
    limits: Thresholds,
) -> Iterator[VerifiedSearch]:
    """Make all closer looks of searches, with the model that was not fitted to their picture.

    Args:
        searches: searches for a class.
        folds: models by fold.
        limits: which places are worth a closer look, and when no look is; with `confirm` 1 all closer looks are made,
            so that any threshold can be applied to the search afterwards.

    Yields:
        Each search with all its closer looks.
    """
    for search in searches:
        yield _verify_search(search, folds[search.picture % len(folds)], limits)


def _verify_search(search: TargetSearch, model: Verification, limits: Thresholds) -> VerifiedSearch:
    """Make all closer looks of a search, and decide it without them."""
    places = search.candidates()
    verifier = Verifier(model, places, limits)
    looks = 0
    ends: list[int] = []
    for number, step in enumerate(search.steps, 1):
        looks += 1
        verifier.see(step, last=number == len(search.steps))
        for _ in verifier.look_closely(search.close_up):
            looks += 1
            ends.append(looks)
        if verifier.outcome():
            break
    verifier.end()
    return VerifiedSearch(
        picture=search.picture,
        present=search.present,
        spare=search.spare,
        places=tuple((look.place, search.right(look.box)) for look in verifier.looks),
        ends=tuple(ends),
        presence=verifier.final_decision().probability,
        looks=looks,
        unverified=search.unverified(),
    )


def choose_confirm(searches: Sequence[VerifiedSearch], false_alarms: float, surest: float = _LEVELS[-1]) -> float:
    """Choose from `_LEVELS` the least threshold at which few enough absent targets are found.

    Args:
        searches: searches with all their closer looks.
        false_alarms: largest share of the absent targets that may be found.
        surest: upper limit of the threshold, even if more are found.

    Returns:
        The threshold `confirm`; `surest` if none has few enough.
    """
    absent = [search for search in searches if not search.present]
    for confirm in _LEVELS:
        alarms = sum(search.found(confirm).right is not None for search in absent)
        if alarms <= false_alarms * len(absent):
            return min(confirm, surest)
    return surest


def fit_to_closer_looks(
    closer_looks: CloserLookSamples, chosen: Tensor, prior: Verification | None = None
) -> Verification:
    r"""Fit both logistic regressions by penalised maximum likelihood, or maximum a posteriori.

    .. math:: \min_{w, b} \; \frac1N \sum_i \mathrm{BCE}(w^\top \phi_i + b + r_i, y_i) + \lambda |w'|^2,
              \quad\text{or}\quad \dots + \frac{\kappa}{N} \left( |w' - w'_0|^2 + (b' - b'_0)^2 \right)

    with w' the weights of features of zero mean and unit variance, λ = 1e-4, and w'₀, b'₀ those of a prior, κ = 10.
    How often searches for a class have their target in the picture says nothing of a look: these log odds r are known,
    and the regressions are of what remains.

    Args:
        closer_looks: closer looks at N places.
        chosen: `(N,)` boolean, those to fit to.
        prior: the prior's centre (None: penalised maximum likelihood).

    Returns:
        The model, without thresholds.

    Raises:
        OneKindError: fewer than two closer looks are chosen.
    """
    features = closer_looks.features[chosen].double()
    known = closer_looks.known[chosen].double()
    if len(features) < 2:
        raise OneKindError(
            f"data: expected closer looks in all folds but one, got {len(features)}; give more photographs"
        )
    mean = features.mean(0)
    scale = features.std(0).clamp(min=1e-6)  # of a feature that is always the same
    standardised = (features - mean) / scale
    model = Verification()
    for row, answers in enumerate((closer_looks.right, closer_looks.present)):
        before = _penalty(len(features)) if prior is None else _near(prior.linear, row, mean, scale)
        offset, *weights = logistic_regression(standardised, answers[chosen], known=known, prior=before)
        # The model reads features as they are.
        of_feature = torch.tensor(weights, dtype=torch.float64) / scale
        with torch.no_grad():
            model.linear.weight[row] = of_feature
            model.linear.bias[row] = offset - of_feature @ mean
    return model.eval().requires_grad_(False)


def _penalty(cases: int) -> tuple[Tensor, Tensor]:
    """Make centre and precision of coefficients `(8,)`, the offset first, that λ holds near 0, for N cases."""
    centre = torch.zeros(CLOSER_FEATURES + 1, dtype=torch.float64)
    # The regression sums over cases, so that λ counts N times, and takes half of a precision.
    precision = torch.full_like(centre, 2 * _RIDGE * cases)
    precision[0] = 0.0
    return centre, precision


def _near(linear: nn.Linear, row: int, mean: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Make centre and precision of coefficients of standardised features that are held near those of a model's row."""
    weight = linear.weight[row].detach().double()
    offset = linear.bias[row].detach().double() + weight @ mean
    centre = torch.cat([offset[None], weight * scale])
    return centre, torch.full_like(centre, 2 * _STRENGTH)

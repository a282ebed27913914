"""Fit the models for photographs: the probabilities of a class in a photograph, and of objects."""

from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.data.scene import Annotation, Scenes
from semfov.fit.logistic import logistic_regression
from semfov.fit.verification import VerifiedSearch, choose_confirm
from semfov.fit.verification_report import places_report
from semfov.fit.windows_certainty import Exploration, fit_with_spread
from semfov.fit.windows_decisions import search_to_end
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.observation.thresholds import Thresholds
from semfov.runs.progress import track
from semfov.runs.protocols import choose_classes, numbers_drawn
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.zoom import Lattice, WindowEye
from semfov.zoom.certainty import Certainty
from semfov.zoom.closer import MOST_IN_PHOTOGRAPH
from semfov.zoom.evidence import GlimpseEvidence, PhotographEvidence
from semfov.zoom.looks import Window, WindowLook, WindowLooks
from semfov.zoom.slices import usual_slices

_FOLDS = 5
_CHECKED = (1, 5)
"""Numbers of looks, at the whole and at all slices, after which the expected number is compared with the annotated one.
"""
_PRESENT = 2  # largest number of present classes to search for in a photograph
_ABSENT = 20
"""Number of absent classes to search for in a photograph. As many as there are present ones count for the fit."""
_NEAR = 5.0  # strength with which the shares of searches stay near those that the frequencies predict
_FALSE_ALARMS = 0.007  # maximum share of absent targets that may be reported as found; it determines the threshold

LEAST_CERTAINTY = 0.02
"""Least certainty of an object that is worth a closer look (docs/decisions/closer_looks.md)."""

_STRENGTH = 20.0
"""Strength with which the weight of the certainty is held near 1, which matters where few places are known."""

_AREA = 0.2  # classes that cover a larger share of a photograph are not searched for


class _PhotographSearch:
    """A search of a photograph, with all closer looks that its objects are worth.

    Attributes:
        picture: number of the photograph among those of the fit.
        target: the class, 1..K.
        spare: whether the search serves only to choose thresholds.
        source: the looks at the photograph.
        objects: `(M, 4)`, annotated boxes of the class.
        best: after each look the highest score of the class so far.
        places: certainty of the object at each place that was looked at closely, and whether the target is there.
        ends: number of looks up to each of these closer looks.
    """

    def __init__(self, picture: int, target: int, source: WindowLooks, objects: Tensor, *, spare: bool = False) -> None:
        self.picture = picture
        self.target = target
        self.spare = spare
        self.source = source
        self.objects = objects
        self.best: list[float] = []
        self.places: tuple[tuple[float, bool], ...] = ()
        self.ends: tuple[int, ...] = ()

    @property
    def present(self) -> bool:
        """Whether the photograph holds the class."""
        return len(self.objects) > 0

    def run(self, model: GlimpseEvidence) -> None:
        """Search as an agent does; with a threshold `confirm` of 1 no place ends it."""
        path = search_to_end(model, self.source, self.target, 1 + MOST_IN_PHOTOGRAPH)
        scores = (float(look.shown.show[self.target - 1]) for look in path.looks)
        self.best = list(accumulate(scores, max))
        closer = [(look, look.index) for look in path.closer if look.index is not None]
        self.places = tuple((look.place, self.right(look.box)) for look, _ in closer)
        self.ends = tuple(index + 1 for _, index in closer)

    def right(self, box: Tensor) -> bool:
        """Tell whether the centre of a box `(4,)` lies in an annotated box of the class."""
        centre = (box[:2] + box[2:]) / 2
        return bool(((self.objects[:, :2] <= centre) & (centre <= self.objects[:, 2:])).all(-1).any())

    def judged(self, evidence: PhotographEvidence) -> VerifiedSearch:
        """Sum up the search, with the probabilities of evidence."""
        presence = evidence.presence(torch.tensor(self.best[-1]), torch.tensor(self.target)).sigmoid()
        certainties = torch.tensor([certainty for certainty, _ in self.places])
        chances = evidence.at_place(certainties).sigmoid().tolist()
        return VerifiedSearch(
            picture=self.picture,
            present=self.present,
            spare=self.spare,
            places=tuple((chance, right) for chance, (_, right) in zip(chances, self.places, strict=True)),
            ends=self.ends,
            presence=max([float(presence), *chances]),
            looks=len(self.best),
            unverified=None,
        )


class _PhotographLooks(NamedTuple):
    """What the looks at P photographs give to fit to.

    Attributes:
        scores: `(P, K)`, highest score of each class in the look at the whole.
        searches: searches for present and for absent classes.
        explored: what the looks show of all classes, and of the most frequent one, by fold.
    """

    scores: Tensor
    searches: list[_PhotographSearch]
    explored: dict[str, list[Exploration]]


def fit_photographs(model: GlimpseEvidence, pictures: Scenes, eye: WindowEye, config: FitMosaicsConfig) -> str:
    """Fit the evidence for photographs on those with most pixels, in folds, and add it to a model.

    Args:
        model: evidence by magnification; it gets the evidence for photographs.
        pictures: photographs; the frequencies of classes are those in all of them.
        eye: looks at windows.
        config: how many photographs are looked at, and the settings of closer looks.

    Returns:
        The report in Markdown.
    """
    looked = _single_look_photographs(pictures, eye)[: config.photographs]
    if not looked:
        return "None, since no photograph is shown at more than half its size by one look.\n"
    held = _classes_held(pictures, model.classes)
    # With `confirm` 1 all closer looks are made, so that any threshold can be applied to a search afterwards.
    limits = Thresholds(1.0, LEAST_CERTAINTY)
    evidence = PhotographEvidence(model.classes, window=config.window, thresholds=limits).eval().requires_grad_(False)
    evidence.usual.copy_(_log_odds_held(held.sum(0), len(pictures)))
    model.photograph = evidence
    looks = _look_at(pictures, looked, eye, config)
    _search_in_folds(model, looks)
    certainty, report_on_spread = fit_with_spread(looks.explored, _fit_objects, _CHECKED)
    evidence.certainty = certainty.requires_grad_(False)
    _fit_presence(evidence, looks.searches, held)
    drawn = shares_by_frequency(evidence.usual, pictures)
    evidence.shares = measured_shares(evidence, looks.scores, held[looked], drawn)
    searches = _judged_in_folds(evidence, looks.searches)
    _fit_places(evidence, looks.searches)
    least = float(evidence.at_place(torch.tensor(LEAST_CERTAINTY)).sigmoid())
    confirm = choose_confirm(searches, _FALSE_ALARMS, config.surest)
    evidence.thresholds = Thresholds(confirm, round(least, 3))
    model.metadata["photograph"] = {"photographs": len(looked), "frequencies": len(pictures)}
    report = places_report(searches, confirm, f"{len(looked)} photographs")
    return "\n".join([*report, *report_on_spread])


def _single_look_photographs(pictures: Scenes, eye: WindowEye) -> list[int]:
    """Find the photographs that one look shows at more than half their size; those with most pixels come first."""
    canvas = eye.detector.input_size
    sizes = [pictures.annotation(index).size for index in range(len(pictures))]
    single = [index for index, size in enumerate(sizes) if Lattice.over(size, canvas).levels == 1]
    # Enlarged windows need pixels.
    return sorted(single, key=lambda index: -max(sizes[index]))


def _classes_held(pictures: Scenes, classes: int) -> Tensor:
    """Tell which classes each photograph holds, `(photographs, K)` boolean."""
    held = torch.zeros(len(pictures), classes, dtype=torch.bool)
    for index in range(len(pictures)):
        held[index, pictures.annotation(index).labels - 1] = True
    return held


def _look_at(pictures: Scenes, looked: Sequence[int], eye: WindowEye, config: FitMosaicsConfig) -> _PhotographLooks:
    """Look at the whole of photographs and at all their slices, and draw searches of them."""
    scores: list[Tensor] = []
    searches: list[_PhotographSearch] = []
    explored: dict[str, list[Exploration]] = {f"fold {fold + 1}": [] for fold in range(_FOLDS)}
    for number, index in enumerate(track(looked, "looking at photographs", "photograph")):
        annotation = pictures.annotation(index)
        source = StoredWindowLooks(eye, pictures, index, None)  # in memory alone: files of looks lack its hints
        with torch.inference_mode():
            looks = source.see([Window.overview(source.lattice), *usual_slices(source.lattice)])
        scores.append(looks[0].show)
        counted = choose_classes(pictures, index, annotation, _PRESENT, _AREA, config.seed)
        # The same draw with more absent classes begins with the same ones.
        targets = choose_classes(pictures, index, annotation, _PRESENT, _AREA, config.seed, _ABSENT)
        for place, target in enumerate(targets):
            objects = annotation.boxes[annotation.labels == target]
            searches.append(_PhotographSearch(number, target, source, objects, spare=place >= len(counted)))
        explored[f"fold {number % _FOLDS + 1}"] += _explored(looks, source.lattice, annotation)
    return _PhotographLooks(torch.stack(scores), searches, explored)


@torch.inference_mode()
def _search_in_folds(model: GlimpseEvidence, looks: _PhotographLooks) -> None:
    """Make all searches, those of each fold with the certainty of objects that is fitted to the others."""
    assert model.photograph is not None
    certainties: list[Certainty] = []
    for fold in looks.explored:
        others = [exploration for other, group in looks.explored.items() if other != fold for exploration in group]
        # Of a single photograph there are no others.
        certainties.append(_fit_objects(others or looks.explored[fold]).requires_grad_(False))
    for search in track(looks.searches, "searching photographs", "search"):
        model.photograph.certainty = certainties[search.picture % _FOLDS]
        search.run(model)


def _fit_presence(evidence: PhotographEvidence, searches: Sequence[_PhotographSearch], held: Tensor) -> None:
    """Fit the probability of a class after each look of a search, with its frequency in the other photographs.

    A search counts once for each of its looks.
    """
    totals = held.sum(0)
    best: list[float] = []
    holding: list[int] = []
    present: list[bool] = []
    for search in searches:
        if not search.spare:
            looks = len(search.best)
            best += search.best
            # A photograph must not tell its own answer by the frequency, which is therefore that in the others.
            holding += [int(totals[search.target - 1]) - search.present] * looks
            present += [search.present] * looks
    in_others = _log_odds_held(torch.tensor(holding), len(held) - 1)
    facts = torch.stack([torch.tensor(best, dtype=torch.float64).logit(1e-4), in_others], -1)
    offset, *weights = logistic_regression(facts, torch.tensor(present))
    evidence.whole.weight.copy_(torch.tensor([weights]))
    evidence.whole.bias.fill_(offset)


def _fit_places(evidence: PhotographEvidence, searches: Sequence[_PhotographSearch]) -> None:
    """Fit the probability of places that were looked at closely, near that of the objects there."""
    places = [place for search in searches if not search.spare for place in search.places]
    certainty = torch.tensor([certainty for certainty, _ in places], dtype=torch.float64)
    right = torch.tensor([is_right for _, is_right in places])
    near = torch.tensor([0.0, 1.0], dtype=torch.float64), torch.tensor([1.0, _STRENGTH], dtype=torch.float64)
    offset, weight = logistic_regression(certainty.logit(1e-4)[:, None], right, prior=near)
    if weight <= 0:
        # A few places that are wrong where objects are sure, and right elsewhere, tell nothing.
        offset, weight = 0.0, 1.0
    evidence.place.weight.fill_(weight)
    evidence.place.bias.fill_(offset)


def _judged_in_folds(evidence: PhotographEvidence, searches: Sequence[_PhotographSearch]) -> list[VerifiedSearch]:
    """Judge the places of searches by regressions that are fitted to the other folds."""
    judged: list[VerifiedSearch] = []
    for fold in range(_FOLDS):
        _fit_places(evidence, [search for search in searches if search.picture % _FOLDS != fold])
        judged += [search.judged(evidence) for search in searches if search.picture % _FOLDS == fold]
    return judged


def shares_by_frequency(usual: Tensor, pictures: Scenes) -> Tensor:
    r"""Predict the share π of searches with a present target for each class, by the class frequency alone.

    .. math:: \operatorname{logit} \pi_t = b_0 \operatorname{logit} q_t + c_0

    `PhotographEvidence` knows of a class no more than its frequency q, so that this is the prior that it has learned.
    The shares of single classes differ: those that fill a photograph are not searched for there.

    Args:
        usual: `(K,)`, log odds of the frequencies q.
        pictures: the photographs.

    Returns:
        The shares, `(K,)`.
    """
    there, missing = numbers_drawn(pictures, _PRESENT, _AREA)
    present = torch.cat([torch.ones(len(there)), torch.zeros(len(missing))])
    offset, slope = logistic_regression(usual.repeat(2)[:, None], present, times=torch.cat([there, missing]))
    # Their log odds are read, which a share that is rounded to 0 or 1 does not have.
    return (slope * usual.double() + offset).sigmoid().clamp(1e-4, 1 - 1e-4).float()


def measured_shares(evidence: PhotographEvidence, scores: Tensor, held: Tensor, shares: Tensor) -> Tensor:
    r"""Fit shares with which searches of all photographs for each class have the right probabilities, near others.

    Some classes are hinted at more often than others where they are not, such as chairs: their score tells less than
    that of a class as frequent. The shift δ of the log odds of each class maximises the likelihood of all photographs,

    .. math:: \sum_i \ln P(y_{it} \mid \operatorname{logit} P_{it} + \delta_t)
              - \frac{\lambda}{2} (\delta_t - \operatorname{logit} q_t + \operatorname{logit} \pi_t)^2

    with the share q of these photographs, and gives :math:`\operatorname{logit} q_t - \delta_t` as log odds.

    Args:
        evidence: the evidence for photographs, with its probability after the look at the whole.
        scores: `(P, K)`, highest ones in the looks at the whole.
        held: `(P, K)` boolean, the classes of each photograph.
        shares: `(K,)`, shares π to stay near.

    Returns:
        The shares, `(K,)`.
    """
    classes = torch.arange(scores.shape[-1]) + 1
    log_odds = evidence.presence(scores, classes.expand(scores.shape)).detach().double()
    usual = _log_odds_held(held.sum(0), len(held))
    expected = usual - shares.double().logit()
    no_facts = log_odds.new_zeros(len(held), 0)
    strength = torch.tensor([_NEAR], dtype=torch.float64)
    shifts = []
    for known, is_held, near in zip(log_odds.mT, held.mT, expected, strict=True):
        shifts += logistic_regression(no_facts, is_held, known=known, prior=(near[None], strength))
    return (usual - torch.tensor(shifts)).sigmoid().clamp(1e-4, 1 - 1e-4).float()


def _explored(looks: Sequence[WindowLook], lattice: Lattice, annotation: Annotation) -> Iterator[Exploration]:
    """Judge what the whole, and all slices, show of all classes, and of the most frequent class."""
    targets: list[int | None] = [None]
    if len(annotation.labels):
        targets.append(int(annotation.labels.mode().values))
    for target in targets:
        # After all slices, no look is left that could show more.
        remaining = [(0.0, 0.0)] * len(looks)
        promised = [0.0] * len(looks)
        yield Exploration.of(target, looks, {1, len(looks)}, lattice, annotation, remaining, promised)


def _fit_objects(explored: Sequence[Exploration]) -> Certainty:
    """Fit the probability of objects of all classes; looks at all slices leave nothing to expect."""
    objects = [
        of_look for exploration in explored if exploration.target is None for of_look in exploration.objects.values()
    ]
    facts, right = (torch.cat(column) for column in zip(*objects, strict=True))
    counted = right >= 0  # not in a crowd
    offset, *weights = logistic_regression(facts[counted], right[counted] > 0)
    return Certainty(offset, tuple(weights), strength=1.0)


def _log_odds_held(held: Tensor, count: int) -> Tensor:
    """Compute the log odds that a photograph holds each class, half a photograph for and against added."""
    return ((held + 0.5) / (count + 1)).double().logit()

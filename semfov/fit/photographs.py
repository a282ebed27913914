"""Fit the evidence for photographs: whether one holds a class, before and after closer looks, and what an object is."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.verification import Verification
from semfov.data.scene import Annotation, Scenes
from semfov.detection.detections import Detections
from semfov.fit.logistic import logistic_regression
from semfov.fit.searches import TargetSearch
from semfov.fit.verification import OneKindError, fit_verification
from semfov.fit.verification_report import NO_PLACES, verification_report
from semfov.fit.windows_certainty import Exploration, fit_with_spread
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.observation.thresholds import Thresholds
from semfov.runs.progress import track
from semfov.runs.protocols import choose_classes, numbers_drawn
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.zoom import Lattice, WindowEye
from semfov.zoom.certainty import Certainty
from semfov.zoom.closer import MOST_IN_PHOTOGRAPH, PhotographPlaces, TargetFacts, look_closely
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

_AREA = 0.2  # classes that cover a larger share of a photograph are not searched for


class _WholeSearch(TargetSearch[TargetFacts]):
    """A search of a photograph after the look at the whole.

    Attributes:
        source: the looks at the photograph.
        whole: the look at the whole.
        objects: `(M, 4)`, annotated boxes of the class.
        evidence: tells the probability of the class after the look.
        best: highest score of the class.
    """

    after = (1,)
    most = MOST_IN_PHOTOGRAPH

    def __init__(
        self,
        number: int,
        target: int,
        source: WindowLooks,
        whole: WindowLook,
        objects: Tensor,
        evidence: PhotographEvidence,
        *,
        spare: bool = False,
    ) -> None:
        self.picture = number
        self.target = target
        self.present = len(objects) > 0
        self.spare = spare
        self.source = source
        self.whole = whole
        self.objects = objects
        self.evidence = evidence
        self.best = float(whole.show[target - 1])

    def __len__(self) -> int:
        return 1

    def look(self, index: int, number: int) -> TargetFacts:
        """Return the look at the whole, with the probability after it."""
        presence = self.evidence.presence(torch.tensor(self.best), torch.tensor(self.target)).sigmoid()
        return TargetFacts(self.whole.candidates, number, float(presence), self.best, 0.0)

    def candidates(self) -> PhotographPlaces:
        places = PhotographPlaces(self.target, self.source.lattice, window=self.evidence.window)
        places.keep_whole(0, self.whole.candidates)
        return places

    def close_up(self, box: Tensor) -> Detections:
        return look_closely(self.source, box, self.evidence.window).candidates

    def right(self, box: Tensor) -> bool:
        """Tell whether the centre of a box `(4,)` lies in an annotated box of the class."""
        centre = (box[:2] + box[2:]) / 2
        return bool(((self.objects[:, :2] <= centre) & (centre <= self.objects[:, 2:])).all(-1).any())


class _PhotographLooks(NamedTuple):
    """What the looks at P photographs give to fit to.

    Attributes:
        scores: `(P, K)`, highest score of each class in the look at the whole.
        searches: searches for present and for absent classes.
        explored: what the looks show of all classes, and of the most frequent one, by fold.
    """

    scores: Tensor
    searches: list[_WholeSearch]
    explored: dict[str, list[Exploration]]


def fit_photographs(
    model: GlimpseEvidence,
    pictures: Scenes,
    eye: WindowEye,
    config: FitMosaicsConfig,
    prior: Verification | None = None,
) -> str:
    """Fit the evidence for photographs on those with most pixels, in folds, and add it to a model.

    Args:
        model: evidence by magnification; it gets the evidence for photographs.
        pictures: photographs; the frequencies of classes are those in all of them.
        eye: looks at windows.
        config: how many photographs are looked at, and the settings of closer looks.
        prior: centre of the prior of the verification (None: a weak one around 0).

    Returns:
        The report in Markdown.
    """
    looked = _single_look_photographs(pictures, eye)[: config.photographs]
    if not looked:
        return "None, since no photograph is shown at more than half its size by one look.\n"
    held = _classes_held(pictures, model.classes)
    evidence = PhotographEvidence(model.classes, window=config.window).eval().requires_grad_(False)
    evidence.usual.copy_(_log_odds_held(held.sum(0), len(pictures)))
    looks = _look_at(pictures, looked, eye, evidence, config)
    certainty, report_on_spread = fit_with_spread(looks.explored, _fit_objects, _CHECKED)
    evidence.certainty = certainty.requires_grad_(False)
    _fit_whole(evidence, looks.searches, held)
    drawn = shares_by_frequency(evidence.usual, pictures)
    evidence.shares = measured_shares(evidence, looks.scores, held[looked], drawn)
    report = _fit_closer_looks(evidence, looks.searches, config, prior)
    model.photograph = evidence
    model.metadata["photograph"] = {"photographs": len(looked), "frequencies": len(pictures)}
    return "\n".join([report, *report_on_spread])


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


def _look_at(
    pictures: Scenes,
    looked: Sequence[int],
    eye: WindowEye,
    evidence: PhotographEvidence,
    config: FitMosaicsConfig,
) -> _PhotographLooks:
    """Look at the whole of photographs and at all their slices, and draw searches of them."""
    scores: list[Tensor] = []
    searches: list[_WholeSearch] = []
    explored: dict[str, list[Exploration]] = {f"fold {fold + 1}": [] for fold in range(_FOLDS)}
    for number, index in enumerate(track(looked, "looking at photographs", "photograph")):
        annotation = pictures.annotation(index)
        source = StoredWindowLooks(eye, pictures, index, None)  # in memory alone: files of looks lack its hints
        with torch.inference_mode():
            looks = source.see([Window.overview(source.lattice), *usual_slices(source.lattice)])
        overview = looks[0]
        scores.append(overview.show)
        counted = choose_classes(pictures, index, annotation, _PRESENT, _AREA, config.seed)
        # The same draw with more absent classes begins with the same ones.
        targets = choose_classes(pictures, index, annotation, _PRESENT, _AREA, config.seed, _ABSENT)
        for place, target in enumerate(targets):
            objects = annotation.boxes[annotation.labels == target]
            spare = place >= len(counted)
            searches.append(_WholeSearch(number, target, source, overview, objects, evidence, spare=spare))
        explored[f"fold {number % _FOLDS + 1}"] += _explored(looks, source.lattice, annotation)
    return _PhotographLooks(torch.stack(scores), searches, explored)


def _fit_whole(evidence: PhotographEvidence, searches: Sequence[_WholeSearch], held: Tensor) -> None:
    """Fit the probability of a class after the look at the whole, with its frequency in the other photographs."""
    counted = [search for search in searches if not search.spare]
    totals = held.sum(0)
    best = torch.tensor([search.best for search in counted], dtype=torch.float64)
    present = torch.tensor([search.present for search in counted])
    holding = torch.tensor([int(totals[search.target - 1]) for search in counted])
    in_others = _log_odds_held(holding - present.long(), len(held) - 1)
    # A photograph must not tell its own answer by the frequency, which is therefore that in the others.
    offset, *weights = logistic_regression(torch.stack([best.logit(1e-4), in_others], -1), present)
    evidence.whole.weight.copy_(torch.tensor([weights]))
    evidence.whole.bias.fill_(offset)


def shares_by_frequency(usual: Tensor, pictures: Scenes) -> Tensor:
    r"""Predict the share π of the searches for each class whose target is there, by its frequency alone.

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


def _fit_closer_looks(
    evidence: PhotographEvidence, searches: Sequence[_WholeSearch], config: FitMosaicsConfig, prior: Verification | None
) -> str:
    """Fit the probabilities after a closer look and choose the thresholds; the report in Markdown."""
    limits = Thresholds(1.0, config.stop_below, config.stop_below)
    try:
        fitted = fit_verification(searches, searches, _FOLDS, limits, _FALSE_ALARMS, config.surest, prior)
    except OneKindError:
        return NO_PLACES
    evidence.verification = fitted.model
    pictures = f"{len({search.picture for search in searches})} photographs"
    return verification_report(fitted, pictures).text

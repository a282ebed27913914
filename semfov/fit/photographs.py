"""Fit the evidence for photographs: whether one holds a class, before and after closer looks, and what an object is."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification
from semfov.data.scene import Annotation, Scenes
from semfov.fit.searches import TargetSearch
from semfov.fit.verification import choose_confirm, examine, fit, verification_report, verify
from semfov.fit.windows_certainty import Exploration, fit_spread, left_out, logistic_regression
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.runs.progress import track
from semfov.runs.protocols import choose_classes, numbers_drawn
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.zoom import Lattice, WindowEye
from semfov.zoom.certainty import Certainty
from semfov.zoom.closer import MOST_IN_PHOTOGRAPH, PhotographPlaces, SearchLook, look_closely
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
_NEWTON_STEPS = 50
_FALSE_ALARMS = 0.007  # maximum share of absent targets that may be reported as found; it determines the threshold

_AREA = 0.2  # classes that cover a larger share of a photograph are not searched for


class _WholeSearch(TargetSearch[SearchLook]):
    """A search of a photograph after the look at the whole; objects `(M, 4)`."""

    after = (1,)
    most = MOST_IN_PHOTOGRAPH

    def __init__(
        self,
        number: int,
        target: int,
        source: WindowLooks,
        whole: WindowLook,
        objects: Tensor,
        model: PhotographEvidence,
        *,
        spare: bool = False,
    ) -> None:
        self.picture, self.target, self.present, self.spare = number, target, len(objects) > 0, spare
        self.candidates = partial(PhotographPlaces, target, source.lattice, window=model.window)
        self.close_up = lambda box: look_closely(source, box, model.window).candidates
        self.steps, self.objects, self.model = (whole,), objects, model
        self.best = float(whole.show[target - 1])  # highest score of the target

    def look(self, index: int, number: int) -> SearchLook:
        """The look at the whole, with the probability after it."""
        presence = self.model.presence(torch.tensor(self.best), torch.tensor(self.target)).sigmoid()
        return SearchLook(self.steps[0].candidates, number, float(presence), self.best, 0.0)

    def right(self, box: Tensor) -> bool:
        """Whether the centre of a box `(4,)` lies in an annotated box of the class."""
        centre = (box[:2] + box[2:]) / 2
        return bool(((self.objects[:, :2] <= centre) & (centre <= self.objects[:, 2:])).all(-1).any())


def fit_photographs(
    model: GlimpseEvidence,
    pictures: Scenes,
    eye: WindowEye,
    config: FitMosaicsConfig,
    prior: Verification | None = None,
) -> str:
    """Fit the evidence for photographs on those with most pixels, in folds, and add it to the model; the report."""
    canvas = eye.detector.input_size
    single = [n for n in range(len(pictures)) if Lattice.over(pictures.annotation(n).size, canvas).levels == 1]
    if not single:
        return "None, since no photograph is shown at more than half its size by one look.\n"
    # Enlarged windows need pixels.
    single.sort(key=lambda n: -max(pictures.annotation(n).size))
    count, held = len(pictures), torch.zeros(len(pictures), model.classes, dtype=torch.bool)
    for index in range(count):
        held[index, pictures.annotation(index).labels - 1] = True
    evidence = PhotographEvidence(model.classes, window=config.window).eval().requires_grad_(False)
    evidence.usual.copy_(_usual(held.sum(0), count))
    searches: list[_WholeSearch] = []
    shown: list[Tensor] = []
    looked = single[: config.photographs]
    explored: dict[str, list[Exploration]] = {f"fold {fold + 1}": [] for fold in range(_FOLDS)}
    for number, index in enumerate(track(looked, "looking at photographs", "photograph")):
        annotation = pictures.annotation(index)
        source = StoredWindowLooks(eye, pictures, index, None)
        with torch.inference_mode():
            looks = source.see([Window.overview(source.lattice), *usual_slices(source.lattice)])
        shown.append(looks[0].show)
        usual = choose_classes(pictures, index, annotation, _PRESENT, _AREA, config.seed)
        # The same draw with more absent classes begins with the same ones.
        more = choose_classes(pictures, index, annotation, _PRESENT, _AREA, config.seed, _ABSENT)
        for place, target in enumerate(more):
            boxes, spare = annotation.boxes[annotation.labels == target], place >= len(usual)
            searches.append(_WholeSearch(number, target, source, looks[0], boxes, evidence, spare=spare))
        explored[f"fold {number % _FOLDS + 1}"] += _explored(looks, source.lattice, annotation)
    numbers = left_out(explored, _fit_objects, _CHECKED)
    told: list[str] = []
    evidence.certainty = certainty = _fit_objects([each for fold in explored.values() for each in fold])
    if numbers:
        spread, told = fit_spread(numbers)
        evidence.certainty = replace(certainty, spread=spread)
    # After the look at the whole, with frequencies in the other photographs.
    total, some = held.sum(0), [each for each in searches if not each.spare]
    best = torch.tensor([search.best for search in some], dtype=torch.float64)
    present = torch.tensor([search.present for search in some])
    holding = torch.tensor([int(total[search.target - 1]) for search in some])
    others = _usual(holding - present.long(), count - 1)
    offset, *weights = logistic_regression(torch.stack([best.logit(1e-4), others], -1), present)
    evidence.whole.weight.copy_(torch.tensor([weights]))
    evidence.whole.bias.fill_(offset)
    drawn = shares_by_frequency(evidence.usual, pictures)
    evidence.shares = measured_shares(evidence, torch.stack(shown), held[looked], drawn)
    text = _fit_closer(evidence, searches, config, prior)
    model.photograph = evidence
    model.metadata["photograph"] = {"photographs": len(looked), "frequencies": count}
    return "\n".join([text, *told])


def shares_by_frequency(usual: Tensor, pictures: Scenes) -> Tensor:
    r"""Share π of the searches for each class whose target is there, `(K,)`, as the frequency alone predicts it.

    .. math:: \operatorname{logit} \pi_t = b_0 \operatorname{logit} q_t + c_0

    `PhotographEvidence` knows of a class no more than its frequency q, so that this is the prior that it has learned.
    The shares of single classes differ: those that fill a photograph are not searched for there.
    """
    there, missing = numbers_drawn(pictures, _PRESENT, _AREA)
    present = torch.cat([torch.ones(len(there)), torch.zeros(len(missing))])
    offset, slope = logistic_regression(usual.repeat(2)[:, None], present, times=torch.cat([there, missing]))
    return (slope * usual.double() + offset).sigmoid().clamp(1e-4, 1 - 1e-4).float()


def measured_shares(evidence: PhotographEvidence, scores: Tensor, held: Tensor, shares: Tensor) -> Tensor:
    r"""Shares `(K,)` with which searches of all photographs for each class have the right probabilities, near others.

    Some classes are hinted at more often than others where they are not, such as chairs: their score tells less than
    that of a class as frequent. The shift δ of the log odds of each class maximises the likelihood of all photographs,

    .. math:: \sum_i \ln P(y_{it} \mid \operatorname{logit} P_{it} + \delta_t)
              - \frac{\lambda}{2} (\delta_t - \operatorname{logit} q_t + \operatorname{logit} \pi_t)^2

    with the share q of these photographs, and gives :math:`\operatorname{logit} q_t - \delta_t` as log odds.

    Shapes: scores `(P, K)`, highest ones in the looks at the whole; held `(P, K)`; shares `(K,)`.
    """
    odds = evidence.presence(scores, (torch.arange(scores.shape[-1]) + 1).expand(scores.shape)).double()
    present = held.double()
    usual = _usual(held.sum(0), len(held))
    expected = usual - shares.double().logit()
    shift = expected.clone()
    for _ in range(_NEWTON_STEPS):
        chance = (odds + shift).sigmoid()
        gradient = (present - chance).sum(0) - _NEAR * (shift - expected)
        curvature = (chance * (1 - chance)).sum(0) + _NEAR
        shift = shift + (gradient / curvature).clamp(-1, 1)
    return (usual - shift).sigmoid().clamp(1e-4, 1 - 1e-4).float()


def _explored(looks: Sequence[WindowLook], lattice: Lattice, annotation: Annotation) -> Iterator[Exploration]:
    """What the whole, and the whole with all slices, show of all classes, and of the most frequent class."""
    labels = annotation.labels
    for target in (None, *([int(labels.mode().values)] if len(labels) else [])):
        nothing, none = [(0.0, 0.0)] * len(looks), [0.0] * len(looks)
        yield Exploration.of(target, looks, {1, len(looks)}, lattice, annotation, nothing, none)


def _fit_objects(explored: Sequence[Exploration]) -> Certainty:
    """Fit the probability of objects of all classes; looks at all slices leave nothing to expect."""
    after = [seen for each in explored if each.target is None for seen in each.objects.values()]
    facts, right = (torch.cat(column) for column in zip(*after, strict=True))
    offset, *weights = logistic_regression(facts[right >= 0], right[right >= 0] > 0)
    return Certainty(offset, tuple(weights), strength=1.0)


def _usual(held: Tensor, count: int) -> Tensor:
    """Log odds that a photograph holds each class, half a photograph for and against added."""
    return ((held + 0.5) / (count + 1)).double().logit()


def _fit_closer(
    evidence: PhotographEvidence, searches: Sequence[_WholeSearch], config: FitMosaicsConfig, prior: Verification | None
) -> str:
    """Fit the probabilities after a closer look and choose the thresholds; the report in Markdown."""
    closer = examine(searches, _FOLDS)
    if closer is None:
        return "None, since there are no places that hold the target, or none that do not.\n"
    chosen = [fit(closer, closer.fold != fold, prior) for fold in range(_FOLDS)]
    decisions = list(verify(searches, chosen, Thresholds(1.0, config.worth, config.worth), None))
    confirm = choose_confirm(decisions, _FALSE_ALARMS, config.surest)
    fitted = fit(closer, closer.fold >= 0, prior)
    fitted.thresholds = Thresholds(confirm, config.worth, config.worth)
    evidence.verification = fitted
    pictures = f"{len({each.picture for each in searches})} photographs"
    return verification_report(fitted, chosen, closer, decisions, pictures)[0]

"""Fit the verification of targets by closer looks, from searches of photographs with boxes."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.belief.verification import CLOSER_FEATURES, Verification
from semfov.decision import OUTCOMES, Verifier, verified
from semfov.errors import DataError
from semfov.fit.detector_report import Difference
from semfov.fit.evidence import SUREST_OF_FEW
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.searches import SearchedPhotograph, TargetSearch, open_photographs, photograph_searches
from semfov.fit.settings import FitOnCellsConfig
from semfov.fit.training import training_of
from semfov.io.manifest import Part
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import FloatArray, area_under_roc
from semfov.runs.settings import Count, Positive, Range, Share
from semfov.runs.tables import mean_or_dash, share, table

_LEVELS = tuple(number / 100 for number in range(50, 100))  # values from which the threshold `confirm` is chosen
_SHIPPED = ("yolox-nano", "yolov3-tiny")  # shipped models whose mean is the centre of the prior for other detectors
_STRENGTH = 10.0
"""Strength of this prior, chosen on photographs that no result is reported on (docs/decisions/closer_looks.md)."""

_EACH = 3  # places examined after some looks
_LEAST = 0.03  # least probability of these places
_RIDGE = 1e-4

_THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9)  # values of the threshold `confirm` in the table, besides the chosen one

_SearchEnd = tuple[bool | None, int]
"""End of a search: whether the place that it found is right (None: not found), and the number of looks until then."""
_ABSENT = 200  # the threshold is chosen on about this many searches for absent classes, at most 20 in a photograph


@dataclass(frozen=True)
class VerificationConfig(FitOnCellsConfig):
    """Fit the verification of targets.

    Args:
        classes: maximum number of present classes to search for in each photograph.
        absent: maximum number of absent classes to search for (None: as many as present ones).
        max_target_area: classes that cover a larger share of the image are not searched for.
        looks: number of looks in a search.
        place: least probability of a cell that is worth a closer look.
        give_up: least probability of a cell that is worth a fixation.
        false_alarms: maximum share of absent targets that may be reported as found; it determines `confirm`.
        folds: number of parts of the photographs; each part is evaluated with a model that is fitted to the others.
    """

    classes: Count = 2
    absent: Count | None = None
    max_target_area: Positive = 0.2
    looks: Annotated[int, Range(2, 10_000)] = 12
    place: Share = 0.2
    give_up: Share = 0.2
    false_alarms: Share = 0.01
    folds: Annotated[int, Range(2, 1000)] = 5


class _VerifiedSearch(NamedTuple):
    """A search in which all closer looks were made, whatever they showed."""

    picture: int
    present: bool
    spare: bool
    places: tuple[tuple[float, bool], ...]
    ends: tuple[int, ...]
    presence: float
    looks: int
    unverified: _SearchEnd

    def found(self, confirm: float) -> _SearchEnd:
        """Return the end of the search at a threshold."""
        chances = [chance for chance, _ in self.places]
        for number, end in enumerate(self.ends, 1):
            if verified(chances[:number], self.presence, confirm, over=False):
                return self.places[number - 1][1], end
        if OUTCOMES[verified(chances, self.presence, confirm, over=True)] != "found":
            return None, self.looks
        return self.places[chances.index(max(chances))][1], self.looks


class _CloserLooks(NamedTuple):
    """Closer looks at N places that seemed to hold a target; features `(N, 7)`."""

    features: Tensor
    right: Tensor
    present: Tensor
    fold: Tensor


def fit_in_folds(
    photographs: Sequence[SearchedPhotograph],
    evidence: TargetEvidence,
    config: VerificationConfig,
    prior: Verification | None = None,
    surest: float = _LEVELS[-1],
) -> tuple[Verification, list[Verification], _CloserLooks, list[_VerifiedSearch]]:
    """Fit the model and those of folds to closer looks, search again in the folds, and choose `confirm` on that."""
    closer = examine(photograph_searches(photographs, evidence, config.looks, "looking"), config.folds)
    if closer is None:
        raise DataError("data: expected places that hold the target and places that do not, got only one kind")
    folds = [fit(closer, closer.fold != fold, prior) for fold in range(config.folds)]
    model = fit(closer, closer.fold >= 0, prior)
    again = photograph_searches(photographs, evidence, config.looks, "verifying")
    limits = Thresholds(1.0, config.give_up, config.place)
    searches = list(verify(again, folds, limits, evidence.thresholds))
    confirm = choose_confirm(searches, config.false_alarms, surest)
    model.thresholds = Thresholds(confirm, config.give_up, config.place)
    return model, folds, closer, searches


@torch.inference_mode()
def examine(searches: Iterable[TargetSearch[Any]], folds: int = 1) -> _CloserLooks | None:
    """Look closely at the most evident places of every search; None if no place is right, or none is wrong."""
    rows: list[tuple[Tensor, bool, bool, int]] = []
    for search in searches:
        if search.spare:
            continue
        for count in (each for each in search.after if each <= len(search.steps)):
            candidates = search.candidates()
            for index in range(count):
                candidates.see(search.look(index, index + 1))
            for _ in range(_EACH):
                candidate = candidates.due(_LEAST, last=True)
                if candidate is None:
                    break
                features, box = candidates.examine(candidate, search.close_up)
                rows.append((features, search.right(box), search.present, search.picture % folds))
    if len({right for _, right, _, _ in rows}) < 2:
        return None
    columns = list(zip(*rows, strict=True))
    return _CloserLooks(torch.stack(columns[0]), *(torch.tensor(column) for column in columns[1:]))


@torch.inference_mode()
def verify(
    searches: Iterable[TargetSearch[Any]],
    folds: Sequence[Verification],
    limits: Thresholds,
    thresholds: Thresholds | None,
) -> Iterator[_VerifiedSearch]:
    """Make all closer looks of searches, with the model that was not fitted to their picture."""
    for search in searches:
        model = folds[search.picture % len(folds)]
        places, count, ends = search.candidates(), 0, list[int]()
        verifier = Verifier(model, places, search.close_up, limits, search.most)
        for index in range(len(search.steps)):
            count += 1
            room = search.passes - count
            # Where passes are limited, a search ends with them, after the last closer look.
            last = index + 1 == len(search.steps) if room == math.inf else room <= 1
            verifier.see(search.look(index, count), last=last)
            for _ in verifier.look_closely(room):
                count += 1
                ends.append(count)
            if verifier.outcome() or count >= search.passes:
                break
        yield _VerifiedSearch(
            picture=search.picture,
            present=search.present,
            spare=search.spare,
            places=tuple((look.place, search.right(look.box)) for look in verifier.looks),
            ends=() if places.by_worth else tuple(ends),
            presence=verifier.decision(over=True).probability,
            looks=count,
            unverified=_unverified(search, thresholds),
        )


def _unverified(search: TargetSearch[Any], thresholds: Thresholds | None) -> _SearchEnd:
    """Decide along the looks of a search without closer looks; nothing is found without thresholds."""
    if thresholds is None:
        return None, len(search.steps)
    for index in range(len(search.steps)):
        outcome, right = search.decided(index, thresholds)
        if outcome:
            return right, index + 1
    return None, len(search.steps)


def choose_confirm(searches: Sequence[_VerifiedSearch], false_alarms: float, surest: float = _LEVELS[-1]) -> float:
    """Choose from `_LEVELS` the least threshold, at most `surest`, at which few enough absent targets are found."""
    absent = [each for each in searches if not each.present]
    for confirm in _LEVELS:
        if sum(each.found(confirm)[0] is not None for each in absent) <= false_alarms * len(absent):
            return min(confirm, surest)
    return surest


def fit(closer: _CloserLooks, chosen: Tensor, prior: Verification | None = None) -> Verification:
    r"""Fit both logistic regressions by penalised maximum likelihood, or maximum a posteriori; chosen `(N,)`.

    .. math:: \min_{w, b} \; \frac1N \sum_i \mathrm{BCE}(w^\top \phi_i + b, y_i) + \lambda |w'|^2, \quad\text{or}\quad
              \dots + \frac{\kappa}{N} \left( |w' - w'_0|^2 + (b' - b'_0)^2 \right)

    with w' the weights of features of zero mean and unit variance, λ = 1e-4, and w'₀, b'₀ those of a prior, κ = 10.
    """
    phi = closer.features[chosen].double()
    if len(phi) < 2:
        raise DataError(f"data: expected closer looks in all folds but one, got {len(phi)}; give more photographs")
    goal = torch.stack([closer.right, closer.present], -1)[chosen].double()
    mean, scale = phi.mean(0), phi.std(0).clamp(min=1e-6)
    centre, level = torch.zeros(2, CLOSER_FEATURES, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    weights, biases = _RIDGE, 0.0
    if prior is not None:
        prior_weight = prior.linear.weight.detach().double()
        centre, level = prior_weight * scale, prior.linear.bias.detach().double() + prior_weight @ mean
        weights = biases = _STRENGTH / len(phi)
    weight, bias = centre.clone().requires_grad_(True), level.clone().requires_grad_(True)
    optimiser = torch.optim.LBFGS([weight, bias], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        odds = (phi - mean) / scale @ weight.mT + bias
        value = F.binary_cross_entropy_with_logits(odds, goal, reduction="none").mean(0).sum()
        value = value + weights * (weight - centre).square().sum() + biases * (bias - level).square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    model = Verification()
    with torch.no_grad():
        model.linear.weight.copy_(weight / scale)
        model.linear.bias.copy_(bias - (weight / scale) @ mean)
    return model.eval().requires_grad_(False)


def mean_of(models: Sequence[Verification]) -> Verification:
    """Return the model whose parameters are the means of those of some models, without thresholds."""
    model = Verification()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(torch.stack([each.get_parameter(name) for each in models]).mean(0))
    return model.eval().requires_grad_(False)


def verification_report(
    model: Verification,
    folds: Sequence[Verification],
    closer: _CloserLooks,
    searches: Sequence[_VerifiedSearch],
    pictures: str,
    how: str = "Each photograph is evaluated with a model fitted to other folds.",
) -> tuple[str, dict[str, float | None]]:
    """Evaluate the models in folds."""
    odds = torch.stack([fold(closer.features) for fold in folds])
    odds = odds[closer.fold, torch.arange(len(closer.fold))]
    figures: dict[str, float | None] = {}
    chances = [["", "NLL", "ECE", "area under ROC"]]
    for where, name, logit, there in (
        ("at the place, before", "cell", closer.features[:, 1], closer.right),
        ("at the place, after", "place", odds[:, 0], closer.right),
        ("in the image, before", "image", closer.features[:, 0], closer.present),
        ("in the image, after", "presence", odds[:, 1], closer.present),
    ):
        nll = float(F.binary_cross_entropy_with_logits(logit, there.to(logit)))
        own = {"nll": nll, "ece": float(calibration_error(logit.sigmoid(), there)), "area": _area(logit, there)}
        figures |= {f"{name}_{what}": value for what, value in own.items()}
        chances.append([where, *("-" if value is None else f"{value:.3f}" for value in own.values())])
    there = torch.tensor([each.present for each in searches])
    figures["area"] = area = _area(torch.tensor([each.presence for each in searches]), there)
    assert model.thresholds is not None
    chosen = model.thresholds.confirm
    head = ["confirm", "hit rate", "false-alarm rate", "place right", "looks, target present", "looks, target absent"]
    decisions = [head, ["no closer looks", *_row(there.tolist(), [each.unverified for each in searches])]]
    for confirm in sorted({*_THRESHOLDS, chosen}):
        mark = " (chosen)" if confirm == chosen else ""
        ended = [each.found(confirm) for each in searches]
        decisions.append([f"{confirm:.2f}{mark}", *_row(there.tolist(), ended)])
    return "\n".join(
        [
            f"{len(searches)} searches of {pictures}, {int(there.sum())} of them for a present class; "
            f"{len(closer.fold)} closer looks. {how}",
            "",
            "Probability of the target before and after a closer look:",
            "",
            *table(chances),
            "",
            "Decisions in %, and mean numbers of looks, closer ones included. Without closer looks, the thresholds of "
            "the evidence decide. Area under the ROC of the final probability: "
            f"{'-' if area is None else f'{area:.3f}'}.",
            "",
            *table(decisions),
            "",
        ]
    ), figures


def _area(score: Tensor, there: Tensor) -> float | None:
    return area_under_roc(score, there) if there.any() and not there.all() else None


def _row(present: Sequence[bool], ended: Sequence[_SearchEnd]) -> list[str]:
    """Hits, false alarms, right places and looks of decisions."""
    shares, places, looks = [], [], []
    for kind in (True, False):
        of_kind = [each for each, there in zip(ended, present, strict=True) if there == kind]
        found = [right for right, _ in of_kind if right is not None]
        shares.append(share(len(found), len(of_kind)))
        looks.append(mean_or_dash([end for _, end in of_kind]))
        places += found
    return [*shares, share(sum(places), len(places)), *looks]


class VerificationFit(PartFit):
    """Fit the verification to held-out photographs: the target evidence is surer on those it learned from."""

    settings: VerificationConfig

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = inputs.settings(VerificationConfig, absent=inputs.absent)
        judged = len(inputs.judged)
        self.tasks = {"looking": judged, "verifying": 0.5 * judged}

    def fit(self) -> PartResult:
        """Fit in folds, and compare decisions with those of the same agent without closer looks."""
        config, run, judged = self.settings, self.run, self.inputs.judged
        evidence = self.inputs.model("evidence")
        if not isinstance(evidence, TargetEvidence):
            why = "not fitted, since the agent does not use the target evidence"
            return PartResult(Part(None, None, False, why), f"{why.capitalize()}.")
        photographs = open_photographs(
            run.eye, run.scenes, judged, config, spare=min(20, _ABSENT // len(judged)), store=run.store
        )
        if len(photographs) < 2:
            raise DataError(
                "data: expected at least 2 held-out photographs with a class to search for, got "
                f"{len(photographs)}; give more photographs"
            )
        assert evidence.thresholds is not None
        # Evidence from few photographs is less sure of its cells, and then a search must not give up as soon.
        give_up = min(config.give_up, evidence.thresholds.give_up)
        config = replace(config, folds=min(config.folds, len(photographs)), give_up=give_up)
        prior = mean_of([Verification.from_pretrained(name) for name in _SHIPPED])
        model, folds, closer, searches = fit_in_folds(photographs, evidence, config, prior, SUREST_OF_FEW)
        assert model.thresholds is not None
        confirm = model.thresholds.confirm
        after = _scores(searches, [each.found(confirm) for each in searches])
        before = _scores(searches, [each.unverified for each in searches])
        gain = Difference.of(after, before)
        why = (
            f"decisions score {100 * after.mean():.1f} points, {100 * before.mean():.1f} without closer looks; "
            f"{gain.in_words('points gained', 100)}"
        )
        model.metadata = {**run.eye.settings(), **training_of(config, run.scenes)}
        text = (
            "Fitted to the held-out photographs only, close to the mean of the models shipped for other detectors. A "
            "decision scores 100 points if it finds the target at a right place, -100 points if it finds it at a wrong "
            "place or in a photograph without the target, and 0 points if it finds nothing. Searches for present and "
            "for absent classes have equal weight. The threshold was chosen on the same photographs.\n\n"
        )
        return PartResult(
            self.write("verification", model, gain.better, why),
            text + verification_report(model, folds, closer, searches, f"{len(photographs)} photographs")[0],
        )


def _scores(searches: Sequence[_VerifiedSearch], ends: Sequence[_SearchEnd]) -> FloatArray:
    """Mean score of the decisions in each photograph, `(P,)`; present and absent classes have equal weight."""
    by_picture: dict[int, dict[bool, list[int]]] = {}
    for each, (right, _) in zip(searches, ends, strict=True):
        score = 0 if right is None else 1 if right else -1
        by_picture.setdefault(each.picture, {}).setdefault(each.present, []).append(score)
    return np.array([np.mean([np.mean(kind) for kind in kinds.values()]) for kinds in by_picture.values()])

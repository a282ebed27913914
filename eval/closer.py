"""Closer looks judged in other ways: `python -m eval.closer` compares the verification with the chain and plain rules.

    python -m eval.closer --data.root DIR --data.annotations instances.json --data.min_instances 8 --out runs/closer

Searches and places are those of `python -m train.fit_verification`, which shares its looks under the same `--cache`.
Every rule is a logistic regression, fitted to the other folds of the photographs:

- the verification, of seven features;
- the chain in the cells of the place, the closer look as one more look from nearby: the weight of a detection is in the
  cell of its box's centre;
- the chain at the place, the weight of a detection is its overlap with the examined box;
- the score of the target there, times the overlap;
- for the picture, the belief with the highest score of the closer look, too, as `semfov.observation.Presence` has it;
- for the picture, the highest score of one unfoveated pass.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from eval.bootstrap import Bootstrap
from semfov.belief.association import one_of
from semfov.belief.grid import Grid
from semfov.belief.observers.base import own
from semfov.belief.observers.semantic_search import SearchBelief
from semfov.belief.prior import with_prior
from semfov.decision import cell_of
from semfov.detection.detections import Detections
from semfov.errors import DataError
from semfov.fit.logistic import logistic_regression
from semfov.fit.searches import SearchedPhotograph, open_photographs, photograph_searches
from semfov.fit.verification import CloserLookSamples, examined_places, fit_to_closer_looks
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import area_under_roc
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.matching import box_iou
from semfov.observation.presence import log_evidence, log_odds_of_cells
from semfov.runs.command import command
from semfov.runs.looking import Looking
from semfov.runs.setup import make_searching
from semfov.runs.tables import table
from train.fit_verification import FitVerificationConfig
from train.outputs import write_outputs

_RIDGE = 1e-3
_SCORE_THERE = 3  # the feature of the verification that is the logit of score times overlap
_LEAST = 1e-6  # likelihood of background, by which the others are divided
_COVERED = 0.5  # weight from which on a box covers a cell
_VERIFICATION = "verification, 7 features"


@dataclass(frozen=True)
class CloserConfig(FitVerificationConfig):
    """Judge closer looks in several ways.

    Args:
        out: folder for the table.
    """

    unused = ("workers", "scheduler", "name", "place", "stop_below", "false_alarms")
    out: Path = Path("runs/closer")


class JudgedLook(NamedTuple):
    """A closer look, and what the rules read of it.

    Attributes:
        photograph: number of the photograph.
        known: log odds that a search for the class has its target in the photograph, before any look.
        right: whether the target is at the place.
        present: whether the photograph holds the target.
        features: `(7,)`, of the verification.
        cells: log odds of the target by the chain in the cells of the place.
        place: log odds by the chain at the place.
        belief: `(2,)`, what `Presence` reads of the belief before the look.
        closer: `log_evidence` of the target's highest score in the look.
        whole: `log_evidence` of its highest score in one unfoveated pass.
    """

    photograph: int
    known: float
    right: bool
    present: bool
    features: Tensor
    cells: float
    place: float
    belief: Tensor
    closer: float
    whole: float


def chain_in_cells(
    model: FovealObservationModel, detections: Detections, grid: Grid, target: int, box: Tensor
) -> float:
    """Compute the largest log odds of a target in the cells of a box, if a closer look is a look from nearby.

    Args:
        model: the observation model.
        detections: those of the closer look, a batch of one.
        grid: the cells.
        target: class 1..K.
        box: `(4,)`, box of the target in the look.

    Returns:
        The log odds.
    """
    weight = grid.footprint(detections.boxes, "box_centre")[0] * detections.mask[0, :, None]  # (L, X·Y)
    of_place = grid.footprint(box[None], "soft")[0] >= _COVERED
    # A small box may cover no cell by that much.
    of_place[cell_of(box, grid)] = True
    return float(_log_odds(model, detections, target, weight.to(box))[of_place].max())


def chain_at_place(model: FovealObservationModel, detections: Detections, target: int, box: Tensor) -> float:
    """Compute the log odds of a target at a box `(4,)`, to which the overlap of detections is their weight.

    Args:
        model: the observation model.
        detections: those of the closer look, a batch of one.
        target: class 1..K.
        box: the place.

    Returns:
        The log odds.
    """
    overlap = box_iou(detections.boxes[0], box[None]) * detections.mask[0, :, None]  # (L, 1)
    return float(_log_odds(model, detections, target, overlap)[0])


def _log_odds(model: FovealObservationModel, detections: Detections, target: int, weight: Tensor) -> Tensor:
    """Compute the log odds of a target at N places, by the weights `(L, N)` of detections that are seen from nearby."""
    near = torch.zeros(detections.mask.shape[1])
    likelihood = model.calibrate(detections.scores[0], near)  # (L, K+1)
    ratio = likelihood / likelihood[:, :1].clamp(min=_LEAST)
    shown = one_of(ratio[None], weight[None], model.miss_odds(near.new_zeros(1, weight.shape[1])))[0]  # (N, K+1)
    return log_odds_of_cells(shown[:, target].double() / shown.sum(-1).double())


def judged_looks(run: Looking, model: FovealObservationModel, config: CloserConfig) -> list[JudgedLook]:
    """Search the photographs, look closely at the most evident places, and read what the rules need.

    Args:
        run: the photographs and their stored looks.
        model: the observation model of the searches.
        config: how classes are drawn, and the number of looks.

    Returns:
        The closer looks.
    """
    looks: list[JudgedLook] = []
    for photograph in open_photographs(run, range(len(run.scenes)), config):
        looks += _of_photograph(run, model, config, photograph)
    return looks


@torch.inference_mode()
def _of_photograph(
    run: Looking, model: FovealObservationModel, config: CloserConfig, photograph: SearchedPhotograph
) -> list[JudgedLook]:
    """Judge the closer looks of all searches of a photograph."""
    whole = run.eye.detector(run.scenes[photograph.index].image[None])
    looks = []
    for search in photograph_searches([photograph], model, config.looks, "looking"):
        prior = search.candidates().prior
        for look in examined_places(search):
            belief = own(search.steps[look.looks - 1].belief, SearchBelief, "belief")
            judged = JudgedLook(
                photograph=search.picture,
                known=with_prior(0.0, prior.share, prior.fitted),
                right=search.right(look.box),
                present=search.present,
                features=look.features,
                cells=chain_in_cells(model, look.detections, photograph.grid, search.target, look.box),
                place=chain_at_place(model, look.detections, search.target, look.candidate.box),
                belief=belief.facts(search.target)[0],
                closer=float(log_evidence(look.detections.highest[0, search.target])),
                whole=float(log_evidence(whole.highest[0, search.target])),
            )
            looks.append(judged)
    return looks


def compare(looks: Sequence[JudgedLook], folds: int) -> str:
    """Write the table of all rules.

    Args:
        looks: closer looks.
        folds: number of parts of the photographs; rules are fitted to the others.

    Returns:
        The table in Markdown.

    Raises:
        DataError: there are no closer looks of both kinds.
    """
    samples = _samples(looks, folds)
    verified_place, verified_picture = _by_verification(samples, folds).unbind(1)
    facts = torch.tensor([[look.cells, look.place, look.closer, look.whole] for look in looks])
    cells, place, closer, whole = facts.double().mT[..., None]  # (N, 1) each
    belief = torch.stack([look.belief for look in looks]).double()
    highest = torch.maximum(belief[:, 1:], closer)
    of_place = partial(_by_facts, samples, samples.right, folds)
    of_picture = partial(_by_facts, samples, samples.present, folds)
    place_rules = {
        "before the look": samples.features[:, 1],
        _VERIFICATION: verified_place,
        "chain in the cells, 2 numbers": of_place(cells),
        "chain at the place, 2 numbers": of_place(place),
        "score times overlap, 2 numbers": of_place(samples.features[:, _SCORE_THERE, None].double()),
    }
    picture_rules = {
        "before the look": samples.features[:, 0],
        _VERIFICATION: verified_picture,
        "belief with the highest score, 3 numbers": of_picture(torch.cat([belief[:, :1], highest], 1)),
        "one unfoveated pass, 2 numbers": of_picture(whole),
    }
    photographs = [look.photograph for look in looks]
    rows = [["", "area under ROC", "NLL", "ECE", "NLL - verification"]]
    for what, rules, answers in (("place", place_rules, samples.right), ("picture", picture_rules, samples.present)):
        losses = {rule: _loss(log_odds + samples.known, answers) for rule, log_odds in rules.items()}
        for rule, log_odds in rules.items():
            difference = losses[rule] - losses[_VERIFICATION]
            measures = _measures(log_odds + samples.known, answers)
            rows.append([f"{what}: {rule}", *measures, _mean(difference, photographs)])
    head = f"{len(looks)} closer looks in {len(set(photographs))} photographs; the rules are fitted to other folds."
    return "\n".join([head, "", *table(rows), ""])


def _samples(looks: Sequence[JudgedLook], folds: int) -> CloserLookSamples:
    """Put closer looks together as the fit of the verification reads them."""
    right = torch.tensor([look.right for look in looks])
    present = torch.tensor([look.present for look in looks])
    if right.all() or not right.any() or present.all() or not present.any():
        raise DataError("data: expected closer looks at places that hold the target and at others, got only one kind")
    fold = torch.tensor([look.photograph % folds for look in looks])
    known = torch.tensor([look.known for look in looks])
    return CloserLookSamples(torch.stack([look.features for look in looks]), right, present, fold, known)


@torch.no_grad()
def _by_verification(samples: CloserLookSamples, folds: int) -> Tensor:
    """Compute the log odds by verifications that are fitted to the other folds, `(N, 2)`."""
    log_odds = torch.zeros(len(samples.fold), 2, dtype=torch.float64)
    for fold in range(folds):
        held_out = samples.fold == fold
        log_odds[held_out] = fit_to_closer_looks(samples, ~held_out)(samples.features[held_out]).double()
    return log_odds


def _by_facts(samples: CloserLookSamples, answers: Tensor, folds: int, facts: Tensor) -> Tensor:
    """Compute the log odds by logistic regressions of facts `(N, m)` that are fitted to the other folds, `(N,)`."""
    log_odds = torch.zeros(len(facts), dtype=torch.float64)
    for fold in range(folds):
        held_out = samples.fold == fold
        known = samples.known[~held_out].double()
        offset, *weights = logistic_regression(facts[~held_out], answers[~held_out], known=known, ridge=_RIDGE)
        log_odds[held_out] = offset + facts[held_out] @ torch.tensor(weights, dtype=torch.float64)
    return log_odds


def _loss(log_odds: Tensor, answers: Tensor) -> Tensor:
    """Compute the negative log likelihood of each answer, `(N,)`."""
    return F.binary_cross_entropy_with_logits(log_odds.double(), answers.double(), reduction="none")


def _measures(log_odds: Tensor, answers: Tensor) -> list[str]:
    """Measure log odds `(N,)`: area under the ROC, mean loss, and calibration error."""
    measures = (
        area_under_roc(log_odds, answers),
        float(_loss(log_odds, answers).mean()),
        float(calibration_error(log_odds.double().sigmoid(), answers)),
    )
    return [f"{measure:.3f}" for measure in measures]


def _mean(values: Tensor, photographs: Sequence[int]) -> str:
    """Write the mean of values `(N,)`, with its standard error over photographs."""
    sampled = Bootstrap.of(lambda cases: values[cases].mean()[None], photographs)
    return f"{float(sampled.value[0]):+.3f} ± {float(sampled.error[0]):.3f}"


def judge(config: CloserConfig) -> None:
    """Search the photographs, judge closer looks by all rules, and write the table."""
    run = Looking(config)
    model = make_searching(config.search_model, run.eye)
    write_outputs(config, compare(judged_looks(run, model, config), config.folds), {})


main = command(judge, CloserConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())

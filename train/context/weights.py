"""Fit the two weights with which context is added to a belief, on series of looks at photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from semfov.belief import ContextPrior, TargetEvidence
from semfov.belief.context import presence_of
from semfov.belief.observers import Observer, Semantic, Target
from semfov.belief.observers.context import log_odds
from semfov.gaze.selection import best_cells
from semfov.runs.samples import Sampler, Samples
from semfov.runs.seeds import generator_for
from train.context.settings import FitContextConfig, ObjectPlaces


@dataclass(frozen=True)
class Cases:
    """Beliefs after some looks, one for each photograph and class.

    Attributes:
        log_odds: `(E, X·Y)`, log-odds of the target in each cell without context.
        place: `(E, X·Y)`, contribution of the usual places of the class, at weight 1.
        co_occurrence: `(E, X·Y)`, contribution of co-occurring classes, at weight 1.
        goal: `(E, X·Y)` boolean, cells with the target.
        visited: `(E, X·Y)` boolean, cells that were fixated.
    """

    log_odds: Tensor
    place: Tensor
    co_occurrence: Tensor
    goal: Tensor
    visited: Tensor


def make_cases(
    kind: str,
    sampler: Sampler,
    samples: Samples,
    folds: Sequence[tuple[ContextPrior, Sequence[int]]],
    places: Sequence[ObjectPlaces],
    config: FitContextConfig,
) -> Cases:
    """Compute beliefs after a random number of looks at random cells without the target.

    Args:
        kind: kind of belief, `evidence` or `map`.
        sampler: the sampler that looked at the photographs.
        samples: the labelled detections of its looks.
        folds: priors, each with the indices of the photographs to use it on.
        places: the objects of all photographs.
        config: settings of the fit.

    Returns:
        The beliefs with the contributions of context.
    """
    observer: Observer = Semantic(len(sampler.scenes.classes) + 1, tempering=0.25, footprint="box_centre")
    if kind == "evidence":
        observer = Target(TargetEvidence.from_pretrained(sampler.eye.detector.name).requires_grad_(False))
    work = [(prior, index) for prior, part in folds for index in part]
    rows = []
    for prior, index in tqdm(work, desc=f"context with {kind}", unit="scene", dynamic_ncols=True):
        place = places[index]
        looks = slice(index * config.fixations, (index + 1) * config.fixations)
        detections, fixations = samples.detections_of(looks), samples.fixations[looks]
        presence, cells = presence_of(detections, place.grid), place.grid.cell_of(fixations)
        for target in place.targets:
            goal = place.occupied[:, target]
            free = (~goal[cells]).nonzero()[:, 0]
            if not len(free):
                continue
            generator = generator_for("looks", config.seed, sampler.scenes.ids[index], target)
            number = int(torch.randint(1, len(free) + 1, (1,), generator=generator))
            used = free[torch.randperm(len(free), generator=generator)[:number]]
            belief = observer.start(1, place.grid, presence)
            evidence = observer.weigh(detections, fixations, place.grid, target)
            for look in used.split(1):
                belief = observer.update(belief, evidence[look])
            present = belief.chance(target)[0]
            scores = presence[used].amax(0, keepdim=True)
            alone = [prior(scores, place.grid, target, weights)[0] for weights in ((1.0, 0.0), (0.0, 1.0))]
            visited = torch.zeros(len(place.grid), dtype=torch.bool).scatter(0, cells[used], True)
            rows.append((log_odds(present), *alone, goal, visited))
    return Cases(*(torch.stack(column) for column in zip(*rows, strict=True)))


SIZES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0)
"""Factors of the maximum-likelihood weights that are tried. The smallest do little more than break ties."""


def fit_weights(cases: Cases) -> tuple[float, float]:
    """Fit the weights of place and co-occurrence.

    Maximum likelihood gives the ratio of the two weights. Their common size is chosen from `SIZES` such that the next
    fixation lands on the target most often. For a belief that is not calibrated, such as a fused map, maximum
    likelihood gives weights so large that the most probable cell contains the target less often.

    Args:
        cases: beliefs to fit on.

    Returns:
        The weights of place and of co-occurrence.
    """
    place, co_occurrence = likeliest_weights(cases)
    size = max(SIZES, key=lambda size: landed(cases, size * place, size * co_occurrence))
    return size * place, size * co_occurrence


def likeliest_weights(cases: Cases) -> tuple[float, float]:
    r"""Fit weights by maximum likelihood of landing on the target with a next fixation drawn from a softmax.

    .. math:: \max_{\gamma, w} \sum \ln \sum_{x \in \text{goal}}
              \mathrm{softmax}\bigl(\gamma (\ell + w_1 a + w_2 r)\bigr)(x)

    with the log-odds ℓ of the belief, the contribution a of place and r of co-occurrence. The factor γ compensates for
    beliefs that are not calibrated; it does not change which cell is the most probable.

    Args:
        cases: beliefs to fit on.

    Returns:
        The weights of place and of co-occurrence, relative to the log-odds of the belief, which have weight 1.
    """
    parameters = torch.tensor([1.0, 0.0, 0.0], requires_grad=True)
    optimiser = torch.optim.LBFGS([parameters], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = -hit(cases, *parameters)
        value.backward()
        return value

    optimiser.step(loss)
    gamma, place, co_occurrence = parameters.tolist()
    return place / gamma, co_occurrence / gamma


def landed(cases: Cases, place: float, co_occurrence: float) -> float:
    """Return how often the most probable unvisited cell contains the target.

    Ties are broken at random, as in `select_fixation`: each of the tied cells counts with the same share.

    Args:
        cases: the beliefs.
        place: weight of place.
        co_occurrence: weight of co-occurrence.

    Returns:
        The share of cases, from 0 to 1.
    """
    tied = best_cells(cases.log_odds + place * cases.place + co_occurrence * cases.co_occurrence, cases.visited)
    return float(((tied & cases.goal).sum(-1) / tied.sum(-1)).mean())


def hit(cases: Cases, gamma: Tensor, place: Tensor, co_occurrence: Tensor) -> Tensor:
    """Compute the mean log probability of landing on the target (the objective of `likeliest_weights`)."""
    value = gamma * cases.log_odds + place * cases.place + co_occurrence * cases.co_occurrence
    value = value.masked_fill(cases.visited, -torch.inf)
    return (value.masked_fill(~cases.goal, -torch.inf).logsumexp(-1) - value.logsumexp(-1)).mean()

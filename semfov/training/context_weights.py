"""How much context should count beside a belief: two weights, fitted on series of looks at photographs."""

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
from semfov.experiments.samples import Sampler, Samples
from semfov.experiments.seeds import generator_for
from semfov.gaze.selection import best_cells
from semfov.training.places import FitContextConfig, Places


@dataclass(frozen=True)
class Cases:
    """Beliefs after some looks, one for each photograph and class.

    Attributes:
        log_odds: `(E, X·Y)`, of the target without context.
        place: `(E, X·Y)`, what place would add.
        company: `(E, X·Y)`, what co-occurrence would add.
        goal: `(E, X·Y)` boolean, cells with the target.
        visited: `(E, X·Y)` boolean.
    """

    log_odds: Tensor
    place: Tensor
    company: Tensor
    goal: Tensor
    visited: Tensor


def make_cases(
    kind: str,
    sampler: Sampler,
    samples: Samples,
    folds: Sequence[tuple[ContextPrior, Sequence[int]]],
    places: Sequence[Places],
    config: FitContextConfig,
) -> Cases:
    """Beliefs of one kind, `evidence` or `map`, after a random number of random looks off the target.

    Args:
        kind: of the belief.
        sampler: what looked.
        samples: what it saw.
        folds: priors, each with the photographs to use it on.
        places: where the objects are.
        config: of the fit.
    """
    observer: Observer = Semantic(len(sampler.scenes.classes) + 1, tempering=0.25, footprint="box_centre")
    if kind == "evidence":
        observer = Target(TargetEvidence.from_pretrained(sampler.eye.detector.name).requires_grad_(False))
    work = [(prior, index) for prior, part in folds for index in part]
    parts = []
    for prior, index in tqdm(work, desc=f"context beside {kind}", unit="scene", dynamic_ncols=True):
        place = places[index]
        looks = slice(index * config.fixations, (index + 1) * config.fixations)
        seen, fixations = samples.seen(looks), samples.fixations[looks]
        presence, cells = presence_of(seen, place.grid), place.grid.cell_of(fixations)
        for target in place.targets:
            goal = place.occupied[:, target]
            free = (~goal[cells]).nonzero()[:, 0]
            if not len(free):
                continue
            generator = generator_for("looks", config.seed, sampler.scenes.ids[index], target)
            number = int(torch.randint(1, len(free) + 1, (1,), generator=generator))
            used = free[torch.randperm(len(free), generator=generator)[:number]]
            belief = observer.start(1, place.grid, presence)
            said = observer.weigh(seen, fixations, place.grid, target)
            for look in used.split(1):
                belief = observer.update(belief, said[look])
            present = belief.chance(target)[0]
            shown = presence[used].amax(0, keepdim=True)
            alone = [prior(shown, place.grid, target, weights)[0] for weights in ((1.0, 0.0), (0.0, 1.0))]
            visited = torch.zeros(len(place.grid), dtype=torch.bool).scatter(0, cells[used], True)
            parts.append((log_odds(present), *alone, goal, visited))
    return Cases(*(torch.stack(column) for column in zip(*parts, strict=True)))


SIZES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0)
"""Shares of the likeliest weights that are tried; the smallest do little but break ties."""


def fit_weights(cases: Cases) -> tuple[float, float]:
    """Weights of place and co-occurrence: as the likelihood has them to each other, as large as serves the gaze.

    A belief that is not calibrated, such as a fused map, asks for large weights to be likely, under which the most
    probable cell holds the target less often; of `SIZES` the one is taken that lands on the target most often.
    """
    place, company = likeliest_weights(cases)
    size = max(SIZES, key=lambda size: landed(cases, size * place, size * company))
    return size * place, size * company


def likeliest_weights(cases: Cases) -> tuple[float, float]:
    r"""Weights of place and co-occurrence that make a soft next fixation land on the target most likely.

    .. math:: \max_{\gamma, w} \sum \ln \sum_{x \in \text{goal}}
              \mathrm{softmax}\bigl(\gamma (\ell + w_1 a + w_2 r)\bigr)(x)

    γ makes up for beliefs that are not calibrated; the next fixation does not depend on it.
    """
    parameters = torch.tensor([1.0, 0.0, 0.0], requires_grad=True)
    optimiser = torch.optim.LBFGS([parameters], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = -hit(cases, *parameters)
        value.backward()
        return value

    optimiser.step(loss)
    gamma, place, company = parameters.tolist()
    return place / gamma, company / gamma


def landed(cases: Cases, place: float, company: float) -> float:
    """How often the most probable cell not visited holds the target, ties broken at random (`select_fixation`)."""
    tied = best_cells(cases.log_odds + place * cases.place + company * cases.company, cases.visited)
    return float(((tied & cases.goal).sum(-1) / tied.sum(-1)).mean())


def hit(cases: Cases, gamma: Tensor, place: Tensor, company: Tensor) -> Tensor:
    """Mean log probability of landing on the target."""
    value = gamma * cases.log_odds + place * cases.place + company * cases.company
    value = value.masked_fill(cases.visited, -torch.inf)
    return (value.masked_fill(~cases.goal, -torch.inf).logsumexp(-1) - value.logsumexp(-1)).mean()

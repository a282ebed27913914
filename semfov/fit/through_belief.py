"""Fit an observation model through the belief, so that searches with it land on their targets sooner."""

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic
from semfov.data.scene import Scenes, legal_targets
from semfov.detection.detections import Detections
from semfov.errors import DataError, check
from semfov.fit.training import descend
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.samples import Samples

_EXPONENT, _MISS, _REFUTATION = 0.75, 1e-4, 0.9
"""Values from which the exponents, the odds of a miss and the refutation are learned."""


@dataclass(frozen=True)
class SearchedLooks:
    """Looks at a photograph, and the classes that may be searched for in it.

    Attributes:
        detections: of R looks.
        fixations: `(R, 2)`, in pixels.
        grid: the cells.
        targets: `(T,)`, classes 1..K.
        goal: `(T, X·Y)` boolean, the cells that objects of each class overlap.
    """

    detections: Detections
    fixations: Tensor
    grid: Grid
    targets: Tensor
    goal: Tensor


def searched_looks(
    scenes: Scenes, samples: Samples, cells: tuple[int, int], max_target_area: float
) -> dict[int, SearchedLooks]:
    """Find the searches that stored looks allow, by the number of the photograph; some photographs have none."""
    found = {}
    for index in samples.scenes.unique().tolist():
        annotation = scenes.annotation(index)
        grid = Grid(*cells, annotation.size)
        covered = grid.footprint(annotation.boxes)
        goals = {
            target: covered[annotation.labels == target].any(0) for target in legal_targets(annotation, max_target_area)
        }
        goals = {target: goal for target, goal in goals.items() if goal.any() and not goal.all()}
        if goals:
            looks, fixations = samples.looks_at(index)
            goal = torch.stack([*goals.values()])
            found[index] = SearchedLooks(looks, fixations, grid, torch.tensor([*goals]), goal)
    return found


def landing_loss(observer: Semantic, searched: SearchedLooks, order: Tensor) -> Tensor | None:
    r"""Loss of searches that fixate in a given order, the mean over looks and over targets that were not found yet.

    .. math:: -\ln \frac{\sum_{x \in \text{goal}} P(t \in x)}{\sum_x P(t \in x)}, \quad x \text{ not fixated yet}

    It is −ln of the probability that a fixation drawn by the belief lands on the target.

    Args:
        observer: weighs the looks and updates the belief; the loss is differentiable in its parameters.
        searched: looks at a photograph.
        order: `(n,)`, numbers of the looks to make.

    Returns:
        A scalar; None if the first look fixates all targets.
    """
    fixations = searched.fixations[order]
    looks = observer.weigh(searched.detections[order], fixations, searched.grid)
    belief = observer.start(1, searched.grid, looks.likelihood)
    visited = torch.zeros(len(searched.grid), dtype=torch.bool)
    losses = []
    for number, cell in enumerate(searched.grid.cell_of(fixations).tolist()):
        belief = observer.update(belief, looks[number : number + 1])
        visited = visited.index_fill(0, torch.tensor(cell), True)
        going = ~(searched.goal & visited).any(-1)
        if not going.any():
            break
        probability = belief.class_probabilities()[0].T[searched.targets[going]].masked_fill(visited, 0)
        landing = (probability * searched.goal[going]).sum(-1) / probability.sum(-1)
        losses.append(-landing.log().mean())
    return torch.stack(losses).mean() if losses else None


@torch.no_grad()
def mean_landing_loss(model: FovealObservationModel, searches: Sequence[SearchedLooks], looks: int = 8) -> float:
    """Average the loss of searches over photographs, with their first looks in the order in which they are stored."""
    observer = Semantic.searching(model)
    losses = [landing_loss(observer, each, torch.arange(min(looks, len(each.fixations)))) for each in searches]
    return float(torch.stack([loss for loss in losses if loss is not None]).mean())


@torch.no_grad()
def starting_model(model: FovealObservationModel) -> FovealObservationModel:
    """Copy a model for `fit_through_belief`, with exponents, odds of a miss and refutation to start from."""
    start = deepcopy(model)
    start.log_exponents.fill_(math.log(_EXPONENT))
    odds = torch.full_like(start.log_prior, math.log(_MISS))
    odds[0] = 0.0
    start.log_miss = nn.Parameter(odds)
    start.refutation.fill_(_REFUTATION)
    return start


def fit_through_belief(
    model: FovealObservationModel,
    searches: Sequence[SearchedLooks],
    *,
    looks: int = 8,
    steps: int = 200,
    batch: int = 6,
    rate: float = 0.1,
    seed: int = 0,
    **metadata: Any,
) -> FovealObservationModel:
    """Train a model by the loss of searches (`landing_loss`), through the belief that runs in a search.

    Exponents, the prior of objects against background and the odds of a miss are learned for each level, the same for
    all classes, and one refutation for all levels: 3 N + 1 numbers. α stays as it was fitted.

    Args:
        model: the model to start from, as `fit` or `fit_discriminative` leaves it.
        searches: looks at photographs.
        looks: most looks in a search.
        steps: number of steps of the optimiser.
        batch: photographs in a step.
        rate: highest learning rate.
        seed: seed of the photographs and of the order of their looks.
        metadata: JSON values to save with the model.

    Returns:
        A new model, in `eval` mode.

    Raises:
        DataError: no photograph has a class that may be searched for.
        InputError: a number is not positive.
    """
    check(min(looks, steps, batch) > 0 and rate > 0, "looks, steps, batch, rate", "positive numbers", (looks, steps))
    if not searches:
        raise DataError("data: expected a photograph with a class to search for, got none; raise max_target_area")
    trained = starting_model(model).eval()
    trained.log_alpha.requires_grad_(False)
    assert trained.log_miss is not None
    for table in (trained.log_prior, trained.log_miss):
        table.register_hook(_same_for_all_classes)
    observer = Semantic.searching(trained)
    generator = torch.Generator().manual_seed(seed)

    def loss_of(_: int) -> Tensor | None:
        losses = []
        for chosen in torch.randint(len(searches), (batch,), generator=generator).tolist():
            order = torch.randperm(len(searches[chosen].fixations), generator=generator)[:looks]
            loss = landing_loss(observer, searches[chosen], order)
            losses += [] if loss is None else [loss]
        return torch.stack(losses).mean() if losses else None

    parameters = [trained.log_exponents, trained.log_prior, trained.log_miss, trained.refutation]
    descend(parameters, loss_of, steps, rate, decay=0.0, clip=None, title="fitting through the belief")
    with torch.no_grad():
        trained.refutation.clamp_(0, 1)
    trained.metadata |= {"method": "search", **metadata}
    return trained.requires_grad_(True)


def _same_for_all_classes(gradient: Tensor) -> Tensor:
    """Gradient `(K+1, N)` of a table whose classes move together; background stays."""
    same = gradient[1:].sum(0).expand_as(gradient)
    return torch.cat([torch.zeros_like(same[:1]), same[1:]])

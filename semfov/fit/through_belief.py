"""Fit an observation model through the belief, so that searches with it land on their targets sooner."""

import math
from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from semfov.belief.observers import SemanticSearch
from semfov.errors import DataError, check
from semfov.fit.samples import AnnotatedLooks
from semfov.fit.training import descend
from semfov.observation.foveal import FovealObservationModel

_EXPONENT = 0.75  # of the likelihood at every level, set by hand
_REFUTATION = 0.9  # set by hand
_MISS = 1e-4  # value from which the odds of a miss are learned
_DEGREE = 2  # of the curve over the levels: few photographs show what each level alone is like


def landing_loss(observer: SemanticSearch, searched: AnnotatedLooks, order: Tensor) -> Tensor | None:
    r"""Compute the loss of searches that fixate in a given order, a mean over looks and targets not found yet.

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
    goal = searched.goal
    looks = observer.weigh(searched.detections[order], fixations, searched.grid)
    belief = observer.start(1, searched.grid, looks.ratio)
    visited = torch.zeros(len(searched.grid), dtype=torch.bool)
    losses = []
    for number, cell in enumerate(searched.grid.cell_of(fixations).tolist()):
        belief = observer.update(belief, looks[number : number + 1])
        visited = visited.index_fill(0, torch.tensor(cell), True)
        going = ~(goal & visited).any(-1)
        if not going.any():
            break
        targets = searched.targets[going]
        # One row of the belief for each target that is not found yet.
        rows = torch.zeros(len(targets), dtype=torch.long)
        probability = belief[rows].chance(targets).masked_fill(visited, 0)
        landing = (probability * goal[going]).sum(-1) / probability.sum(-1)
        losses.append(-landing.log().mean())
    return _mean(losses)


def _mean(losses: Iterable[Tensor | None]) -> Tensor | None:
    """Average the losses that are there; None where none is."""
    numbers = [loss for loss in losses if loss is not None]
    return torch.stack(numbers).mean() if numbers else None


@torch.no_grad()
def mean_landing_loss(model: FovealObservationModel, searches: Sequence[AnnotatedLooks], looks: int = 8) -> float:
    """Average the loss of searches over photographs, with their first looks in the order in which they are stored.

    Args:
        model: an observation model that was fitted through the belief.
        searches: looks at photographs.
        looks: most looks in a search.

    Returns:
        The mean over photographs whose first look leaves a target to find.
    """
    observer = SemanticSearch(model)
    losses = []
    for searched in searches:
        loss = landing_loss(observer, searched, torch.arange(min(looks, len(searched.fixations))))
        if loss is not None:
            losses.append(loss)
    return float(torch.stack(losses).mean())


@torch.no_grad()
def starting_model(model: FovealObservationModel) -> FovealObservationModel:
    """Copy a model for `fit_through_belief`, with its exponents and refutation, and odds of a miss to start from."""
    start = deepcopy(model)
    start.log_exponents.fill_(math.log(_EXPONENT))
    log_miss = torch.full_like(start.log_prior, math.log(_MISS))
    log_miss[0] = 0.0  # background cannot be missed
    start.log_miss = nn.Parameter(log_miss)
    start.refutation.fill_(_REFUTATION)
    start.presence = None  # that of another belief
    return start


def fit_through_belief(
    model: FovealObservationModel,
    searches: Sequence[AnnotatedLooks],
    *,
    looks: int = 8,
    steps: int = 200,
    batch: int = 6,
    rate: float = 0.1,
    seed: int = 0,
    **metadata: Any,
) -> FovealObservationModel:
    """Train a model by the loss of searches (`landing_loss`), through the belief that runs in a search.

    The odds of a miss are learned: their logarithm is a parabola over the levels, the same for all classes, so these
    are 3 numbers. The exponent of the likelihood is 0.75 at all levels, and the refutation 0.9. α and the prior stay as
    they were fitted. (Learning the other numbers, too, lands no sooner: docs/decisions/association.md.)

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
    trained = starting_model(model).eval().requires_grad_(False)
    assert trained.log_miss is not None
    trained.log_miss.requires_grad_(True)
    parametrize.register_parametrization(trained, "log_miss", _Curve(trained.log_miss))
    observer = SemanticSearch(trained)
    generator = torch.Generator().manual_seed(seed)

    def loss_of(_: int) -> Tensor | None:
        losses = []
        for number in torch.randint(len(searches), (batch,), generator=generator).tolist():
            searched = searches[number]
            order = torch.randperm(len(searched.fixations), generator=generator)[:looks]
            losses.append(landing_loss(observer, searched, order))
        return _mean(losses)

    parameters = [parameter for parameter in trained.parameters() if parameter.requires_grad]
    descend(parameters, loss_of, steps, rate, decay=0.0, clip=None, title="fitting through the belief")
    parametrize.remove_parametrizations(trained, "log_miss")
    trained.metadata |= {"method": "search", **metadata}
    return trained.requires_grad_(True)


class _Curve(nn.Module):
    """A table of a model plus a curve over its levels, the same for all classes; background stays.

    Args:
        table: the table to start from, `(K+1, N)`.
    """

    start: Tensor
    powers: Tensor

    def __init__(self, table: Tensor) -> None:
        super().__init__()
        levels = torch.linspace(-1, 1, table.shape[-1]).to(table)
        powers = torch.stack([levels**power for power in range(_DEGREE + 1)])
        self.register_buffer("start", table.detach().clone())
        self.register_buffer("powers", powers)

    def forward(self, coefficients: Tensor) -> Tensor:
        """Compute the table from the coefficients `(D+1,)` of the curve."""
        curve = coefficients @ self.powers
        return torch.cat([self.start[:1], self.start[1:] + curve])

    def right_inverse(self, table: Tensor) -> Tensor:
        """Return the coefficients from which the fit starts: those of no change."""
        return table.new_zeros(len(self.powers))

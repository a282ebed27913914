"""Fit the likelihood of whole cells, so that the map of all classes has calibrated probabilities."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.belief.observers import SemanticMap
from semfov.errors import DataError
from semfov.fit.samples import AnnotatedLooks
from semfov.observation.descent import Lbfgs
from semfov.observation.foveal import FovealObservationModel

MOST_PHOTOGRAPHS = 200
"""Number of photographs that the fit needs at most, for three numbers."""

_COUNTS = 4  # numbers of looks, each twice the one before
_ITERATIONS = 60
_LEAST = 1e-9  # of a probability whose logarithm is taken
_PULL = 1e-4  # weight that keeps the numbers finite where cells hold nothing, or looks tell them all apart


def map_loss(observer: SemanticMap, annotated: AnnotatedLooks, order: Tensor) -> Tensor:
    r"""Compute the loss of a map after looks in a given order, a mean over cells and looks.

    .. math:: -\ln \sum_{k \in x} P(C^x = k)

    The sum is over the classes that the cell holds, or background alone.

    Args:
        observer: weighs the looks and updates the belief; the loss is differentiable in its parameters.
        annotated: looks at a photograph.
        order: `(n,)`, numbers of the looks to make.

    Returns:
        A scalar.
    """
    looks = observer.weigh(annotated.detections[order], annotated.fixations[order], annotated.grid)
    belief = observer.start(1, annotated.grid, looks.ratio)
    losses = []
    for number in range(len(order)):
        belief = observer.update(belief, looks[number : number + 1])
        right = (belief.class_probabilities()[0] * annotated.answers).sum(-1)
        losses.append(-right.clamp(min=_LEAST).log().mean())
    return torch.stack(losses).mean()


@torch.no_grad()
def mean_map_loss(model: FovealObservationModel, photographs: Sequence[AnnotatedLooks]) -> float:
    """Average the loss of the maps of photographs (`map_loss`), with all looks in the order in which they are stored.

    Args:
        model: an observation model.
        photographs: looks at photographs.

    Returns:
        The mean over photographs, in nats.
    """
    observer = SemanticMap(model)
    losses = [map_loss(observer, annotated, torch.arange(len(annotated.fixations))) for annotated in photographs]
    return float(torch.stack(losses).mean())


def fit_cells(model: FovealObservationModel, photographs: Sequence[AnnotatedLooks], *, seed: int = 0) -> None:
    """Fit the three numbers of whole cells (`log_cell`) of an observation model, in place.

    These are three numbers, the odds of a miss, an exponent, and the weight of background. They minimise the negative
    log of what cells hold (`map_loss`), after 1, 2, 4 and 8 looks in a random order. All else stays.

    Args:
        model: the model, as `fit` or `fit_discriminative` leaves it.
        photographs: looks at photographs.
        seed: seed of the order of the looks.

    Raises:
        DataError: there is no photograph with an object.
    """
    if not photographs:
        raise DataError("data: none of the photographs contains an object; give more photographs")
    observer = SemanticMap(model)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        ratio = torch.cat([_closest_looks(observer, annotated, generator) for annotated in photographs]).double()
    answers = torch.cat([annotated.answers.expand(_COUNTS, -1, -1) for annotated in photographs])
    start = model.log_cell.detach().clone()
    optimiser = Lbfgs([model.log_cell], max_iter=_ITERATIONS, line_search_fn="strong_wolfe")

    def loss_of() -> Tensor:
        optimiser.zero_grad()
        log_probability = observer.log_likelihood(ratio).log_softmax(-1)
        log_right = log_probability.masked_fill(~answers, -torch.inf).logsumexp(-1)
        pull = (model.log_cell - start).square().sum()
        loss = _PULL * pull - log_right.mean()
        loss.backward()
        return loss

    optimiser.step(loss_of)
    model.zero_grad()


def _closest_looks(observer: SemanticMap, annotated: AnnotatedLooks, generator: torch.Generator) -> Tensor:
    """Sum what the closest of the first 1, 2, 4 and 8 looks says about each cell, `(4, X·Y, K+1)`."""
    order = torch.randperm(len(annotated.fixations), generator=generator)[: 2 ** (_COUNTS - 1)]
    looks = observer.weigh(annotated.detections[order], annotated.fixations[order], annotated.grid)
    cells = torch.arange(len(annotated.grid))
    ratios = []
    for doubling in range(_COUNTS):
        closest = looks.distance[: 2**doubling].argmin(0)  # (X·Y,), number of the look
        ratios.append(looks.ratio[closest, cells])
    return torch.stack(ratios)

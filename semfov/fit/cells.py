"""Fit what a look says about whole cells, so that the map of all classes is right as often as it says."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import SemanticMap
from semfov.data.scene import Scenes
from semfov.detection.detections import Detections
from semfov.errors import DataError
from semfov.fit.samples import Samples
from semfov.metrics.episodes import answers_of
from semfov.observation.descent import Lbfgs
from semfov.observation.foveal import FovealObservationModel

MOST_PHOTOGRAPHS = 200
"""Number of photographs that the fit needs at most, for three numbers."""

_COUNTS = 4  # numbers of looks, each twice the one before
_ITERATIONS = 60
_LEAST = 1e-9  # of a probability whose logarithm is taken
_PULL = 1e-4  # weight that keeps the numbers finite where cells hold nothing, or looks tell them all apart


@dataclass(frozen=True)
class MappedLooks:
    """Looks at a photograph, and what its cells hold.

    Attributes:
        detections: of R looks.
        fixations: `(R, 2)`, in pixels.
        grid: the cells.
        answers: `(X·Y, K+1)` boolean, whether a cell holds nothing, and each class.
    """

    detections: Detections
    fixations: Tensor
    grid: Grid
    answers: Tensor


def mapped_looks(
    scenes: Scenes, samples: Samples, photographs: Iterable[int], cells: tuple[int, int]
) -> list[MappedLooks]:
    """List stored looks with what the cells of their photographs hold.

    Args:
        scenes: the photographs.
        samples: labelled detections of their looks.
        photographs: numbers of those that count.
        cells: columns and rows of the grid.

    Returns:
        The looks at each of the first `MOST_PHOTOGRAPHS` photographs with objects.
    """
    mapped: list[MappedLooks] = []
    for index in photographs:
        if len(mapped) == MOST_PHOTOGRAPHS:
            break
        annotation = scenes.annotation(index)
        grid = Grid(*cells, annotation.size)
        answers = answers_of(annotation, grid, len(scenes.classes) + 1)
        if answers.any():
            answers[:, 0] = ~answers.any(-1)
            mapped.append(MappedLooks(*samples.looks_at(index), grid, answers))
    return mapped


def map_loss(observer: SemanticMap, mapped: MappedLooks, order: Tensor) -> Tensor:
    r"""Compute the loss of a map after looks in a given order, a mean over cells and looks.

    .. math:: -\ln \sum_{k \in x} P(C^x = k)

    The sum is over the classes that the cell holds, or background alone.

    Args:
        observer: weighs the looks and updates the belief; the loss is differentiable in its parameters.
        mapped: looks at a photograph.
        order: `(n,)`, numbers of the looks to make.

    Returns:
        A scalar.
    """
    looks = observer.weigh(mapped.detections[order], mapped.fixations[order], mapped.grid)
    belief = observer.start(1, mapped.grid, looks.ratio)
    losses = []
    for number in range(len(order)):
        belief = observer.update(belief, looks[number : number + 1])
        right = (belief.class_probabilities()[0] * mapped.answers).sum(-1)
        losses.append(-right.clamp(min=_LEAST).log().mean())
    return torch.stack(losses).mean()


@torch.no_grad()
def mean_map_loss(model: FovealObservationModel, photographs: Sequence[MappedLooks]) -> float:
    """Average the loss of the maps of photographs (`map_loss`), with all looks in the order in which they are stored.

    Args:
        model: an observation model.
        photographs: looks at photographs.

    Returns:
        The mean over photographs, in nats.
    """
    observer = SemanticMap(model)
    losses = [map_loss(observer, mapped, torch.arange(len(mapped.fixations))) for mapped in photographs]
    return float(torch.stack(losses).mean())


def fit_cells(model: FovealObservationModel, photographs: Sequence[MappedLooks], *, seed: int = 0) -> None:
    """Learn what a look says about whole cells (its `log_cell`), in place.

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
        ratio = torch.cat([_closest_looks(observer, mapped, generator) for mapped in photographs]).double()
    answers = torch.cat([mapped.answers.expand(_COUNTS, -1, -1) for mapped in photographs])
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


def _closest_looks(observer: SemanticMap, mapped: MappedLooks, generator: torch.Generator) -> Tensor:
    """Sum what the closest of the first 1, 2, 4 and 8 looks says about each cell, `(4, X·Y, K+1)`."""
    order = torch.randperm(len(mapped.fixations), generator=generator)[: 2 ** (_COUNTS - 1)]
    looks = observer.weigh(mapped.detections[order], mapped.fixations[order], mapped.grid)
    cells = torch.arange(len(mapped.grid))
    ratios = []
    for doubling in range(_COUNTS):
        closest = looks.distance[: 2**doubling].argmin(0)  # (X·Y,), number of the look
        ratios.append(looks.ratio[closest, cells])
    return torch.stack(ratios)

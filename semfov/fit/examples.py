"""Training examples, each with the looks from every cell of a photograph, and episodes over them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import ClassVar, Self

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Observer
from semfov.belief.observers.base import own
from semfov.belief.observers.gathering import EvidenceLook, Gatherer
from semfov.detection.detections import Detections
from semfov.episode import EpisodeLook, Looks, Step, rollout
from semfov.gaze.acquisition import AcquisitionFunction
from semfov.gaze.choice import Greedy


class _Exploratory(Greedy):
    """`Greedy`, with a share `astray` of the fixations drawn at random so that training sees all cells."""

    def __init__(self, noise: Callable[[int, Tensor], Tensor], astray: float) -> None:
        super().__init__(noise)
        self.astray = astray

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the best cell, or with the probability `astray` any cell not visited."""
        is_astray = self.noise(shift, episodes)[:, :1] < self.astray
        # Of cells with equal values one is drawn.
        values = torch.where(is_astray, 0.0, values.detach())
        return super().__call__(shift, episodes, values, visited, centres)


@dataclass(frozen=True)
class Examples:
    """Base of E training examples, a row of each tensor.

    Attributes:
        looks: class of the looks that a model makes of the examples.
        more: names of further fields that these looks need.
        features: `(E, X·Y, …, X·Y, F)`, what a look from each cell tells about each cell.
        score: `(E, X·Y, …)`, highest score of the class in the look from each cell.
        distance: `(E, X·Y, X·Y)`, distance of the cells from each other.
        scene: `(E,)`, number of the photograph.
        target: `(E, …)`, class 1..K, or classes.
    """

    looks: ClassVar[type[EvidenceLook]]
    more: ClassVar[tuple[str, ...]] = ()

    features: Tensor
    score: Tensor
    distance: Tensor
    scene: Tensor
    target: Tensor

    def __len__(self) -> int:
        return len(self.scene)

    def __getitem__(self, index: Tensor) -> Self:
        """Select examples by index or mask."""
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))


class _ExampleLooks(Looks):
    """Looks at many photographs at once, with one episode for each example."""

    def __init__(self, examples: Examples, grid: Grid) -> None:
        self.examples = examples
        self.grid = grid
        self.like = examples.score

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Look up the looks from some cells, processed by the model in training."""
        examples = self.examples
        model = own(observer, Gatherer, "observer").model  # type: ignore[type-abstract]
        look = examples.looks(
            model.evidence(examples.features[episodes, cell].float()),
            examples.distance[episodes, cell],
            examples.score[episodes, cell],
            cell,
            examples.target[episodes],
            self.grid.columns,
            *(getattr(examples, name)[episodes] for name in examples.more),
        )
        return EpisodeLook(look, _no_detections, {})


def _no_detections() -> Detections:
    raise NotImplementedError("examples store features of detections, not the detections")


def example_episodes(
    examples: Examples,
    observer: Observer,
    acquisition: AcquisitionFunction,
    grid: Grid,
    looks: int,
    astray: float,
    generator: torch.Generator,
) -> Iterator[Step]:
    """Make one episode over every example, from a random start. Searches continue after they reach their target.

    Args:
        examples: E examples; all episodes run side by side.
        observer: makes the belief.
        acquisition: gives the values of the cells.
        grid: the cells.
        looks: number of looks.
        astray: share of the fixations that are drawn at random.
        generator: draws starts, ties and random fixations.

    Returns:
        The steps, one for each look.
    """
    start = torch.randint(len(grid), (len(examples),), generator=generator)

    def noise(_: int, episodes: Tensor) -> Tensor:
        return torch.rand(len(episodes), len(grid), generator=generator)

    choice = _Exploratory(noise, astray)
    return rollout(_ExampleLooks(examples, grid), observer, acquisition, start, choice, most=looks)

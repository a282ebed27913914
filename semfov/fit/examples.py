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
    """`Greedy`, with some fixations drawn at random so that training sees all cells."""

    def __init__(self, noise: Callable[[int, Tensor], Tensor], astray: float) -> None:
        super().__init__(noise)
        self.astray = astray

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the best cell, or with the probability `astray` any cell not visited."""
        drawn = self.noise(shift, episodes)[:, :1] < self.astray
        return super().__call__(shift, episodes, torch.where(drawn, 0.0, values.detach()), visited, centres)


@dataclass(frozen=True)
class Examples:
    """Base of training examples, a row of each tensor; `looks` are made of them and `more` fields by a model."""

    looks: ClassVar[type[EvidenceLook]]
    more: ClassVar[tuple[str, ...]] = ()

    features: Tensor  # (E, X·Y, …, X·Y, F)
    score: Tensor  # (E, X·Y, …)
    distance: Tensor  # (E, X·Y, X·Y)
    scene: Tensor  # (E,)
    target: Tensor  # (E, …)

    def __len__(self) -> int:
        return len(self.scene)

    def __getitem__(self, index: Tensor) -> Self:
        """Select examples by index or mask."""
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))


class _ExampleLooks(Looks):
    """Looks at many photographs at once, with one episode for each example."""

    def __init__(self, examples: Examples, grid: Grid) -> None:
        self.examples, self.grid = examples, grid
        self.like = examples.score

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Look up the looks from some cells, processed by the model in training."""
        examples, model = self.examples, own(observer, Gatherer, "observer").model  # type: ignore[type-abstract]
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
    """Make one episode over every example, from a random start. Searches continue after they reach their target."""
    start = torch.randint(len(grid), (len(examples),), generator=generator)
    choice = _Exploratory(lambda _, episodes: torch.rand(len(episodes), len(grid), generator=generator), astray)
    return rollout(_ExampleLooks(examples, grid), observer, acquisition, start, choice, most=looks)

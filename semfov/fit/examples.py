"""Training examples, each with the looks from every cell of a photograph, and episodes over them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Observer
from semfov.belief.observers.base import Look
from semfov.detection.detections import Detections
from semfov.episode import Looks, Sight, Step, rollout
from semfov.gaze.acquisition import AcquisitionFunction
from semfov.gaze.choice import Exploratory


@dataclass(frozen=True)
class Examples(ABC):
    """Base of training examples; the fields are tensors with a row for each example.

    Attributes:
        features: `(E, X·Y, …, X·Y, F)`, features of the looks from every cell, in half precision.
        score: `(E, X·Y, …)`, highest score of a class in the look from each cell.
        distance: `(E, X·Y, X·Y)`, distance from every cell to every cell, in units of the image's longer side.
        scene: `(E,)`, index of the photograph.
    """

    features: Tensor
    score: Tensor
    distance: Tensor
    scene: Tensor

    def __len__(self) -> int:
        return len(self.scene)

    def __getitem__(self, index: Tensor) -> Self:
        """Select examples by index or mask."""
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))

    @abstractmethod
    def look(self, observer: Observer, episodes: Tensor, cell: Tensor, columns: int) -> Look:
        """Process stored looks with the model in training.

        Args:
            observer: the observer with the model.
            episodes: `(A,)`, the examples.
            cell: `(A,)`, the fixated cell of each.
            columns: number of columns of the grid.

        Returns:
            Their evidence.
        """


class ExampleLooks(Looks):
    """Looks at many photographs at once, with one episode for each example.

    Args:
        examples: the examples, one for each episode.
        grid: the grid of cells, of the examples' size.
    """

    def __init__(self, examples: Examples, grid: Grid) -> None:
        self.examples, self.grid = examples, grid
        self.like = examples.score

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """Look up the looks from some cells, processed by the model in training."""
        return Sight(self.examples.look(observer, episodes, cell, self.grid.columns), _no_detections, {})


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
        examples: the examples.
        observer: the observer with the model.
        acquisition: chooses the fixations.
        grid: the grid of cells.
        looks: number of looks in an episode.
        astray: share of the fixations that are drawn at random.
        generator: source of random numbers.

    Returns:
        The steps of all episodes together.
    """
    start = torch.randint(len(grid), (len(examples),), generator=generator)
    choice = Exploratory(lambda _, episodes: torch.rand(len(episodes), len(grid), generator=generator), astray)
    return rollout(ExampleLooks(examples, grid), observer, acquisition, start, choice, most=looks)

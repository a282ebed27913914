"""Episodes of the protocols, a look at a time: what single and vectorised environments are made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.observers import Observer
from semfov.detection.detections import Detections
from semfov.envs.looks import SceneLooks
from semfov.envs.scenery import Scenery
from semfov.episode import Memory, attend
from semfov.errors import check, check_number
from semfov.experiments.search_protocol import Episode
from semfov.metrics.exploration import count_right


@dataclass(frozen=True)
class Moved:
    """What came of a gaze shift of n episodes, each `(n,)`.

    Attributes:
        reward: what it found, minus its price.
        terminated: whether the episode is over.
        truncated: whether its gaze shifts are spent.
    """

    reward: Tensor
    terminated: Tensor
    truncated: Tensor


class Gazes(ABC):
    """A batch of episodes, each in a scene of its own.

    A look at a cell that was fixated before shows nothing new, for scenes stand still: it costs its price and changes
    nothing.

    Args:
        scenery: scenes, looks and belief.
        count: how many episodes there are at a time, B.
        price: of a look.
        find: what is to be found is worth.
        together: compute all episodes at once.

    Attributes:
        episodes: of the protocol, one for each row; None before the first.
        memory: beliefs and visited cells.
        cell: `(B,)`, fixated cells.
        shift: `(B,)`, gaze shifts that were made.
    """

    memory: Memory

    def __init__(self, scenery: Scenery, count: int, *, price: float, find: float, together: bool) -> None:
        check_number(price, "price", 0, 1e9)
        check_number(find, "find", 0, 1e9)
        self.scenery, self.price, self.find = scenery, price, find
        self.observer: Observer = scenery.together() if together else scenery.observer
        self.looks = SceneLooks(scenery.open, self.observer, count)
        self.episodes: list[Any] = [None] * count
        self.cell, self.shift = torch.zeros(2, count, dtype=torch.int64)
        self.size = torch.zeros(count, 2)
        self._targets = torch.zeros(count, dtype=torch.int64)
        self._begun = False

    @property
    def belief(self) -> Belief:
        """After the last look of each episode."""
        return self.memory.belief

    @property
    def targets(self) -> Tensor:
        """Class that each episode searches for, `(B,)`; 0 where nothing is searched for."""
        return self._targets

    @torch.inference_mode()
    def begin(self, rows: Tensor, episodes: Sequence[Any]) -> None:
        """Start episodes of the protocol in some rows `(n,)`, with a look from the start."""
        check(self._begun or len(rows) == len(self.episodes), "rows", "all, to begin with", rows.tolist())
        for row, episode in zip(rows.tolist(), episodes, strict=True):
            self.episodes[row] = episode
        scenes = [episode.scene for episode in episodes]
        cues = [episode.cue if isinstance(episode, Episode) else 0 for episode in episodes]
        self._targets[rows] = torch.tensor(cues)
        searching = isinstance(episodes[0], Episode)
        self.looks.enter(rows, scenes, self._targets[rows] if searching else None)
        self.size[rows] = torch.stack([self.scenery.grid(scene).extent for scene in scenes])
        self.cell[rows] = torch.tensor([episode.start for episode in episodes])
        self.shift[rows] = 0
        fresh = self._look(Memory.empty(self.looks, self.observer, len(rows)), rows)
        self.memory = self.memory.put(rows, fresh) if self._begun else fresh
        self._begun = True
        self._enter(rows, episodes)

    @torch.inference_mode()
    def move(self, rows: Tensor, cells: Tensor) -> Moved:
        """Shift the gaze of some rows `(n,)` to cells `(n,)`, and look."""
        fresh = ~self.memory.visited[rows, cells]
        self.cell[rows] = cells
        self.shift[rows] += 1
        new = rows[fresh]
        if len(new) == len(self.episodes):
            self.memory = self._look(self.memory, new)
        elif len(new):
            self.memory = self.memory.put(new, self._look(self.memory[new], new))
        gain, over = self._judge(rows)
        truncated = ~over & (self.shift[rows] >= self.scenery.shifts)
        return Moved(self.find * gain.double() - self.price, over, truncated)

    def _look(self, memory: Memory, rows: Tensor) -> Memory:
        return attend(self.looks, self.observer, memory, rows, self.cell[rows], self.points(rows))[1]

    def points(self, rows: Tensor) -> Tensor:
        """Fixated points `(n, 2)` in pixels of the scenes."""
        return self.places(rows) * self.size[rows] - 0.5

    def places(self, rows: Tensor) -> Tensor:
        """Fixated points `(n, 2)` as shares of width and height."""
        lines, columns = self.scenery.shape
        cell = self.cell[rows]
        return torch.stack([(cell % columns + 0.5) / columns, (cell // columns + 0.5) / lines], -1)

    def seen(self, rows: Tensor) -> Detections:
        """What is seen from where the gazes are, a batch of n."""
        return self.looks.see(self.observer, rows, self.cell[rows], self.points(rows)).detections()

    @abstractmethod
    def map(self, rows: Tensor) -> Tensor:
        """What is believed, `(n, C, Y, X)`, in [0, 1]."""

    @abstractmethod
    def result(self, rows: Tensor) -> Tensor:
        """How far the task is done, `(n,)`, from 0 to 1."""

    @abstractmethod
    def _enter(self, rows: Tensor, episodes: Sequence[Any]) -> None:
        """Take account of new episodes, which had their first look."""

    @abstractmethod
    def _judge(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """What the last look found, and whether the episode is over, each `(n,)`."""


class Searches(Gazes):
    """Searches: over when the gaze lands on a cell that an object of the target class overlaps."""

    def __init__(self, scenery: Scenery, count: int, **options: Any) -> None:
        super().__init__(scenery, count, **options)
        self._goal = torch.zeros(count, scenery.shape[0] * scenery.shape[1], dtype=torch.bool)

    def map(self, rows: Tensor) -> Tensor:
        """Probability of the target in each cell if no fixated cell holds it, `(n, 1, Y, X)`; 0 in fixated cells."""
        every = len(rows) == len(self.episodes)
        belief, visited = self.memory.belief, self.memory.visited
        belief, visited = (belief, visited) if every else (belief[rows], visited[rows])
        chance = belief.chance(self._targets[rows]).masked_fill(visited, 0.0)
        return chance.reshape(-1, 1, *self.scenery.shape)

    def result(self, rows: Tensor) -> Tensor:
        """1 where the gaze is on the target."""
        return self._goal[rows, self.cell[rows]].float()

    def _enter(self, rows: Tensor, episodes: Sequence[Any]) -> None:
        goal = torch.zeros(len(rows), self._goal.shape[1], dtype=torch.bool)
        for number, episode in enumerate(episodes):
            goal[number, list(episode.goal)] = True
        self._goal[rows] = goal

    def _judge(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        found = self.result(rows)
        return found, found > 0


class Explorations(Gazes):
    """Explorations: over when every cell was fixated."""

    def __init__(self, scenery: Scenery, count: int, **options: Any) -> None:
        super().__init__(scenery, count, **options)
        self._answers = torch.zeros(count, scenery.shape[0] * scenery.shape[1], len(scenery.classes), dtype=torch.bool)
        self._success = torch.zeros(count)

    def map(self, rows: Tensor) -> Tensor:
        """Probability of every class in each cell, background first, `(n, K+1, Y, X)`."""
        every = len(rows) == len(self.episodes)
        known = (self.memory.belief if every else self.memory.belief[rows]).class_probabilities()
        return known.mT.reshape(len(rows), -1, *self.scenery.shape)

    def result(self, rows: Tensor) -> Tensor:
        """Share of the cells with objects whose most probable class is that of one of them."""
        return self._success[rows]

    def _enter(self, rows: Tensor, episodes: Sequence[Any]) -> None:
        self._answers[rows] = torch.stack([self.scenery.answers(episode.scene) for episode in episodes])
        self._success[rows] = self._rate(rows)

    def _judge(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        before = self._success[rows]
        self._success[rows] = self._rate(rows)
        return self._success[rows] - before, self.memory.visited[rows].all(-1)

    def _rate(self, rows: Tensor) -> Tensor:
        every = len(rows) == len(self.episodes)
        known = (self.memory.belief if every else self.memory.belief[rows]).class_probabilities()
        answers = self._answers[rows]
        return count_right(known, answers) / answers.any(-1).sum(-1)

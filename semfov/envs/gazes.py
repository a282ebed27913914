"""Episodes of the protocols, one look at a time: the common core of single and vectorised environments."""

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
    """The result of a gaze shift in n episodes.

    Attributes:
        reward: `(n,)`, reward for what the look found, minus its price.
        terminated: `(n,)`, whether the episode is over because the task is done.
        truncated: `(n,)`, whether the gaze shifts are used up.
    """

    reward: Tensor
    terminated: Tensor
    truncated: Tensor


class Gazes(ABC):
    """A batch of episodes, each in a scene of its own.

    Scenes are static, so a second look at a cell shows nothing new: it costs its price and changes nothing.

    Args:
        scenery: scenes, looks and belief.
        count: B, number of episodes at a time.
        price: cost of a look.
        find: reward for finding the target, or for a complete map.
        together: whether learned beliefs of all episodes are computed at once.

    Attributes:
        episodes: episode of the protocol in each row; None before the first.
        memory: beliefs and visited cells.
        cell: `(B,)`, fixated cells.
        shift: `(B,)`, number of gaze shifts so far.
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
        """Belief after the last look of each episode."""
        return self.memory.belief

    @property
    def targets(self) -> Tensor:
        """Class that each episode searches for, `(B,)`; 0 in explorations."""
        return self._targets

    @torch.inference_mode()
    def begin(self, rows: Tensor, episodes: Sequence[Any]) -> None:
        """Start episodes of the protocol in the rows `(n,)`, with a look from their start."""
        every = self._begun or len(rows) == len(self.episodes)
        check(every, "rows", f"all {len(self.episodes)} rows at the first start", rows.tolist())
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
        """Move the gaze of the rows `(n,)` to cells `(n,)`, and look."""
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
        """Fixated points `(n, 2)` as fractions of width and height."""
        lines, columns = self.scenery.shape
        cell = self.cell[rows]
        return torch.stack([(cell % columns + 0.5) / columns, (cell // columns + 0.5) / lines], -1)

    def seen(self, rows: Tensor) -> Detections:
        """Detections of the present looks, a batch of n."""
        return self.looks.see(self.observer, rows, self.cell[rows], self.points(rows)).detections()

    @abstractmethod
    def map(self, rows: Tensor) -> Tensor:
        """The belief as planes `(n, C, Y, X)`, in [0, 1]."""

    @abstractmethod
    def result(self, rows: Tensor) -> Tensor:
        """Result of the task so far, `(n,)`, from 0 to 1."""

    @abstractmethod
    def _enter(self, rows: Tensor, episodes: Sequence[Any]) -> None:
        """Prepare the rows for new episodes, whose first look was made."""

    @abstractmethod
    def _judge(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Gain of the last look, and whether the episode is over, each `(n,)`."""


class Searches(Gazes):
    """Searches: an episode is over when the gaze lands on a cell that an object of the target class overlaps."""

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
    """Explorations: an episode is over when every cell was fixated."""

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
        """Fraction of the cells with objects whose most probable class is that of one of these objects."""
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

"""The loop of active perception: look, weigh what was seen, update the belief, choose where to look next."""

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer
from semfov.detection.detections import Detections
from semfov.errors import check_number
from semfov.eye import Eye, View
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.choice import Choice

STAGES = ("foveate", "detect", "weigh", "update belief", "choose")
"""Stages of a cycle, in order."""

Acquire = Callable[[Tensor, Tensor], AcquisitionFunction]
"""Makes the acquisition function of some episodes `(A,)` that fixate cells `(A,)`."""


@dataclass(frozen=True)
class Sight:
    """What is seen by a look of each episode that goes on.

    Attributes:
        look: what the observer takes it to say.
        detections: gives the boxes and scores, a batch of A.
        seconds: by stage.
    """

    look: Look
    detections: Callable[[], Detections]
    seconds: dict[str, float]


class Looks(ABC):
    """Base of what episodes look at.

    Attributes:
        grid: the cells.
        like: tensor whose dtype and device beliefs take.
    """

    grid: Grid
    like: Tensor

    @abstractmethod
    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """What episodes `(A,)` see that fixate points `(A, 2)` in cells `(A,)`."""


class LiveLooks(Looks):
    """Looks of an eye at one image.

    Args:
        eye: sensor and detector.
        view: the image, as the eye holds it.
        grid: the cells over it.
        target: class that all episodes search for, for observers that go by the target.
    """

    def __init__(self, eye: Eye, view: View, grid: Grid, target: int | None = None) -> None:
        self.eye, self.view, self.grid, self.target = eye, view, grid, target
        self.like = view.canvas

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """Foveate, detect and weigh."""
        watch = Stopwatch()
        canvases = self.eye.foveated(self.view, fixation)
        watch.lap("foveate")
        detections = self.eye.detect(self.view, fixation, canvases)
        watch.lap("detect")
        look = observer.weigh(detections, fixation, self.grid, self.target)
        watch.lap("weigh")
        return Sight(look, lambda: detections, watch.seconds)


class StoredLooks(Looks):
    """Looks at one image from the centres of all cells, detected before; each is weighed once.

    Args:
        detections: what is seen from every cell, a batch of X·Y.
        grid: the cells.
        targets: `(B,)`, class that each episode searches for; None where nothing is searched for.
    """

    def __init__(self, detections: Detections, grid: Grid, targets: Tensor | None = None) -> None:
        self.detections, self.grid, self.targets = detections, grid, targets
        self.like = detections.scores
        self._weighed: tuple[Observer, Look] | None = None
        self._classes = [] if targets is None else targets.unique().tolist()

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """What the store has of the cells; the fixations are their centres."""
        watch = Stopwatch()
        targets = None if self.targets is None else self.targets[episodes]
        look = self.weighed(observer)[self.first_row(observer, targets) + cell]
        watch.lap("weigh")
        return Sight(look, lambda: self.detections[cell], watch.seconds)

    def first_row(self, observer: Observer, targets: Tensor | None) -> Tensor:
        """Row of `weighed` that has the look from cell 0, for each of the targets `(A,)`."""
        if not observer.by_target or targets is None:
            return torch.zeros((), dtype=torch.int64)
        # One row for each target and cell.
        return torch.searchsorted(targets.new_tensor(self._classes), targets) * len(self.grid)

    def rows(self, observer: Observer) -> int:
        """How many rows `weighed` has."""
        return len(self.grid) * (len(self._classes) if observer.by_target and self._classes else 1)

    def weighed(self, observer: Observer) -> Look:
        """What looks from all cells say, target by target where the observer goes by it."""
        if self._weighed is None or self._weighed[0] is not observer:
            centres = self.grid.centres.to(self.like)
            targets = self._classes if observer.by_target else [None]
            said = [observer.weigh(self.detections, centres, self.grid, target) for target in targets]
            self._weighed = observer, said[0] if len(said) == 1 else type(said[0]).join(said)
        return self._weighed[1]


@dataclass(frozen=True)
class Forgetting:
    r"""How a scene that changes is forgotten, from one look to the next.

    Evidence is discounted by :math:`e^{-r}` a look (`Observer.fade`), and a cell is kept from the gaze as long as half
    of what was seen from it is left, for :math:`\ln 2 / r` looks. Where all cells are, the one that was fixated longest
    ago is free.

    Attributes:
        rate: r, 0 or more; 0 forgets nothing.

    >>> round(Forgetting(0.1).keep, 3), round(Forgetting(0.1).span, 1)
    (0.905, 6.9)
    """

    rate: float = 0.0

    def __post_init__(self) -> None:
        check_number(self.rate, "rate", 0, 100)

    @property
    def keep(self) -> float:
        """Share of the evidence that is left after a look."""
        return math.exp(-self.rate)

    @property
    def span(self) -> float:
        """For how many looks a cell is kept from the gaze."""
        return math.log(2) / self.rate if self.rate else math.inf

    def visited(self, age: Tensor) -> Tensor:
        """Which cells the gaze is kept from, of those fixated so many looks ago, `(A, X·Y)`; infinity for never."""
        recent = (age <= self.span) & age.isfinite()
        oldest = age == age.amax(-1, keepdim=True)
        return recent & ~(recent.all(-1, keepdim=True) & oldest)


@dataclass(frozen=True)
class Step:
    """One cycle of the A episodes that go on.

    Attributes:
        shift: gaze shifts that were made before.
        episodes: `(A,)`, their numbers, from 0 to B - 1.
        cell: `(A,)`, the cell that is fixated.
        fixation: `(A, 2)`, the point.
        sight: what is seen from there.
        belief: after the look.
        visited: `(A, X·Y)` boolean, cells that inhibition of return keeps the gaze from, this one among them.
        values: `(A, X·Y)`, acquisition values.
        next_cell: `(A,)`, the chosen cell; it has no meaning where all were visited.
        next_fixation: `(A, 2)`, the chosen point.
        seconds: by stage (`STAGES`).
    """

    shift: int
    episodes: Tensor
    cell: Tensor
    fixation: Tensor
    sight: Sight
    belief: Belief
    visited: Tensor
    values: Tensor
    next_cell: Tensor
    next_fixation: Tensor
    seconds: dict[str, float]

    @property
    def detections(self) -> Detections:
        """Boxes and scores, a batch of A."""
        return self.sight.detections()


@dataclass(frozen=True)
class Memory:
    """What episodes keep from one look to the next.

    Attributes:
        belief: of A episodes.
        visited: `(A, X·Y)` boolean, cells that inhibition of return keeps the gaze from.
        age: `(A, X·Y)`, looks since each cell was fixated, where anything is forgotten; infinity for never.
    """

    belief: Belief
    visited: Tensor
    age: Tensor

    @classmethod
    def empty(cls, looks: Looks, observer: Observer, episodes: int) -> "Memory":
        """Before the first look."""
        cells, device = len(looks.grid), looks.like.device
        visited = torch.zeros(episodes, cells, dtype=torch.bool, device=device)
        age = torch.full(visited.shape, torch.inf, device=device)
        return cls(observer.start(episodes, looks.grid, looks.like), visited, age)

    def __getitem__(self, index: Tensor) -> "Memory":
        """That of some of the episodes."""
        return Memory(self.belief[index], self.visited[index], self.age[index])

    def put(self, index: Tensor, other: "Memory") -> "Memory":
        """The memory in which the episodes `index` `(n,)` have another's; both have had a look."""
        visited, age = self.visited.index_copy(0, index, other.visited), self.age.index_copy(0, index, other.age)
        return Memory(self.belief.put(index, other.belief), visited, age)


def attend(
    looks: Looks,
    observer: Observer,
    memory: Memory,
    episodes: Tensor,
    cell: Tensor,
    fixation: Tensor,
    forgetting: Forgetting | None = None,
) -> tuple[Sight, Memory]:
    """One look of each episode, and the memory with it: the step that `rollout` and the environments share.

    Args:
        looks: what is looked at.
        observer: turns looks into belief.
        memory: of the A episodes.
        episodes: `(A,)`, their numbers.
        cell: `(A,)`, that each fixates.
        fixation: `(A, 2)`, the points.
        forgetting: see `rollout`.
    """
    sight = looks.see(observer, episodes, cell, fixation)
    watch = Stopwatch(sight.seconds)
    belief, age = memory.belief, memory.age
    if forgetting is not None:
        age = age + 1
        belief = observer.fade(belief, sight.look, forgetting.keep, forgetting.visited(age))
    belief = observer.update(belief, sight.look)
    watch.lap("update belief")
    visited = memory.visited.scatter(-1, cell[:, None], True)
    if forgetting is not None:
        age = age.scatter(-1, cell[:, None], 0)
        visited = forgetting.visited(age)
    return Sight(sight.look, sight.detections, watch.seconds), Memory(belief, visited, age)


def rollout(
    looks: Looks,
    observer: Observer,
    acquisition: AcquisitionFunction | Acquire,
    start: Tensor,
    choice: Choice,
    *,
    most: int,
    ends: Callable[[Step], Tensor] | None = None,
    window: int | None = None,
    forgetting: Forgetting | None = None,
) -> Iterator[Step]:
    """Episodes of active perception in one image, a step of all of them at a time.

    An episode is over when `ends` says so, when every cell was visited, or after `most` looks.

    Args:
        looks: what is looked at: by an eye (`LiveLooks`) or in a store (`StoredLooks`).
        observer: turns looks into belief.
        acquisition: values the cells; a function of the episodes that go on where it differs from one to the next.
        start: `(B,)`, the cell that each episode fixates first.
        choice: how the next fixation is chosen: `Greedy`, `Relaxed` for gradients, or `Given`.
        most: most looks of an episode.
        ends: which of the episodes of a step end with it, `(A,)` boolean.
        window: looks that a gradient flows through; at the border of two windows belief and fixation become constants
            (truncated backpropagation through time), once the step was used.
        forgetting: how belief and inhibition of return fade, where the scene changes from look to look; None for scenes
            that stand still.

    Example::

        choice = Greedy(drawn_by(torch.Generator(), len(grid), image))
        for step in rollout(LiveLooks(eye, eye.open(image), grid), observer, acquisition, start, choice, most=10):
            print(step.cell, step.belief.probability(target))
    """
    if not len(start):
        return
    acquire = (lambda episodes, cell: acquisition) if isinstance(acquisition, AcquisitionFunction) else acquisition
    centres = looks.grid.centres.to(looks.like)
    episodes, cell, fixation = torch.arange(len(start), device=start.device), start, centres[start]
    memory = Memory.empty(looks, observer, len(start))
    for shift in range(most):
        sight, memory = attend(looks, observer, memory, episodes, cell, fixation, forgetting)
        belief, visited = memory.belief, memory.visited
        watch = Stopwatch(sight.seconds)
        values = acquire(episodes, cell)(belief, visited)
        next_fixation, next_cell = choice(shift, episodes, values, visited, centres)
        watch.lap("choose")
        step = Step(
            shift,
            episodes,
            cell,
            fixation,
            sight,
            belief,
            visited,
            values,
            next_cell,
            next_fixation,
            seconds=watch.seconds,
        )
        yield step
        over = visited.all(-1)
        going = ~over if ends is None else ~(over | ends(step))
        if not going.any():
            return
        if window is not None and (shift + 1) % window == 0:
            memory, next_fixation = replace(memory, belief=belief.detach()), next_fixation.detach()
        cell, fixation = next_cell, next_fixation
        if not going.all():
            episodes, cell, fixation, memory = episodes[going], cell[going], fixation[going], memory[going]


class Stopwatch:
    """Seconds by stage.

    Args:
        seconds: of stages that were measured before.
    """

    def __init__(self, seconds: dict[str, float] | None = None) -> None:
        self.seconds = dict(seconds or {})
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Count the time since the last lap to a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now

"""The loop of active perception: look, weigh the detections, update the belief, choose the next fixation."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.observers.base import Observer
from semfov.detection.detections import Detections
from semfov.episode.looks import EpisodeLook, Looks
from semfov.episode.memory import Forgetting, Memory
from semfov.episode.stopwatch import Stopwatch
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.choice import Choice


@dataclass(frozen=True)
class Step:
    """One cycle of the A episodes that have not ended.

    Attributes:
        shift: number of gaze shifts before this look.
        episodes: `(A,)`, numbers of the episodes, from 0 to B - 1.
        cell: `(A,)`, the fixated cell.
        fixation: `(A, 2)`, the fixated point as `(x, y)` in pixels.
        look: the looks.
        belief: the belief after the looks.
        visited: `(A, X·Y)` boolean, cells that inhibition of return keeps the gaze from, including this one.
        values: `(A, X·Y)`, values of the acquisition function.
        next_cell: `(A,)`, the chosen cell; without meaning if all cells were visited.
        next_fixation: `(A, 2)`, the chosen point.
        seconds: time by stage (`STAGES`).

    Example::

        for step in rollout(looks, observer, acquisition, start, choice, most=10):
            print(step.shift, step.cell, step.belief.probability(target).amax(-1))
    """

    shift: int
    episodes: Tensor
    cell: Tensor
    fixation: Tensor
    look: EpisodeLook
    belief: Belief
    visited: Tensor
    values: Tensor
    next_cell: Tensor
    next_fixation: Tensor
    seconds: dict[str, float]

    @property
    def detections(self) -> Detections:
        """The detections, a batch of A."""
        return self.look.detections()


def attend(
    looks: Looks,
    observer: Observer,
    memory: Memory,
    episodes: Tensor,
    cell: Tensor,
    fixation: Tensor,
    forgetting: Forgetting | None = None,
) -> tuple[EpisodeLook, Memory]:
    """Make one look in each of A episodes, and update their state. `rollout` and the environments share this step.

    Args:
        looks: the source of looks.
        observer: turns looks into a belief.
        memory: the state of the episodes.
        episodes: `(A,)`, numbers of the episodes.
        cell: `(A,)`, fixated cells.
        fixation: `(A, 2)`, fixated points.
        forgetting: fading of belief and inhibition of return; None for scenes that do not change.

    Returns:
        The looks, and the state after them.
    """
    look = looks.see(observer, episodes, cell, fixation)
    watch = Stopwatch(look.seconds)
    if forgetting is not None:
        # What was seen before fades first: the new look counts in full.
        memory = _faded(memory, observer, look, forgetting)
    belief = observer.update(memory.belief, look.evidence)
    watch.lap("update belief")
    timed_look = replace(look, seconds=watch.seconds)
    if forgetting is None:
        return timed_look, Memory(belief, memory.visited.scatter(-1, cell[:, None], True), memory.age)
    age = memory.age.scatter(-1, cell[:, None], 0)
    return timed_look, Memory(belief, forgetting.visited(age), age)


def _faded(memory: Memory, observer: Observer, look: EpisodeLook, forgetting: Forgetting) -> Memory:
    """Let belief and visits fade over the time that a look took."""
    age = memory.age + look.passed
    share_left = forgetting.share_left(look.passed)
    belief = observer.fade(memory.belief, look.evidence, share_left, forgetting.visited(age))
    return replace(memory, belief=belief, age=age)


def rollout(
    looks: Looks,
    observer: Observer,
    acquisition: AcquisitionFunction | Callable[[Tensor, Tensor], AcquisitionFunction],
    start: Tensor,
    choice: Choice,
    *,
    most: int,
    ends: Callable[[Step], Tensor] | None = None,
    window: int | None = None,
    forgetting: Forgetting | None = None,
) -> Iterator[Step]:
    """Run episodes of active perception in one image, one step of all episodes at a time.

    An episode ends when `ends` says so, when every cell was visited, or after `most` looks.

    Args:
        looks: the source of looks: an eye (`LiveLooks`) or stored detections (`StoredLooks`).
        observer: turns looks into a belief.
        acquisition: acquisition function that values the cells; or a function that makes one for the current episodes
            `(A,)` and the cells `(A,)` that they fixate, if it differs between episodes.
        start: `(B,)`, first cell of each episode.
        choice: way to choose the next fixation: `Greedy`, `Relaxed` for gradients, or `Given`.
        most: largest number of looks in an episode.
        ends: function from a step to `(A,)` boolean, the episodes that end with it.
        window: number of looks that a gradient flows through. At the end of each window, after the step was yielded,
            belief and fixation are detached (truncated backpropagation through time). None detaches nothing.
        forgetting: fading of belief and inhibition of return, for scenes that change between looks; None for scenes
            that do not change.

    Yields:
        One step for each look.

    >>> from semfov import Detections, Grid
    >>> from semfov.belief.observers import Semantic
    >>> from semfov.episode import StoredLooks
    >>> from semfov.gaze.acquisition import TargetPosterior
    >>> from semfov.gaze.choice import Greedy
    >>> scores = torch.tensor([[[0.1, 0.9]]]).repeat(4, 1, 1)  # the target is seen in the right cell from anywhere
    >>> seen = Detections(torch.tensor([[[32.0, 0, 38, 9]]]).repeat(4, 1, 1), scores, torch.ones(4, 1).bool())
    >>> looks, choice = StoredLooks(seen, Grid(4, 1, (40, 10))), Greedy(lambda shift, episodes: torch.rand(1, 4))
    >>> for step in rollout(looks, Semantic(2), TargetPosterior(1), torch.tensor([0]), choice, most=2):
    ...     print(step.cell, step.belief.probability(1))
    tensor([0]) tensor([[0.5000, 0.5000, 0.5000, 0.7000]])
    tensor([3]) tensor([[0.5000, 0.5000, 0.5000, 0.7955]])
    """
    if not len(start):
        return
    acquire = acquisition
    if isinstance(acquisition, AcquisitionFunction):
        acquire = _always(acquisition)
    centres = looks.grid.centres.to(looks.like)  # (X·Y, 2)
    # Of the episodes that have not ended, of which there are fewer and fewer: A of the B at the start.
    episodes = torch.arange(len(start), device=start.device)
    cell = start
    fixation = centres[start]
    memory = Memory.empty(looks, observer, len(start))
    for shift in range(most):
        look, memory = attend(looks, observer, memory, episodes, cell, fixation, forgetting)
        watch = Stopwatch(look.seconds)
        values = acquire(episodes, cell)(memory.belief, memory.visited)
        next_fixation, next_cell = choice(shift, episodes, values, memory.visited, centres)
        watch.lap("choose")
        step = Step(
            shift=shift,
            episodes=episodes,
            cell=cell,
            fixation=fixation,
            look=look,
            belief=memory.belief,
            visited=memory.visited,
            values=values,
            next_cell=next_cell,
            next_fixation=next_fixation,
            seconds=watch.seconds,
        )
        yield step
        over = memory.visited.all(-1)  # (A,)
        if ends is not None:
            over = over | ends(step)
        going = ~over
        if not going.any():
            return
        if window is not None and (shift + 1) % window == 0:
            memory = replace(memory, belief=memory.belief.detach())
            next_fixation = next_fixation.detach()
        cell = next_cell
        fixation = next_fixation
        if not going.all():
            episodes = episodes[going]
            cell = cell[going]
            fixation = fixation[going]
            memory = memory[going]


def _always(acquisition: AcquisitionFunction) -> Callable[[Tensor, Tensor], AcquisitionFunction]:
    """Make the function that gives one acquisition function for all episodes and cells."""
    return lambda episodes, cell: acquisition

"""The state of episodes between two looks: belief, visited cells and their ages, and forgetting."""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.observers.base import Observer
from semfov.episode.looks import Looks
from semfov.errors import check_number


@dataclass(frozen=True)
class Forgetting:
    r"""Forgetting in a scene that changes between looks.

    After t seconds :math:`e^{-rt}` of past evidence is left (`Observer.fade`). Inhibition of return keeps the gaze from
    a fixated cell for :math:`\ln 2 / r` seconds, until half of its evidence is left. If all cells are inhibited, the
    one that was fixated longest ago is free.

    What forgets by it:

    - the belief of a fovea or a head, by `share_left`: `attend` (`semfov.episode.loop`) calls `Observer.fade`;
    - probabilities of closer looks, and of a fovea scores of looks, by `share_left`, and both as a whole after `span`
      or a multiple of it (`semfov.decision.candidates`, `semfov.decision.verifier`);
    - that a target was absent, after `span` (`semfov.zoom.decision.LastingAbsence`);
    - detections by which a search decides: after `span` (`semfov.decision.stopping`);
    - looks at windows: after `span`, or when a look replaces them; the look at the whole when it is made anew
      (`semfov.zoom.episode`, `semfov.agents.window_episode`).

    Objects that are tracked have a rate of their own (`TrackingModel.loss`). The default rates are `RATE` in
    `semfov.agents.fovea` and in `semfov.agents.windows`; a scene for a head has its own `rate`.

    With a rate of 0 nothing is forgotten, and a stream is taken for a still picture: no object is tracked, boxes are
    joined over all looks (`semfov.zoom.objects`), no window is looked at twice, and the episode ends where nothing is
    left to look at.

    Attributes:
        rate: r per second, 0 or more; 0 forgets nothing.
        span: seconds after which half of the evidence is left, :math:`\ln 2 / r`.

    Raises:
        InputError: `rate` is negative or above 100.

    >>> round(Forgetting(2.5).share_left(1.0), 3), round(Forgetting(2.5).span, 3)
    (0.082, 0.277)
    """

    rate: float = 0.0
    span: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_number(self.rate, "rate", 0, 100)
        object.__setattr__(self, "span", math.log(2) / self.rate if self.rate else math.inf)

    def share_left(self, seconds: float) -> float:
        r"""Compute the share of evidence that is left after some seconds, :math:`e^{-rt}`.

        Args:
            seconds: t, 0 or more.

        Returns:
            The share, from 0 to 1.
        """
        return math.exp(-self.rate) ** seconds

    def visited(self, age: Tensor) -> Tensor:
        """Cells that inhibition of return keeps the gaze from.

        Args:
            age: `(A, X·Y)`, seconds since each cell was fixated; infinity for never.

        Returns:
            `(A, X·Y)` boolean.

        >>> Forgetting(0.5).visited(torch.tensor([[0.0, 1.0, 2.0, torch.inf]]))
        tensor([[ True,  True, False, False]])
        """
        # Without forgetting the span is infinite, too: a cell that was never fixated is not recent.
        recent = (age <= self.span) & age.isfinite()
        oldest = age == age.amax(-1, keepdim=True)
        is_all_recent = recent.all(-1, keepdim=True)
        return recent & ~(is_all_recent & oldest)


@dataclass(frozen=True)
class Memory:
    """State of A episodes between two looks: their belief, and cells `(A, X·Y)` that the gaze is kept from (`visited`).

    With forgetting, the `age` `(A, X·Y)` of a cell is the time in seconds since its fixation, infinity for never.
    """

    belief: Belief
    visited: Tensor
    age: Tensor

    @classmethod
    def empty(cls, looks: Looks, observer: Observer, episodes: int) -> "Memory":
        """State before the first look."""
        belief = observer.start(episodes, looks.grid, looks.like)
        visited = torch.zeros(episodes, len(looks.grid), dtype=torch.bool, device=looks.like.device)
        age = torch.full(visited.shape, torch.inf, device=looks.like.device)
        return cls(belief, visited, age)

    def __getitem__(self, index: Tensor) -> "Memory":
        """State of the selected episodes."""
        return Memory(self.belief[index], self.visited[index], self.age[index])

    def put(self, index: Tensor, other: "Memory") -> "Memory":
        """Replace the state of some episodes `(n,)`; both must have had a look."""
        belief = self.belief.put(index, other.belief)
        visited = self.visited.index_copy(0, index, other.visited)
        age = self.age.index_copy(0, index, other.age)
        return Memory(belief, visited, age)

"""Sources of looks for episodes: an eye at an image, or stored detections."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers.base import Evidence, Observer
from semfov.data.inputs import FRAME
from semfov.detection.detections import Detections
from semfov.episode.stopwatch import Stopwatch
from semfov.eye import Eye, View


@dataclass(frozen=True)
class EpisodeLook:
    """One look of each of A episodes.

    Attributes:
        evidence: what the looks tell, from `Observer.weigh`.
        detections: function that returns the detections, a batch of A.
        seconds: time by stage.
        passed: seconds since the look before, in a stream.

    >>> from semfov.belief.observers.semantic import SemanticEvidence
    >>> evidence = SemanticEvidence(torch.ones(1, 5, 3), torch.ones(1, 5, 4), torch.zeros(1, 4))
    >>> look = EpisodeLook(evidence, lambda: None, {"detect": 0.02})
    >>> look.seconds
    {'detect': 0.02}
    """

    evidence: Evidence
    detections: Callable[[], Detections]
    seconds: dict[str, float]
    passed: float = FRAME


class Looks(ABC):
    """Base of the sources of looks for episodes: an eye (`LiveLooks`) or stored detections (`StoredLooks`).

    Attributes:
        grid: the cells.
        like: a tensor; beliefs take its dtype and device.

    Example::

        class Recorded(semfov.episode.Looks):
            def see(self, observer, episodes, cell, fixation):
                detections = self.recorded[cell]  # a batch of A
                return EpisodeLook(observer.weigh(detections, fixation, self.grid), lambda: detections, {})
    """

    grid: Grid
    like: Tensor

    @abstractmethod
    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Make one look in each of A episodes.

        Args:
            observer: weighs the detections.
            episodes: `(A,)`, numbers of the episodes.
            cell: `(A,)`, fixated cells.
            fixation: `(A, 2)`, fixated points as `(x, y)` in pixels.

        Returns:
            The looks.
        """


class LiveLooks(Looks):
    """Looks of an eye at one image.

    Args:
        eye: sensor and detector.
        view: the image, opened by the eye.
        grid: the cells over the image.
        target: class 1..K that all episodes search for; needed by observers that are `by_target`.
        device: where detections are moved to, weighed and believed; None is where the eye is. The belief of one episode
            is faster on the CPU, also beside a GPU: its operations are short, and many.

    Attributes:
        passed: seconds of a stream between the look before and the next one.

    Example::

        looks = LiveLooks(eye, eye.open(image), grid, target=1)
        for step in rollout(looks, observer, acquisition, start, choice, most=10):
            print(step.cell, step.detections.count)
    """

    def __init__(
        self,
        eye: Eye,
        view: View,
        grid: Grid,
        target: int | None = None,
        *,
        device: torch.device | None = None,
    ) -> None:
        self.eye = eye
        self.view = view
        self.grid = grid
        self.target = target
        self.like = view.canvas.new_empty(0, device=device)
        self.passed = FRAME

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Foveate, detect and weigh."""
        watch = Stopwatch()
        detections = self.eye.look(self.view, fixation, watch.lap).to(self.like.device)
        look = observer.weigh(detections, fixation, self.grid, self.target)
        watch.lap("weigh")
        return EpisodeLook(look, lambda: detections, watch.seconds, self.passed)


class StoredLooks(Looks):
    """Looks at one image with stored detections, one set for the centre of each cell.

    Each look is weighed only once by each observer, also for several rollouts.

    Args:
        detections: the detections from every cell, a batch of X·Y.
        grid: the cells.
        targets: `(B,)`, class 1..K that each episode searches for; None for exploration.

    Private attributes: `_weighed` has the looks from all cells as each observer has weighed them, also for other
    episodes (`of`). `_classes` has the classes of all these episodes, in ascending order.

    >>> from semfov.belief.observers import Semantic
    >>> scores = torch.tensor([[[0.9, 0.1]], [[0.2, 0.8]]])  # of one detection from each of two cells
    >>> seen = Detections(torch.tensor([[[6.0, 0, 9, 9]]]).repeat(2, 1, 1), scores, torch.ones(2, 1).bool())
    >>> looks = StoredLooks(seen, Grid(2, 1, (10, 10)), torch.tensor([1]))
    >>> look = looks.see(Semantic(2), torch.tensor([0]), torch.tensor([1]), torch.tensor([[7.0, 4.5]]))
    >>> look.detections().scores[0]
    tensor([[0.2000, 0.8000]])
    """

    def __init__(self, detections: Detections, grid: Grid, targets: Tensor | None = None) -> None:
        self.detections = detections
        self.grid = grid
        self.targets = targets
        self.like = detections.scores
        self._weighed: dict[Observer, Evidence] = {}
        self._classes = [] if targets is None else targets.unique().tolist()

    def of(self, episodes: Tensor | slice) -> Self:
        """Select the looks of some of the episodes.

        Args:
            episodes: their numbers.

        Returns:
            The looks; what observers have weighed is shared.
        """
        looks = copy(self)
        looks.targets = None if self.targets is None else self.targets[episodes]
        return looks

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Take the stored looks of the cells; the fixations must be their centres."""
        watch = Stopwatch()
        targets = None if self.targets is None else self.targets[episodes]
        row = self.first_row(observer, targets) + cell
        look = self.weighed(observer)[row]
        watch.lap("weigh")
        return EpisodeLook(look, lambda: self.detections[cell], watch.seconds)

    def first_row(self, observer: Observer, targets: Tensor | None) -> Tensor:
        """Row of `weighed` with the look from cell 0, for each target.

        Args:
            observer: the observer.
            targets: `(A,)`, classes 1..K, or None.

        Returns:
            `(A,)` row numbers, or `()` if the looks do not depend on the target.
        """
        if not observer.by_target or targets is None:
            return torch.zeros((), dtype=torch.int64)
        # `weighed` has all cells of the first class, then all of the second one, and so on.
        place_of_class = torch.searchsorted(targets.new_tensor(self._classes), targets)
        return place_of_class * len(self.grid)

    def rows(self, observer: Observer) -> int:
        """Count the rows of `weighed`.

        Args:
            observer: the observer.

        Returns:
            The number of looks.
        """
        by_target = observer.by_target and len(self._classes) > 0
        classes = len(self._classes) if by_target else 1
        return len(self.grid) * classes

    def weighed(self, observer: Observer) -> Evidence:
        """Evidence of the looks from all cells, computed on the first call.

        Args:
            observer: the observer that weighs them.

        Returns:
            A batch of X·Y looks; if the observer is `by_target`, X·Y looks for each target, one target after another.
        """
        if observer not in self._weighed:
            centres = self.grid.centres.to(self.like)
            # What does not depend on the target is weighed once for all of them.
            targets = self._classes if observer.by_target else [None]
            looks = [observer.weigh(self.detections, centres, self.grid, target) for target in targets]
            self._weighed[observer] = looks[0] if len(looks) == 1 else type(looks[0]).join(looks)
        return self._weighed[observer]

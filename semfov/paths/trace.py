"""Make a scanpath from the steps of an episode."""

from collections.abc import Iterable

import torch

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Observer
from semfov.detection.objects import LEAST
from semfov.episode import Step
from semfov.paths.scanpath import Scanpath


class Trace:
    """Keeps the steps of one episode, and makes scanpaths of them at any time.

    Args:
        grid: the cells.
        classes: names of the classes, background first.
        target: class 1..K that is searched for; None for exploration.
        beside: observer that keeps a map of all classes next to the belief of the episode; None if that belief is
            about all classes itself.
        least: score from which on objects count.

    Attributes:
        steps: the steps, in order.

    Example::

        trace = Trace(grid, ("background", "cup"), target=1, beside=None)
        for step in rollout(looks, observer, acquisition, start, choice, most=10):
            trace.add(step)
        scanpath = trace.scanpath()
    """

    def __init__(
        self,
        grid: Grid,
        classes: tuple[str, ...],
        target: int | None,
        beside: Observer | None,
        least: float = LEAST,
    ) -> None:
        self.grid, self.classes, self.target, self.beside, self.least = grid, classes, target, beside, least
        self.steps: list[Step] = []
        self._maps: list[torch.Tensor] = []
        self._belief: Belief | None = None

    def add(self, step: Step) -> None:
        """Keep a step.

        Args:
            step: the next step of the episode.
        """
        belief = step.belief
        if self.beside is not None:
            before = self.beside.start(1, self.grid, step.values) if self._belief is None else self._belief
            belief = self.beside(before, step.detections, step.fixation, self.grid)
        self._belief = belief
        self._maps.append(belief.class_probabilities()[0])
        self.steps.append(step)

    def scanpath(self) -> Scanpath:
        """Make the scanpath of the steps so far.

        Returns:
            The scanpath, without a decision.
        """
        steps, target = self.steps, self.target
        return Scanpath(
            grid=self.grid,
            classes=self.classes,
            target=target,
            least=self.least,
            cells=torch.cat([step.cell for step in steps]),
            fixations=torch.cat([step.fixation for step in steps]),
            detections=tuple(step.detections for step in steps),
            probabilities=torch.stack(self._maps),
            values=torch.stack([step.values[0] for step in steps]),
            found=False,
            posterior=None if target is None else torch.stack([step.belief.probability(target)[0] for step in steps]),
            presence=None if target is None else torch.stack([step.belief.presence(target)[0] for step in steps]),
            seconds=tuple(step.seconds for step in steps),
        )


def trace(
    steps: Iterable[Step], grid: Grid, classes: tuple[str, ...], target: int | None, beside: Observer | None
) -> Scanpath:
    """Make the scanpath of one episode (`Trace`).

    Args:
        steps: steps of one episode, from `semfov.episode.rollout`.
        grid: the cells.
        classes: names of the classes, background first.
        target: class 1..K that is searched for; None for exploration.
        beside: observer that keeps a map of all classes next to the belief of the episode; None if that belief is
            about all classes itself.

    Returns:
        The scanpath, without a decision.

    Example::

        steps = rollout(looks, observer, acquisition, start, choice, most=10)
        scanpath = trace(steps, grid, ("background", "cup"), target=1, beside=None)
    """
    episode = Trace(grid, classes, target, beside)
    for step in steps:
        episode.add(step)
    return episode.scanpath()

"""Make a scanpath from the steps of an episode."""

from collections.abc import Iterable

import torch

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Observer
from semfov.episode import Step
from semfov.paths.scanpath import Scanpath


def trace(
    steps: Iterable[Step], grid: Grid, classes: tuple[str, ...], target: int | None, beside: Observer | None
) -> Scanpath:
    """Make the scanpath of one episode.

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
    cells, fixations, detections, maps, values, present, anywhere, seconds = [], [], [], [], [], [], [], []
    known: Belief | None = None
    for step in steps:
        if beside is None:
            known = step.belief
        else:
            before = beside.start(1, grid, step.values) if known is None else known
            known = beside(before, step.detections, step.fixation, grid)
        cells.append(step.cell)
        fixations.append(step.fixation)
        detections.append(step.detections)
        maps.append(known.class_probabilities()[0])
        values.append(step.values[0])
        seconds.append(step.seconds)
        if target is not None:
            present.append(step.belief.probability(target)[0])
            anywhere.append(step.belief.presence(target)[0])
    return Scanpath(
        grid=grid,
        classes=classes,
        target=target,
        cells=torch.cat(cells),
        fixations=torch.cat(fixations),
        detections=tuple(detections),
        probabilities=torch.stack(maps),
        values=torch.stack(values),
        found=False,
        posterior=torch.stack(present) if present else None,
        presence=torch.stack(anywhere) if anywhere else None,
        seconds=tuple(seconds),
    )

"""The record of an episode: where the gaze went, what was seen and what was believed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Observer
from semfov.data.fixations import Fixations
from semfov.decision import Decision
from semfov.detection.detections import Detections
from semfov.episode import Step

Ending = Literal["box", "decision", "price", "shifts", "cells"]
"""Why an episode ended: the gaze was on a given box, the search decided, no look was worth its price, all gaze shifts
were made, or every cell was fixated."""


@dataclass(frozen=True)
class Scanpath:
    """Fixations of one episode in order, with what was seen and believed at each.

    Attributes:
        grid: the cells of the image.
        classes: names of the classes, background first, in the order of the belief's components.
        target: index of the class that was searched for; None for exploration.
        cells: `(n,)`, fixated cells.
        fixations: `(n, 2)`, their centres as points `(x, y)`.
        detections: what was seen from each fixation, batches of one.
        probabilities: `(n, X·Y, K+1)`, that each cell holds each class, after each look; the first is background. Of a
            learned map they are marginal: several classes can share a cell, and they need not sum to 1.
        values: `(n, X·Y)`, acquisition values that the next fixation was chosen by.
        found: whether the search ended on its target.
        posterior: `(n, X·Y)`, probability of the target in each cell as the search believed it after each look; None
            for exploration.
        presence: `(n,)`, probability that the image holds the target, after each look; None for exploration.
        decision: what the search decided; None for exploration, and where the protocol ended it on a given box.
        ending: why it ended; None where that is not known.
        seconds: what each look took, by stage (`semfov.episode.STAGES`).
    """

    grid: Grid
    classes: tuple[str, ...]
    target: int | None
    cells: Tensor
    fixations: Tensor
    detections: tuple[Detections, ...]
    probabilities: Tensor
    values: Tensor
    found: bool
    posterior: Tensor | None = None
    presence: Tensor | None = None
    decision: Decision | None = None
    ending: Ending | None = None
    seconds: tuple[Mapping[str, float], ...] = ()

    def __len__(self) -> int:
        """Number of fixations, the start included."""
        return len(self.cells)

    @property
    def shifts(self) -> int:
        """Number of gaze shifts (saccades): fixations after the start."""
        return len(self) - 1

    def as_fixations(self, picture: str, subject: str = "semfov") -> Fixations:
        """The fixations alone, as people's are kept, for `semfov.data.fixations` to write and metrics to compare.

        Args:
            picture: its name.
            subject: who looked.
        """
        width, height = (int(side) for side in self.grid.extent)
        return Fixations(
            picture,
            subject,
            self.fixations.detach().double().cpu().numpy(),
            (width, height),
            target=None if self.target is None else self.classes[self.target],
            found=None if self.target is None else self.found,
        )


def trace(
    steps: Iterable[Step], grid: Grid, classes: tuple[str, ...], target: int | None, beside: Observer | None
) -> Scanpath:
    """The scanpath of one episode.

    Args:
        steps: of the episode, from `semfov.episode.rollout`.
        grid: the cells.
        classes: names of the classes, background first.
        target: class that is searched for; None for exploration.
        beside: observer that keeps a map of all classes; None where the episode's own belief is one.
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

"""The record of an episode: where the gaze went, what was seen and what was believed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import DirichletBelief, dirichlet_belief
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Observer
from semfov.decision import Decision
from semfov.detection.detections import Detections
from semfov.episode import Step


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
        beliefs: `(n, X·Y, K+1)`, Dirichlet parameters after each look.
        values: `(n, X·Y)`, acquisition values that the next fixation was chosen by.
        found: whether the search ended on its target.
        posterior: `(n, X·Y)`, probability of the target in each cell as the search believed it after each look; None
            for exploration.
        decision: what the search decided; None for exploration, and where the protocol ended it on a given box.
        seconds: what each look took, by stage (`semfov.episode.STAGES`).
    """

    grid: Grid
    classes: tuple[str, ...]
    target: int | None
    cells: Tensor
    fixations: Tensor
    detections: tuple[Detections, ...]
    beliefs: Tensor
    values: Tensor
    found: bool
    posterior: Tensor | None = None
    decision: Decision | None = None
    seconds: tuple[Mapping[str, float], ...] = ()

    def __len__(self) -> int:
        """Number of fixations, the start included."""
        return len(self.cells)

    @property
    def shifts(self) -> int:
        """Number of gaze shifts (saccades): fixations after the start."""
        return len(self) - 1


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
    cells, fixations, detections, beliefs, values, present, seconds = [], [], [], [], [], [], []
    known: DirichletBelief | None = None
    for step in steps:
        if beside is None:
            known = dirichlet_belief(step.belief)
        else:
            before = beside.start(1, grid, step.values) if known is None else known
            known = dirichlet_belief(beside(before, step.detections, step.fixation, grid))
        cells.append(step.cell)
        fixations.append(step.fixation)
        detections.append(step.detections)
        beliefs.append(known.beta[0])
        values.append(step.values[0])
        seconds.append(step.seconds)
        if target is not None:
            present.append(step.belief.probability(target)[0])
    return Scanpath(
        grid=grid,
        classes=classes,
        target=target,
        cells=torch.cat(cells),
        fixations=torch.cat(fixations),
        detections=tuple(detections),
        beliefs=torch.stack(beliefs),
        values=torch.stack(values),
        found=False,
        posterior=torch.stack(present) if present else None,
        seconds=tuple(seconds),
    )

"""The exploration protocol: which episodes there are, running them as tensors, and how much they get right."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from eval.config import ProtocolConfig
from eval.protocol import Searcher, generator_for, noise_for
from semfov import Detections, Grid
from semfov.agent import step
from semfov.belief.belief import dirichlet_belief
from semfov.data.scene import Annotation, Scenes


@dataclass(frozen=True)
class Exploration:
    """One exploration of a scene.

    Attributes:
        scene: index of the scene in its data set.
        repetition: which of the starts, from 0.
        start: cell of the first fixation.
    """

    scene: int
    repetition: int
    start: int


@dataclass(frozen=True)
class Progress:
    """What came of an exploration.

    Attributes:
        cells: fixated cells in order.
        right: after 0, 1, … gaze shifts, how many of the cells with objects are given the class of one of them: the
            published measure, where the most probable of all classes is the answer, background among them.
        right_without_background: the same, where the most probable class but background is the answer.
    """

    cells: tuple[int, ...]
    right: tuple[int, ...]
    right_without_background: tuple[int, ...]


def explorations_of(scenes: Scenes, index: int, cells: int, protocol: ProtocolConfig) -> list[Exploration]:
    """All explorations of a scene; starts differ from each other as long as there are enough cells."""
    generator = generator_for("start", protocol.seed, scenes.ids[index])
    rounds = -(-protocol.starts // cells)
    order = torch.cat([torch.randperm(cells, generator=generator) for _ in range(rounds)])
    return [Exploration(index, number, start) for number, start in enumerate(order[: protocol.starts].tolist())]


def explore_noise(scenes: Scenes, episode: Exploration, cells: int, protocol: ProtocolConfig) -> Tensor:
    """Random numbers that break an exploration's ties, `(shifts+1, X·Y)`; the same for every policy."""
    return noise_for(protocol, cells, scenes.ids[episode.scene], "exploration", episode.repetition)


def answers_of(annotation: Annotation, grid: Grid, components: int) -> Tensor:
    """Which classes are right for each cell, `(X·Y, K+1)` boolean: those of the objects that overlap it."""
    overlap = grid.footprint(annotation.boxes)
    classes = F.one_hot(annotation.labels, components)
    return overlap.T.float() @ classes.float() > 0


def count_right(beta: Tensor, answers: Tensor) -> Tensor:
    """Number of cells whose most probable class is an object's there, `(B,)`.

    A cell of which nothing is known has no most probable class: where classes are tied, the answer is wrong.

    Args:
        beta: `(B, X·Y, C)`, Dirichlet parameters, of all classes or of some.
        answers: `(X·Y, C)`, right classes of each cell.

    >>> beta = torch.tensor([[[0.5, 0.7], [0.9, 0.1], [0.5, 0.5]]])
    >>> count_right(beta, torch.tensor([[False, True]] * 3))
    tensor([1])
    """
    best = beta == beta.amax(-1, keepdim=True)
    return ((best & answers).any(-1) & (best.sum(-1) == 1)).sum(-1)


def run_explorations(
    episodes: Sequence[Exploration],
    explorer: Searcher,
    detections: Detections,
    grid: Grid,
    answers: Tensor,
    noise: Tensor,
    *,
    shifts: int,
    batch: int,
) -> list[Progress]:
    """Run explorations of one scene, `batch` at a time, until their gaze shifts are spent or no cell is left.

    Args:
        episodes: of one and the same scene.
        explorer: how they explore.
        detections: what is seen from every cell of the scene, a batch of X·Y.
        grid: the grid over the scene.
        answers: right classes of each cell (`answers_of`).
        noise: `(episodes, shifts+1, X·Y)`, from `explore_noise`.
        shifts: gaze shifts.
        batch: episodes in a tensor.
    """
    evidence = explorer.observer.weigh(detections, grid.centres, grid)
    starts = torch.tensor([episode.start for episode in episodes])
    progress: list[Progress] = []
    for cell, random in zip(starts.split(batch), noise.split(batch), strict=True):
        belief = explorer.observer.start(len(cell), grid, detections.scores)
        visited = torch.zeros(len(cell), len(grid), dtype=torch.bool)
        visits, right, without = [], [], []
        for shift in range(shifts + 1):
            # All episodes have made as many shifts, and so all run out of cells at once.
            if not (cell >= 0).all():
                right.append(right[-1])
                without.append(without[-1])
                continue
            visits.append(cell)
            acquisition = explorer.acquisition(None, grid, cell)
            after = step(explorer.observer, belief, visited, cell, evidence[cell], acquisition, random[:, shift])
            belief, visited, cell = after.belief, after.visited, after.cell
            beta = dirichlet_belief(belief).beta
            right.append(count_right(beta, answers))
            without.append(count_right(beta[..., 1:], answers[:, 1:]))
        tables = [torch.stack(columns, 1).tolist() for columns in (visits, right, without)]
        progress += [Progress(tuple(a), tuple(b), tuple(c)) for a, b, c in zip(*tables, strict=True)]
    return progress

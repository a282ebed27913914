"""The search protocol: which episodes there are, and running them as tensors."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from eval.config import ProtocolConfig
from semfov import Detections, Grid
from semfov.agent import step
from semfov.belief import Observer
from semfov.data.scene import Scenes
from semfov.gaze import Policy
from semfov.gaze.acquisition import AcquisitionFunction, SaliencyPrior, Static


@dataclass(frozen=True)
class Episode:
    """One search: a target class in a scene, from a start.

    Attributes:
        scene: index of the scene in its data set.
        target: class index, 1..K.
        cue: class that the searcher is told to look for, the target except in a control.
        repetition: which of the starts, from 0.
        start: cell of the first fixation.
        goal: cells that an object of the target class overlaps.
        commonest: whether the target is the scene's class with most instances (the first of them by index).
    """

    scene: int
    target: int
    cue: int
    repetition: int
    start: int
    goal: tuple[int, ...]
    commonest: bool


@dataclass(frozen=True)
class Searcher:
    """How to search: what looks are taken to say, and where to look next.

    Attributes:
        observer: turns looks into belief.
        policy: makes the acquisition function for a target.
        saliency: `(X·Y, X·Y)`, saliency of all cells seen from each cell, or `(1, X·Y)`.
        weight: of the saliency as a prior over the cells (`SaliencyPrior`); None: saliency takes the policy's place.
    """

    observer: Observer
    policy: Policy
    saliency: Tensor | None = None
    weight: float | None = None

    def acquisition(self, target: int | Tensor | None, grid: Grid, cell: Tensor) -> AcquisitionFunction:
        """The acquisition function of episodes that fixate `cell` `(B,)`."""
        if self.saliency is None:
            return self.policy(target, grid)
        salient = self.saliency[cell if len(self.saliency) > 1 else torch.zeros_like(cell)]
        return (
            Static(salient)
            if self.weight is None
            else SaliencyPrior(self.policy(target, grid), salient, weight=self.weight)
        )


@dataclass(frozen=True)
class Outcome:
    """What came of an episode: the fixated cells in order, and the gaze shift that found the target, or -1."""

    cells: tuple[int, ...]
    found_at: int


def generator_for(*what: object) -> torch.Generator:
    """A generator seeded by what it is for, so that no episode's numbers depend on another's."""
    digest = hashlib.sha256(repr(what).encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)


def episodes_of(scenes: Scenes, index: int, columns: int, rows: int, protocol: ProtocolConfig) -> list[Episode]:
    """All episodes of one scene: every legal target, `starts` cells that no object of it overlaps.

    Starts differ from each other as long as there are enough cells.
    """
    annotation = scenes.annotation(index)
    labels, covered = annotation.labels, Grid(columns, rows, annotation.size).footprint(annotation.boxes)
    counts = torch.bincount(labels, minlength=1)
    targets = scenes.targets(index)
    commonest = max(targets, key=lambda t: (int(counts[t]), -t)) if targets else None
    episodes = []
    for target in targets:
        goal, cue = covered[labels == target].any(0), target
        if protocol.control == "permuted":
            goal = goal[
                torch.randperm(len(goal), generator=generator_for("goal", protocol.seed, scenes.ids[index], target))
            ]
        elif protocol.control == "wrong-class":
            others = [other for other in range(1, len(scenes.classes) + 1) if other != target]
            draw = generator_for("cue", protocol.seed, scenes.ids[index], target)
            cue = others[int(torch.randint(len(others), (1,), generator=draw))]
        free = (~goal).nonzero()[:, 0]
        if not len(free) or not goal.any():
            continue
        generator = generator_for("start", protocol.seed, scenes.ids[index], target)
        rounds = -(-protocol.starts // len(free))
        order = torch.cat([torch.randperm(len(free), generator=generator) for _ in range(rounds)])
        cells = tuple(goal.nonzero()[:, 0].tolist())
        episodes += [
            Episode(index, target, cue, repetition, start, cells, target == commonest)
            for repetition, start in enumerate(free[order[: protocol.starts]].tolist())
        ]
    return episodes


def tie_noise(scenes: Scenes, episode: Episode, cells: int, protocol: ProtocolConfig) -> Tensor:
    """Random numbers that break an episode's ties, `(shifts+1, X·Y)`; the same for every policy."""
    return noise_for(protocol, cells, scenes.ids[episode.scene], episode.target, episode.repetition)


def noise_for(protocol: ProtocolConfig, cells: int, *episode: object) -> Tensor:
    """Random numbers that break the ties of the episode that `episode` names, `(shifts+1, X·Y)`."""
    shape = protocol.shifts + 1, cells
    if protocol.ties == "first":
        return torch.linspace(1, 0, cells).expand(shape)
    return torch.rand(shape, generator=generator_for("ties", protocol.seed, *episode))


def run_episodes(
    episodes: Sequence[Episode],
    searcher: Searcher,
    detections: Detections,
    grid: Grid,
    noise: Tensor,
    *,
    shifts: int,
    batch: int,
) -> list[Outcome]:
    """Run episodes of one scene, `batch` at a time, each until its target is found or its gaze shifts are spent.

    Args:
        episodes: of one and the same scene.
        searcher: how they search.
        detections: what is seen from every cell of the scene, a batch of X·Y.
        grid: the grid over the scene.
        noise: `(episodes, shifts+1, X·Y)`, from `tie_noise`.
        shifts: most gaze shifts.
        batch: episodes in a tensor.
    """
    looks = Looks(searcher.observer, detections, grid, sorted({episode.cue for episode in episodes}))
    outcomes: list[Outcome] = []
    for first in range(0, len(episodes), batch):
        part = slice(first, first + batch)
        outcomes += _run_batch(episodes[part], searcher, looks, noise[part], shifts)
    return outcomes


class Looks:
    """What a look from every cell of a scene says, for the targets that are searched for in it.

    Args:
        observer: weighs the detections.
        detections: a batch of X·Y.
        grid: the grid over the scene.
        targets: classes, ascending.
    """

    def __init__(self, observer: Observer, detections: Detections, grid: Grid, targets: Sequence[int]) -> None:
        self.grid = grid
        self.like = detections.scores
        # One row of evidence for each cell, or for each target and cell.
        self._first = torch.zeros(max(targets) + 1, dtype=torch.long)
        if observer.by_target:
            self._first[list(targets)] = torch.arange(len(targets)) * len(grid)
            said = [observer.weigh(detections, grid.centres, grid, target) for target in targets]
            self._evidence = type(said[0]).join(said)
        else:
            self._evidence = observer.weigh(detections, grid.centres, grid)

    def __call__(self, targets: Tensor, cell: Tensor) -> Any:
        """Evidence of looks from cells `(B,)` by episodes that search for `targets` `(B,)`."""
        return self._evidence[self._first[targets] + cell]


def _run_batch(
    episodes: Sequence[Episode], searcher: Searcher, looks: Looks, noise: Tensor, shifts: int
) -> list[Outcome]:
    count, cells = len(episodes), len(looks.grid)
    goals = torch.zeros(count, cells, dtype=torch.bool)
    for row, episode in enumerate(episodes):
        goals[row, list(episode.goal)] = True
    cues = torch.tensor([episode.cue for episode in episodes])
    visits = torch.full((count, shifts + 1), -1)
    found_at = torch.full((count,), -1)
    observer = searcher.observer

    active = torch.arange(count)
    cell = torch.tensor([episode.start for episode in episodes])
    belief = observer.start(count, looks.grid, looks.like)
    visited = torch.zeros(count, cells, dtype=torch.bool)
    for shift in range(shifts + 1):
        visits[active, shift] = cell
        found = goals[active, cell]
        found_at[active[found]] = shift
        go_on = ~found
        if shift == shifts or not go_on.any():
            break
        active, cell, belief, visited = active[go_on], cell[go_on], belief[go_on], visited[go_on]
        wanted = cues[active]
        acquisition = searcher.acquisition(wanted, looks.grid, cell)
        after = step(observer, belief, visited, cell, looks(wanted, cell), acquisition, noise[active, shift])
        left = after.cell >= 0
        active, cell, belief, visited = active[left], after.cell[left], after.belief[left], after.visited[left]
    return [Outcome(tuple(row[row >= 0].tolist()), int(at)) for row, at in zip(visits, found_at, strict=True)]

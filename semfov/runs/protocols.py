"""The protocols of searches and explorations: the episodes of a scene, and their results."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic
from semfov.data.scene import Annotation, Scenes, legal_targets
from semfov.detection.detections import Detections
from semfov.episode import Looks, Step, StoredLooks, rollout
from semfov.gaze.choice import Greedy, drawn_from
from semfov.metrics.episodes import right_cells
from semfov.runs.config import ProtocolConfig
from semfov.runs.seeds import generator_for, noise_for
from semfov.strategy import Strategy


class Trial(NamedTuple):
    """One search for a target class in a scene."""

    scene: int
    target: int
    cue: int
    repetition: int
    start: int
    goal: tuple[int, ...]
    commonest: bool


_Outcome = tuple[list[int], int]
"""Result of an episode: the fixated cells in order, and the gaze shift that found the target (-1: none)."""


def episodes_of(
    scenes: Scenes, index: int, columns: int, rows: int, protocol: ProtocolConfig, targets: Sequence[int] | None = None
) -> list[Trial]:
    """All episodes of one scene: for every target `starts` searches from cells that no object of it overlaps."""
    annotation = scenes.annotation(index)
    labels, covered = annotation.labels, Grid(columns, rows, annotation.size).footprint(annotation.boxes)
    counts = torch.bincount(labels, minlength=1)
    targets = scenes.targets(index) if targets is None else targets
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
            Trial(index, target, cue, repetition, start, cells, target == commonest)
            for repetition, start in enumerate(free[order[: protocol.starts]].tolist())
        ]
    return episodes


def choose_classes(
    scenes: Scenes,
    index: int,
    annotation: Annotation,
    classes: int,
    max_area: float,
    seed: int,
    absent: int | None = None,
) -> list[int]:
    """Draw target classes for a photograph: some that it holds, and some that it does not hold."""
    generator = generator_for("classes", seed, scenes.ids[index])
    held = set(annotation.labels.tolist())
    legal = legal_targets(annotation, max_area)
    present = [legal[place] for place in torch.randperm(len(legal), generator=generator)[:classes].tolist()]
    others = [target for target in range(1, len(scenes.classes) + 1) if target not in held]
    count = len(present) if absent is None else absent
    return [*present, *(others[place] for place in torch.randperm(len(others), generator=generator)[:count].tolist())]


def numbers_drawn(scenes: Scenes, classes: int, max_area: float, absent: int | None = None) -> tuple[Tensor, Tensor]:
    """Count the searches for each class that `choose_classes` draws: where it is there, and where it is not, `(K,)`.

    The numbers are expected ones. Present classes are drawn from what a photograph holds, and absent ones evenly from
    all others, so that a search for a common class is mostly for one that is there.
    """
    kinds = len(scenes.classes)
    there, missing = torch.zeros(kinds, dtype=torch.float64), torch.zeros(kinds, dtype=torch.float64)
    for index in range(len(scenes)):
        annotation = scenes.annotation(index)
        legal = torch.tensor(legal_targets(annotation, max_area), dtype=torch.long)
        others = torch.ones(kinds, dtype=torch.bool)
        others[annotation.labels - 1] = False
        present = min(classes, len(legal))
        there[legal - 1] += present / max(len(legal), 1)
        wanted = present if absent is None else absent
        missing[others] += min(1.0, wanted / max(int(others.sum()), 1))
    return there, missing


class DrawnSearch(NamedTuple):
    """A search for a drawn class, which the photograph may hold; `spare` ones serve only some purposes of a fit."""

    target: int
    goal: Tensor  # (X·Y,)
    start: Tensor  # (1,)
    noise: Tensor  # (1, shifts+1, X·Y)
    spare: bool = False

    @property
    def present(self) -> bool:
        return bool(self.goal.any())


def choose_searches(
    scenes: Scenes,
    index: int,
    grid: Grid,
    protocol: ProtocolConfig,
    classes: int,
    max_area: float,
    absent: int | None = None,
) -> list[DrawnSearch]:
    """Draw searches of a photograph: their classes (`choose_classes`), first fixations and ties."""
    annotation, scene, seed = scenes.annotation(index), scenes.ids[index], protocol.seed
    covered = grid.footprint(annotation.boxes)
    return [
        DrawnSearch(
            target,
            covered[annotation.labels == target].any(0),
            torch.randint(len(grid), (1,), generator=generator_for("start", seed, scene, target)),
            noise_for(protocol, len(grid), scene, target, 0)[None],
        )
        for target in choose_classes(scenes, index, annotation, classes, max_area, seed, absent)
    ]


def run_episodes(
    episodes: Sequence[Trial], strategy: Strategy, looks: StoredLooks, noise: Tensor, *, shifts: int, batch: int
) -> list[_Outcome]:
    """Run episodes of one scene, each until its target is found or its shifts are spent; noise `(B, shifts+1, X·Y)`."""
    outcomes: list[_Outcome] = []
    for first in range(0, len(episodes), batch):
        part = slice(first, first + batch)
        outcomes += _run_batch(episodes[part], strategy, looks.of(part), noise[part], shifts)
    return outcomes


def _run_batch(
    episodes: Sequence[Trial], strategy: Strategy, looks: StoredLooks, noise: Tensor, shifts: int
) -> list[_Outcome]:
    grid = looks.grid
    goals = torch.zeros(len(episodes), len(grid), dtype=torch.bool)
    for row, episode in enumerate(episodes):
        goals[row, list(episode.goal)] = True
    cues = torch.tensor([episode.cue for episode in episodes])
    starts = torch.tensor([episode.start for episode in episodes])
    visits = torch.full((len(episodes), shifts + 1), -1)
    visits[:, 0] = starts
    found_at = torch.where(goals.gather(1, starts[:, None])[:, 0], 0, -1)
    # A search that starts on its target has ended before its first look.
    seeking = (found_at < 0).nonzero()[:, 0]
    if strategy.policy.function.by_belief:
        observer, source = strategy.observer, looks.of(seeking)
    else:
        # No look changes what the policy does, and most of the time would go into the belief.
        observer, source = Semantic(1), StoredLooks(Detections.empty(len(grid), 0, like=looks.like), grid)
    steps = rollout(
        source,
        observer,
        lambda order, cell: strategy.acquisition(cues[seeking[order]], grid, cell),
        starts[seeking],
        Greedy(drawn_from(noise[seeking])),
        most=shifts,
        ends=lambda step: goals[seeking[step.episodes], step.next_cell],
    )
    for step in steps:
        going = ~step.visited.all(-1)
        number, cell = seeking[step.episodes[going]], step.next_cell[going]
        visits[number, step.shift + 1] = cell
        found_at[number[goals[number, cell]]] = step.shift + 1
    return [(row[row >= 0].tolist(), int(at)) for row, at in zip(visits, found_at, strict=True)]


def search_steps(
    looks: Looks, strategy: Strategy, target: int, start: Tensor, noise: Tensor, rule: Callable[[Step], Tensor]
) -> list[Step]:
    """Run one search until it decides or all looks are spent; start `(1,)`, noise `(1, N, X·Y)`, rule `(1,)`."""
    policy, choice = strategy.policy(target, looks.grid), Greedy(drawn_from(noise))
    ends: Callable[[Step], Tensor] = lambda step: rule(step) > 0  # noqa: E731
    return list(rollout(looks, strategy.observer, policy, start, choice, most=noise.shape[1], ends=ends))


class Exploration(NamedTuple):
    """One exploration of a scene."""

    scene: int
    repetition: int
    start: int


def explorations_of(scenes: Scenes, index: int, cells: int, protocol: ProtocolConfig) -> list[Exploration]:
    """All explorations of a scene; their starts differ as long as there are enough cells."""
    generator = generator_for("start", protocol.seed, scenes.ids[index])
    rounds = -(-protocol.starts // cells)
    order = torch.cat([torch.randperm(cells, generator=generator) for _ in range(rounds)])
    return [Exploration(index, number, start) for number, start in enumerate(order[: protocol.starts].tolist())]


def run_explorations(
    episodes: Sequence[Exploration],
    strategy: Strategy,
    looks: StoredLooks,
    answers: Tensor,
    noise: Tensor,
    *,
    shifts: int,
    batch: int,
) -> list[tuple[list[int], dict[str, list[int]]]]:
    """Run explorations until their gaze shifts are spent or no cell is left; noise `(episodes, shifts+1, X·Y)`."""
    starts, progress = torch.tensor([episode.start for episode in episodes]), []
    for start, random in zip(starts.split(batch), noise.split(batch), strict=True):
        visits, counts = [], []
        steps = rollout(
            looks,
            strategy.observer,
            lambda _, cell: strategy.acquisition(None, looks.grid, cell),
            start,
            Greedy(drawn_from(random)),
            most=shifts + 1,
        )
        for step in steps:
            visits.append(step.cell)
            counts.append(counts_of(step.belief.class_probabilities(), answers))
        # All episodes have made the same number of shifts and run out of cells together: nothing changes after that.
        counts += [counts[-1]] * (shifts + 1 - len(counts))
        tables = {name: torch.stack([each[name] for each in counts], 1).tolist() for name in counts[0]}
        rows = [dict(zip(tables, row, strict=True)) for row in zip(*tables.values(), strict=True)]
        progress += list(zip(torch.stack(visits, 1).tolist(), rows, strict=True))
    return progress


def counts_of(probabilities: Tensor, answers: Tensor) -> dict[str, Tensor]:
    """Numbers of right cells of maps `(B, X·Y, K+1)`, each `(B,)`."""
    everywhere = torch.cat([~answers.any(-1, keepdim=True), answers[:, 1:]], -1)
    return {
        "right": right_cells(probabilities, answers).sum(-1),
        "right_without_background": right_cells(probabilities[..., 1:], answers[:, 1:]).sum(-1),
        "right_everywhere": right_cells(probabilities, everywhere).sum(-1),
    }

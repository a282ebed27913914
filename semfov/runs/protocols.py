"""The protocols of searches and explorations: the episodes of a scene, and their results."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Observer, Semantic
from semfov.data.scene import Annotation, Scenes, legal_targets
from semfov.detection.detections import Detections
from semfov.episode import StoredLooks, rollout
from semfov.gaze.choice import Greedy, drawn_from
from semfov.runs.config import ProtocolConfig
from semfov.runs.seeds import generator_for, noise_for
from semfov.strategy import Strategy


class Trial(NamedTuple):
    """One search for a target class in a scene.

    Attributes:
        scene: number of the scene.
        target: class to find, 1..K.
        cue: class that the policy looks for; another one in the control `wrong-class`.
        repetition: number of the search for this target.
        start: cell of the first fixation.
        goal: cells that an object of the target overlaps.
        commonest: whether the scene holds the target most often.
    """

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
    scenes: Scenes,
    index: int,
    columns: int,
    rows: int,
    protocol: ProtocolConfig,
    targets: Sequence[int] | None = None,
) -> list[Trial]:
    """List all searches of one scene: `starts` for every target, from random cells without the target.

    Args:
        scenes: the scenes.
        index: number of the scene.
        columns: columns of the grid.
        rows: rows of the grid.
        protocol: number of starts, control condition and seed.
        targets: classes to search for (None: those that the scenes allow).

    Returns:
        The searches.
    """
    annotation = scenes.annotation(index)
    labels = annotation.labels
    covered = Grid(columns, rows, annotation.size).footprint(annotation.boxes)
    targets = scenes.targets(index) if targets is None else targets
    counts = torch.bincount(labels, minlength=1)
    # Of classes with as many objects the first one counts as the commonest.
    commonest = max(targets, key=lambda target: (int(counts[target]), -target)) if targets else None
    episodes = []
    for target in targets:
        goal = covered[labels == target].any(0)
        if protocol.control == "permuted":
            draw = generator_for("goal", protocol.seed, scenes.ids[index], target)
            goal = goal[torch.randperm(len(goal), generator=draw)]
        cue = _wrong_class(scenes, index, target, protocol.seed) if protocol.control == "wrong-class" else target
        # A search starts beside its target, so that a target in every cell has none.
        free = (~goal).nonzero()[:, 0]
        if not len(free) or not goal.any():
            continue
        generator = generator_for("start", protocol.seed, scenes.ids[index], target)
        cells = tuple(goal.nonzero()[:, 0].tolist())
        starts = free[_in_rounds(len(free), protocol.starts, generator)].tolist()
        for repetition, start in enumerate(starts):
            episodes.append(Trial(index, target, cue, repetition, start, cells, target == commonest))
    return episodes


def _wrong_class(scenes: Scenes, index: int, target: int, seed: int) -> int:
    """Draw another class than the target."""
    others = [other for other in range(1, len(scenes.classes) + 1) if other != target]
    draw = generator_for("cue", seed, scenes.ids[index], target)
    return others[int(torch.randint(len(others), (1,), generator=draw))]


def _in_rounds(count: int, drawn: int, generator: torch.Generator) -> Tensor:
    """Draw so many of `count` numbers, each once before any is drawn again, `(drawn,)`."""
    rounds = -(-drawn // count)
    return torch.cat([torch.randperm(count, generator=generator) for _ in range(rounds)])[:drawn]


def choose_classes(
    scenes: Scenes,
    index: int,
    annotation: Annotation,
    classes: int,
    max_area: float,
    seed: int,
    absent: int | None = None,
) -> list[int]:
    """Choose target classes for a photograph at random: some that it holds, and some that it does not.

    Args:
        scenes: the photographs.
        index: number of the photograph.
        annotation: its objects.
        classes: largest number of classes that it holds.
        max_area: share of the image from which on a class is too large to be searched for.
        seed: seed of the draw.
        absent: largest number of classes that it does not hold (None: as many as it holds). A draw with a larger
            number begins with the same classes.

    Returns:
        The classes, 1..K; those that it holds come first.
    """
    generator = generator_for("classes", seed, scenes.ids[index])
    legal = legal_targets(annotation, max_area)
    present = [legal[place] for place in torch.randperm(len(legal), generator=generator)[:classes].tolist()]
    # Of all classes, not only of those that may be searched for: a class that is too large is there, too.
    held = set(annotation.labels.tolist())
    others = [target for target in range(1, len(scenes.classes) + 1) if target not in held]
    count = len(present) if absent is None else absent
    missing = [others[place] for place in torch.randperm(len(others), generator=generator)[:count].tolist()]
    return [*present, *missing]


def numbers_drawn(scenes: Scenes, classes: int, max_area: float, absent: int | None = None) -> tuple[Tensor, Tensor]:
    """Compute the expected numbers of searches for each class that `choose_classes` draws.

    Present classes are drawn from what a photograph holds, and absent ones evenly from all others, so that a search for
    a common class is mostly for one that is there.

    Args:
        scenes: the photographs.
        classes: largest number of classes that a photograph holds.
        max_area: share of the image from which on a class is too large to be searched for.
        absent: largest number of classes that it does not hold (None: as many as it holds).

    Returns:
        The numbers where the class is there, and where it is not, each `(K,)`.
    """
    kinds = len(scenes.classes)
    there = torch.zeros(kinds, dtype=torch.float64)
    missing = torch.zeros(kinds, dtype=torch.float64)
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
    """A search for a drawn class, which the photograph may hold.

    Attributes:
        target: the class, 1..K.
        goal: `(X·Y,)` boolean, the cells that an object of it overlaps.
        start: `(1,)`, cell of the first fixation.
        noise: `(1, shifts+1, X·Y)`, by which ties are broken.
        spare: whether the search serves only some purposes of a fit.
    """

    target: int
    goal: Tensor
    start: Tensor
    noise: Tensor
    spare: bool = False

    @property
    def present(self) -> bool:
        """Whether the photograph holds the class."""
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
    """Draw searches of a photograph: their classes (`choose_classes`), first fixations and ties.

    Args:
        scenes: the photographs.
        index: number of the photograph.
        grid: the cells.
        protocol: number of shifts, and seed.
        classes: largest number of classes that the photograph holds.
        max_area: share of the image from which on a class is too large to be searched for.
        absent: largest number of classes that it does not hold (None: as many as it holds).

    Returns:
        The searches.
    """
    annotation = scenes.annotation(index)
    scene = scenes.ids[index]
    covered = grid.footprint(annotation.boxes)
    searches = []
    for target in choose_classes(scenes, index, annotation, classes, max_area, protocol.seed, absent):
        goal = covered[annotation.labels == target].any(0)
        generator = generator_for("start", protocol.seed, scene, target)
        start = torch.randint(len(grid), (1,), generator=generator)
        searches.append(DrawnSearch(target, goal, start, noise_for(protocol, len(grid), scene, target, 0)[None]))
    return searches


def run_episodes(
    episodes: Sequence[Trial],
    strategy: Strategy,
    looks: StoredLooks,
    noise: Tensor,
    *,
    shifts: int,
    batch: int,
) -> list[_Outcome]:
    """Run searches of one scene, each until its target is found or its shifts are spent.

    The target is found when the gaze is on a cell of `Trial.goal`, whatever the belief says: the paper's oracle.

    Args:
        episodes: B searches.
        strategy: the observer, and the policy that chooses fixations.
        looks: the looks from every cell, for each search.
        noise: `(B, shifts+1, X·Y)`, by which ties are broken.
        shifts: largest number of gaze shifts.
        batch: number of searches that run side by side.

    Returns:
        For each search the fixated cells, and the gaze shift that found the target (-1: none).
    """
    outcomes: list[_Outcome] = []
    for first in range(0, len(episodes), batch):
        part = slice(first, first + batch)
        outcomes += _run_batch(episodes[part], strategy, looks.of(part), noise[part], shifts)
    return outcomes


def _run_batch(
    episodes: Sequence[Trial], strategy: Strategy, looks: StoredLooks, noise: Tensor, shifts: int
) -> list[_Outcome]:
    """Run searches side by side; the arguments are those of `run_episodes`."""
    grid = looks.grid
    goals = torch.zeros(len(episodes), len(grid), dtype=torch.bool)
    for row, episode in enumerate(episodes):
        goals[row, list(episode.goal)] = True
    cues = torch.tensor([episode.cue for episode in episodes])
    starts = torch.tensor([episode.start for episode in episodes])
    visits = torch.full((len(episodes), shifts + 1), -1)
    visits[:, 0] = starts
    found_at = torch.where(goals.gather(1, starts[:, None])[:, 0], 0, -1)
    # A search that starts on its target has ended before its first look. Steps count the others only.
    seeking = (found_at < 0).nonzero()[:, 0]
    observer, source = _observation(strategy, looks, seeking)
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
        number = seeking[step.episodes[going]]
        cell = step.next_cell[going]
        visits[number, step.shift + 1] = cell
        found_at[number[goals[number, cell]]] = step.shift + 1
    return [(row[row >= 0].tolist(), int(shift)) for row, shift in zip(visits, found_at, strict=True)]


def _observation(strategy: Strategy, looks: StoredLooks, seeking: Tensor) -> tuple[Observer, StoredLooks]:
    """Return the observer and the looks of some searches, `(n,)`; both empty for policies that ignore the belief."""
    if strategy.policy.function.by_belief:
        return strategy.observer, looks.of(seeking)
    # No look changes what the policy does, and most of the time would go into the belief.
    nothing = Detections.empty(len(looks.grid), 0, like=looks.like)
    return Semantic(1), StoredLooks(nothing, looks.grid)


class Exploration(NamedTuple):
    """One exploration of a scene.

    Attributes:
        scene: number of the scene.
        repetition: number of the exploration of the scene.
        start: cell of the first fixation.
    """

    scene: int
    repetition: int
    start: int


def explorations_of(scenes: Scenes, index: int, cells: int, protocol: ProtocolConfig) -> list[Exploration]:
    """Draw all explorations of a scene; their starts differ as long as there are enough cells.

    Args:
        scenes: the scenes.
        index: number of the scene.
        cells: number of cells.
        protocol: number of starts, and seed.

    Returns:
        The explorations.
    """
    generator = generator_for("start", protocol.seed, scenes.ids[index])
    starts = _in_rounds(cells, protocol.starts, generator).tolist()
    return [Exploration(index, number, start) for number, start in enumerate(starts)]

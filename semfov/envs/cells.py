"""Gazes that move from cell to cell: searches and explorations with a fovea."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.observers import Look, Observer, Semantic
from semfov.detection.detections import Detections
from semfov.envs.gazes import Gazes
from semfov.envs.scenery import Scenery
from semfov.episode import EpisodeLook, Looks, StoredLooks
from semfov.episode.loop import attend
from semfov.episode.memory import Memory
from semfov.episode.stopwatch import Stopwatch
from semfov.errors import check, check_whole
from semfov.metrics.episodes import right_cells
from semfov.paths import Scanpath
from semfov.paths.stimulus import Stimulus, reduced_copy
from semfov.paths.trace import Trace
from semfov.viz.animation import render
from semfov.viz.look import plot_fixation

_FIRST = torch.tensor([0])


class _SceneLooks(Looks):
    """Stored looks (`semfov.episode.StoredLooks`) in several scenes; each is opened when an episode first enters it."""

    def __init__(self, open_scene: Callable[[int], StoredLooks], observer: Observer, episodes: int) -> None:
        self._open, self._observer = open_scene, observer
        self._scenes: dict[int, StoredLooks] = {}
        self._starts: dict[int, tuple[int, int]] = {}
        self._table: Look | None = None
        self._every_look: Detections | None = None
        # For each episode, the rows of the look from cell 0: in the table, and in the detections.
        self._row, self._place = torch.zeros(2, episodes, dtype=torch.int64)

    def enter(self, episodes: Tensor, scenes: Sequence[int], targets: Tensor | None) -> None:
        """Move episodes to other scenes; episodes `(n,)`, targets `(n,)`."""
        for scene in scenes:
            if scene in self._scenes:
                continue
            stored = self._open(scene)
            if not self._scenes:
                self.grid, self.like = stored.grid, stored.like
            before = sum(each.rows(self._observer) for each in self._scenes.values())
            self._starts[scene] = before, len(self._scenes) * len(self.grid)
            self._scenes[scene], self._table, self._every_look = stored, None, None
        rows = []
        for number, scene in enumerate(scenes):
            target = None if targets is None else targets[number]
            rows.append(self._starts[scene][0] + int(self._scenes[scene].first_row(self._observer, target)))
        self._row[episodes] = torch.tensor(rows)
        self._place[episodes] = torch.tensor([self._starts[scene][1] for scene in scenes])

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Read the looks at the cells from the table; the fixations are the centres of the cells."""
        watch = Stopwatch()
        if self._table is None:
            tables = [stored.weighed(self._observer) for stored in self._scenes.values()]
            self._table = tables[0] if len(tables) == 1 else type(tables[0]).join(tables)
        look = self._table[self._row[episodes] + cell]
        watch.lap("weigh")
        place = self._place[episodes] + cell
        return EpisodeLook(look, lambda: self._detections()[place], watch.seconds)

    def _detections(self) -> Detections:
        if self._every_look is None:
            self._every_look = Detections.stack([stored.detections for stored in self._scenes.values()])
        return self._every_look


class CellGazes(Gazes):
    """Episodes with a fovea that moves from cell to cell, each in a scene of its own, until a find or all cells."""

    coordinates = 2
    scenery: Scenery
    memory: Memory

    def __init__(self, scenery: Scenery, task: str, count: int = 1, *, together: bool = False, **options: Any) -> None:
        cells = scenery.shape[0] * scenery.shape[1]
        maps = () if task == "search" else (len(scenery.classes),)
        self.action_space = spaces.Discrete(cells)
        self.belief_space = spaces.Box(0, 1, (sum(maps or (1,)) + 2, *scenery.shape), np.float32)
        super().__init__(scenery, task, count, **options)
        self.observer: Observer = scenery.together if together else scenery.observer
        self.looks = _SceneLooks(scenery.open, self.observer, count)
        self.cell = torch.zeros(count, dtype=torch.int64)
        self.size = torch.zeros(count, 2)
        # The cells of the goal, or the right classes of all cells.
        self._right = torch.zeros(count, cells, *maps, dtype=torch.bool)
        self._trace: Trace | None = None  # of the first episode, where its pictures are wanted
        self._stimulus: Stimulus | None = None

    def choose(self, random: np.random.Generator, options: dict[str, Any]) -> Any:
        unknown, scenery = options.keys() - {"episode", "scene"}, self.scenery
        check(not unknown, "options", "episode or scene", ", ".join(sorted(unknown)))
        if "episode" in options:
            scene = getattr(options["episode"], "scene", None)
            fits = isinstance(scene, int) and 0 <= scene < len(scenery.pictures)
            check(fits, "episode", f"one of {type(scenery).__name__}.episodes", repr(options["episode"]))
            return options["episode"]
        if "scene" not in options:
            return scenery.draw(random)
        scene = options["scene"]
        check_whole(scene, "scene", 0, len(scenery.pictures) - 1)
        episodes = scenery.episodes(int(scene))
        check(len(episodes) > 0, "scene", "a scene with objects to look for", scene)
        return episodes[random.integers(len(episodes))]

    def action(self, action: Any) -> Tensor:
        expected = f"a whole number from 0 to {int(self.action_space.n) - 1}"
        check(self.action_space.contains(action), "action", expected, repr(action))
        return torch.tensor([int(action)])

    @torch.inference_mode()
    def planes(self, rows: Tensor) -> NDArray[np.float32]:
        """Planes of probabilities, of the fixated cells and of the cell of the gaze, `(n, C+2, Y, X)`."""
        visited, belief = self.memory.visited[rows], self._all_or(rows)
        here = torch.zeros_like(visited).scatter(1, self.cell[rows, None], True)
        if self.searching:  # if no fixated cell holds the target
            maps = belief.chance(self.targets[rows]).masked_fill(visited, 0.0)[:, None]
        else:
            maps = belief.class_probabilities().mT
        more = torch.stack([visited, here], 1).float()
        return torch.cat([maps.float().clamp(0, 1), more], 1).numpy().reshape(len(rows), -1, *self.scenery.shape)

    def places(self, rows: Tensor) -> Tensor:
        lines, columns = self.scenery.shape
        cell = self.cell[rows]
        return torch.stack([(cell % columns + 0.5) / columns, (cell // columns + 0.5) / lines], -1)

    def points(self, rows: Tensor) -> Tensor:
        """Fixated points `(n, 2)` in pixels of the scenes."""
        return self.places(rows) * self.size[rows] - 0.5

    def mask(self, rows: Tensor) -> NDArray[np.bool_]:
        return (~self.memory.visited[rows]).numpy()

    def detections(self, rows: Tensor) -> Detections:
        return self.looks.see(self.observer, rows, self.cell[rows], self.points(rows)).detections()

    def draw(self) -> NDArray[np.uint8]:
        """Picture of the last look of the first episode: the scanpath, the foveated view, and the belief."""
        scenery, episode, boxes = self.scenery, self.episodes[0], None
        if self._stimulus is None:
            self._stimulus = Stimulus.of(scenery.eye, scenery.image(episode.scene))
        if self.searching:
            objects = scenery.annotation(episode.scene)
            boxes = objects.boxes[objects.labels == episode.target]
        path = self.scanpath()
        view = self._stimulus.views(path.fixations[-1:])[0]
        image = reduced_copy(scenery.image(episode.scene)).float() / 255
        return render([plot_fixation(path, -1, image, view, boxes=boxes)])[0]

    def scanpath(self) -> Scanpath:
        """Make the record of the looks of the first episode, which are kept for pictures."""
        assert self._trace is not None
        with torch.inference_mode():
            return self._trace.scanpath()

    def _new_trace(self) -> Trace:
        """Make the trace of the first episode, before its first look."""
        episode = self.episodes[0]
        grid, classes = self.scenery.grid(episode.scene), self.scenery.classes
        if not self.searching:
            return Trace(grid, classes, None, None)
        # A belief about the target has no other classes. A scanpath needs them, but the picture of a search does not.
        return Trace(grid, classes, episode.cue, Semantic(len(classes)))

    @torch.inference_mode()
    def begin(self, rows: Tensor, episodes: Sequence[Any]) -> None:
        super().begin(rows, episodes)
        scenes = [episode.scene for episode in episodes]
        if self.searching:
            self.targets[rows] = torch.tensor([episode.cue for episode in episodes])
            goal = torch.zeros(len(rows), self._right.shape[1], dtype=torch.bool)
            for number, episode in enumerate(episodes):
                goal[number, list(episode.goal)] = True
            self._right[rows] = goal
        else:
            self._right[rows] = torch.stack([self.scenery.answers(scene) for scene in scenes])
        self.looks.enter(rows, scenes, self.targets[rows] if self.searching else None)
        self.size[rows] = torch.stack([self.scenery.grid(scene).extent for scene in scenes])
        self.cell[rows] = torch.tensor([episode.start for episode in episodes])
        self._trace = self._new_trace() if self.pictures else None
        self._stimulus = None
        self._see(rows, rows, Memory.empty(self.looks, self.observer, len(rows)))

    @torch.inference_mode()
    def _look(self, rows: Tensor, actions: Tensor) -> Tensor:
        fresh = ~self.memory.visited[rows, actions]
        self.cell[rows] = actions
        new = rows[fresh]
        self._see(rows, new, self.memory if len(new) == len(self.episodes) else self.memory[new])
        return self.result[rows] == 1 if self.searching else self.memory.visited[rows].all(-1)

    def _see(self, rows: Tensor, new: Tensor, memory: Memory) -> None:
        """Look in the rows `new`, whose state is `memory`, rate all rows, and keep the last look of the first one."""
        if len(new):
            memory = attend(self.looks, self.observer, memory, new, self.cell[new], self.points(new))[1]
            self.memory = memory if len(new) == len(self.episodes) else self.memory.put(new, memory)
        right = self._right[rows]
        if self.searching:
            self.result[rows] = right[torch.arange(len(rows)), self.cell[rows]].float()
        else:
            hits = right_cells(self._all_or(rows).class_probabilities(), right).sum(-1)
            self.result[rows] = hits / right.any(-1).sum(-1)
        if self._trace is not None:
            # Actions are chosen without values, and stored looks have no times.
            values = torch.zeros(1, self.memory.visited.shape[1])
            self._trace.fixate(
                self.cell[:1].clone(), self.points(_FIRST), self.detections(_FIRST), self._all_or(_FIRST), values, {}
            )

    def _view(self, row: int) -> Tensor:
        view = self.scenery.view(self.episodes[row].scene)
        left, top = view.placement.offset
        wide, high = (round(n * s) for n, s in zip(view.placement.size, view.placement.scale, strict=True))
        point = self.points(torch.tensor([row]))
        return self.scenery.eye.pictures(view, point)[..., top : top + high, left : left + wide]

    def _all_or(self, rows: Tensor) -> Belief:
        """Take the belief of some rows, without a copy where these are all."""
        return self.memory.belief if len(rows) == len(self.episodes) else self.memory.belief[rows]

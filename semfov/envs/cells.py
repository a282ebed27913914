"""Gazes that move from cell to cell: searches and explorations with a fovea.

All looks that an episode can make are stored, so that a gaze shift reads a row of a table:

     scene ──first entered──► stored looks ──weighed by the observer──► table of evidence ──row + cell──► belief
                                           └──────────────────────────► table of detections ──row + cell──► infos
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.observers import Evidence, Observer, Semantic
from semfov.detection.detections import Detections
from semfov.envs.gazes import Gazes, GazeSettings, SavedGazes, scene_number
from semfov.envs.scenery import CellEpisode, Scenery
from semfov.episode import EpisodeLook, Looks, StoredLooks
from semfov.episode.loop import attend
from semfov.episode.memory import Memory
from semfov.episode.stopwatch import Stopwatch
from semfov.errors import InputError, check
from semfov.gaze.acquisition.base import Task
from semfov.metrics.episodes import right_cells
from semfov.paths import Scanpath
from semfov.paths.stimulus import Stimulus, reduced_copy
from semfov.paths.trace import Trace
from semfov.runs.protocols import Exploration, Trial
from semfov.viz.animation import render
from semfov.viz.look import plot_fixation

_FIRST = torch.tensor([0])


class _FirstRows(NamedTuple):
    """Rows at which a scene begins: in the table of evidence, and in the table of detections."""

    evidence: int
    detections: int


class _SceneLooks(Looks):
    """Stored looks (`semfov.episode.StoredLooks`) in several scenes; each is opened when an episode first enters it.

    Both tables hold the scenes one after another, as they were entered: the evidence with X·Y rows for each target of a
    scene, the detections with X·Y rows for each scene.

    Private attributes: `_scenes` has the looks of each scene that was entered, and `_first_rows` where they begin.
    `_evidence` and `_detections` are the tables; None until a look needs them after another scene was entered.
    `_evidence_row` and `_detections_row` `(B,)` have, for each episode, the rows of the look from cell 0.

    Invariant: scenes are only added, behind those before, so that the rows of episodes stay theirs.
    """

    def __init__(self, open_scene: Callable[[int], StoredLooks], observer: Observer, episodes: int) -> None:
        self._open = open_scene
        self._observer = observer
        self._scenes: dict[int, StoredLooks] = {}
        self._first_rows: dict[int, _FirstRows] = {}
        self._evidence: Evidence | None = None
        self._detections: Detections | None = None
        self._evidence_row = torch.zeros(episodes, dtype=torch.int64)
        self._detections_row = torch.zeros(episodes, dtype=torch.int64)

    def enter(self, episodes: Tensor, scenes: Sequence[int], targets: Tensor | None) -> None:
        """Move episodes to other scenes.

        Args:
            episodes: `(n,)`, numbers of the episodes.
            scenes: n numbers of scenes.
            targets: `(n,)`, classes 1..K that the episodes search for; None for explorations.
        """
        for scene in scenes:
            if scene not in self._scenes:
                self._append(scene)
        evidence_rows = []
        for number, scene in enumerate(scenes):
            target = None if targets is None else targets[number]
            target_row = int(self._scenes[scene].first_row(self._observer, target))
            evidence_rows.append(self._first_rows[scene].evidence + target_row)
        self._evidence_row[episodes] = torch.tensor(evidence_rows)
        self._detections_row[episodes] = torch.tensor([self._first_rows[scene].detections for scene in scenes])

    def _append(self, scene: int) -> None:
        """Open the looks at a scene, behind those of all other scenes."""
        looks = self._open(scene)
        if not self._scenes:
            self.grid = looks.grid
            self.like = looks.like
        evidence_rows = sum(entered.rows(self._observer) for entered in self._scenes.values())
        self._first_rows[scene] = _FirstRows(evidence_rows, len(self._scenes) * len(self.grid))
        self._scenes[scene] = looks
        # The tables lack the new scene, and are made again when they are read.
        self._evidence = None
        self._detections = None

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Read the looks at the cells from the tables; the fixations are the centres of the cells."""
        watch = Stopwatch()
        evidence = self._evidence_table()[self._evidence_row[episodes] + cell]
        watch.lap("weigh")
        rows = self._detections_row[episodes] + cell  # (n,)
        # Most steps need no detections, so that they are read only when they are asked for.
        return EpisodeLook(evidence, lambda: self._detections_table()[rows], watch.seconds)

    def _evidence_table(self) -> Evidence:
        """Weigh the looks of all scenes that were entered."""
        if self._evidence is None:
            tables = [looks.weighed(self._observer) for looks in self._scenes.values()]
            self._evidence = tables[0] if len(tables) == 1 else type(tables[0]).join(tables)
        return self._evidence

    def _detections_table(self) -> Detections:
        """Stack the detections of all scenes that were entered."""
        if self._detections is None:
            self._detections = Detections.stack([looks.detections for looks in self._scenes.values()])
        return self._detections


class _SavedLooks(NamedTuple):
    """What looks from cell to cell have shown: the fixated cells `(B,)`, the belief, and looks kept for pictures."""

    cell: Tensor
    memory: Memory
    trace: Trace | None


class CellGazes(Gazes[CellEpisode]):
    """Episodes with a fovea that moves from cell to cell, each in a scene of its own, until a find or all cells.

    Args:
        scenery: the scenes.
        task: `search` or `exploration`.
        settings: cost and reward of looks, and what observations contain.
        count: B, the number of episodes.
        pictures: whether the looks of the first episode are kept, so that they can be drawn.

    Attributes:
        observer: keeps the belief.
        looks: the looks at the scenes of the episodes.
        memory: the belief of all rows, and the cells that they have fixated.
        cell: `(B,)`, the fixated cells.
        size: `(B, 2)`, width and height of the scenes in pixels.

    Private attributes: `_right` has the cells of each row's goal, `(B, X·Y)` boolean, in explorations the right classes
    of all cells, `(B, X·Y, C)`. `_trace` has the looks of the first episode, None without pictures, and `_stimulus` its
    scene, None until it is drawn.

    Invariant: row b of all tensors is of episode b, whose fixated cell is among the visited ones after each look.
    """

    coordinates = 2
    action_space: spaces.Discrete
    scenery: Scenery
    memory: Memory

    def __init__(
        self,
        scenery: Scenery,
        task: Task,
        settings: GazeSettings,
        count: int = 1,
        *,
        pictures: bool = False,
    ) -> None:
        rows, columns = scenery.shape
        cells = rows * columns
        # A search has one plane of belief, of its target; an exploration has one of each class.
        classes = () if task == "search" else (len(scenery.classes),)
        belief_planes = 1 if task == "search" else len(scenery.classes)
        self.action_space = spaces.Discrete(cells)
        # Two more planes have the fixated cells and the cell of the gaze.
        self.belief_space = spaces.Box(0, 1, (belief_planes + 2, rows, columns), np.float32)
        super().__init__(scenery, task, settings, count)
        self.pictures = pictures
        self.observer = scenery.observer
        self.looks = _SceneLooks(scenery.open, self.observer, count)
        self.cell = torch.zeros(count, dtype=torch.int64)
        self.size = torch.zeros(count, 2)
        self._right = torch.zeros(count, cells, *classes, dtype=torch.bool)
        self._trace: Trace | None = None
        self._stimulus: Stimulus | None = None

    def choose(self, random: np.random.Generator, options: Mapping[str, object]) -> CellEpisode:
        unknown = options.keys() - {"episode", "scene"}
        check(not unknown, "options", "episode or scene", ", ".join(sorted(unknown)))
        if "episode" in options:
            return self._checked_episode(options["episode"])
        if "scene" not in options:
            return self.scenery.draw(random)
        scene = scene_number(options["scene"], self.scenery)
        episodes = self.scenery.episodes(scene)
        check(len(episodes) > 0, "scene", "a scene with objects to look for", scene)
        return episodes[random.integers(len(episodes))]

    def _checked_episode(self, episode: object) -> CellEpisode:
        """Check that an option of a reset is an episode of the task in one of the scenes."""
        kind = Trial if self.searching else Exploration
        if isinstance(episode, kind) and 0 <= episode.scene < len(self.scenery.pictures):
            return episode
        raise InputError(f"episode: expected one of {type(self.scenery).__name__}.episodes, got {episode!r}")

    def action(self, action: object) -> Tensor:
        cell = action.item() if isinstance(action, Tensor) and action.ndim == 0 else action
        # A boolean is a whole number in Python, and no cell.
        is_cell = not isinstance(cell, bool | np.bool_) and self.action_space.contains(cell)
        check(is_cell, "action", f"a whole number from 0 to {int(self.action_space.n) - 1}", repr(action))
        return torch.from_numpy(np.asarray(cell, dtype=np.int64).reshape(1))

    @torch.inference_mode()
    def planes(self, rows: Tensor) -> NDArray[np.float32]:
        """Planes of probabilities, of the fixated cells and of the cell of the gaze, `(n, C+2, Y, X)`."""
        visited = self.memory.visited[rows]  # (n, X·Y)
        belief = self._belief_of(rows)
        gaze = torch.zeros_like(visited).scatter(1, self.cell[rows, None], True)
        if self.searching:
            # A search ends at its target, so that no fixated cell holds it.
            maps = belief.chance(self.targets[rows]).masked_fill(visited, 0.0)[:, None]  # (n, 1, X·Y)
        else:
            maps = belief.class_probabilities().mT  # (n, C, X·Y)
        cell_planes = torch.stack([visited, gaze], 1).float()  # (n, 2, X·Y)
        planes = torch.cat([maps.float().clamp(0, 1), cell_planes], 1)
        return planes.numpy().reshape(len(rows), -1, *self.scenery.shape)

    def places(self, rows: Tensor) -> Tensor:
        """Compute the centres of the fixated cells, `(n, 2)`, x and y as fractions of width and height."""
        lines, columns = self.scenery.shape
        cell = self.cell[rows]
        return torch.stack([(cell % columns + 0.5) / columns, (cell // columns + 0.5) / lines], -1)

    def points(self, rows: Tensor) -> Tensor:
        """Compute the fixated points, `(n, 2)` in pixels of the scenes."""
        return self.places(rows) * self.size[rows] - 0.5

    def mask(self, rows: Tensor) -> NDArray[np.bool_]:
        return (~self.memory.visited[rows]).numpy()

    def detections(self, rows: Tensor) -> Detections:
        return self.looks.see(self.observer, rows, self.cell[rows], self.points(rows)).detections()

    def draw(self) -> NDArray[np.uint8]:
        """Picture of the last look of the first episode: the scanpath, the foveated view, and the belief."""
        scenery = self.scenery
        episode = self.episodes[0]
        if self._stimulus is None:
            self._stimulus = Stimulus.of(scenery.eye, scenery.image(episode.scene))
        boxes = None
        if isinstance(episode, Trial):
            objects = scenery.annotation(episode.scene)
            boxes = objects.boxes[objects.labels == episode.target]  # (M, 4)
        path = self.scanpath()
        view = self._stimulus.views(path.fixations[-1:])[0]
        image = reduced_copy(scenery.image(episode.scene)).float() / 255
        return render([plot_fixation(path, -1, image, view, boxes=boxes)])[0]

    def scanpath(self) -> Scanpath:
        """Make the record of the looks of the first episode, which are kept for pictures."""
        assert self._trace is not None
        with torch.inference_mode():
            return self._trace.scanpath()

    @torch.inference_mode()
    def begin(self, rows: Tensor, episodes: Sequence[CellEpisode]) -> None:
        super().begin(rows, episodes)
        self._enter(rows, episodes)
        self.cell[rows] = torch.tensor([episode.start for episode in episodes])
        self._stimulus = None
        self._trace = self._new_trace() if self.pictures else None
        self._see(rows, Memory.empty(self.looks, self.observer, len(rows)))
        self._rate(rows)
        self._extend_trace()

    def _enter(self, rows: Tensor, episodes: Sequence[CellEpisode]) -> None:
        """Take the scenes, the targets and the goals of episodes."""
        scenes = [episode.scene for episode in episodes]
        targets = None
        if self.searching:
            trials = [episode for episode in episodes if isinstance(episode, Trial)]
            targets = torch.tensor([trial.cue for trial in trials])  # (n,)
            self.targets[rows] = targets
            self._right[rows] = _goals(trials, self._right.shape[1])
        else:
            self._right[rows] = torch.stack([self.scenery.answers(scene) for scene in scenes])  # (n, X·Y, C)
        self.looks.enter(rows, scenes, targets)
        self.size[rows] = torch.stack([self.scenery.grid(scene).extent for scene in scenes])

    def check_saved(self, saved: SavedGazes) -> None:
        if self.pictures and saved.looks.trace is None:
            raise InputError("state: expected one of an environment with `render_mode=`, got one without")

    @torch.inference_mode()
    def _saved_looks(self) -> _SavedLooks:
        return _SavedLooks(self.cell.clone(), self.memory, copy.deepcopy(self._trace))

    @torch.inference_mode()
    def _restore_looks(self, looks: _SavedLooks) -> None:
        self._enter(torch.arange(self.count), self.episodes)
        self.cell = looks.cell.clone()
        self.memory = looks.memory
        self._stimulus = None
        self._trace = copy.deepcopy(looks.trace)

    @torch.inference_mode()
    def _look(self, rows: Tensor, actions: Tensor) -> Tensor:
        self.cell[rows] = actions
        # A cell that was fixated before tells nothing new.
        new = rows[~self.memory.visited[rows, actions]]
        if len(new):
            self._see(new, self.memory if self._are_all(new) else self.memory[new])
        self._rate(rows)
        self._extend_trace()
        return self.result[rows] == 1 if self.searching else self.memory.visited[rows].all(-1)

    def _see(self, rows: Tensor, memory: Memory) -> None:
        """Make one look in each of the rows `(n,)`, whose state before it is `memory`."""
        _, memory = attend(self.looks, self.observer, memory, rows, self.cell[rows], self.points(rows))
        self.memory = memory if self._are_all(rows) else self.memory.put(rows, memory)

    def _rate(self, rows: Tensor) -> None:
        """Compare the gaze of the rows `(n,)` with their goals, or their maps with the right classes."""
        right = self._right[rows]  # (n, X·Y) in a search, (n, X·Y, C) in an exploration
        if self.searching:
            self.result[rows] = right[torch.arange(len(rows)), self.cell[rows]].float()
        else:
            hits = right_cells(self._belief_of(rows).class_probabilities(), right).sum(-1)  # (n,)
            cells_with_objects = right.any(-1).sum(-1)
            self.result[rows] = hits / cells_with_objects

    def _new_trace(self) -> Trace:
        """Make the trace of the first episode, before its first look."""
        episode = self.episodes[0]
        grid = self.scenery.grid(episode.scene)
        classes = self.scenery.classes
        if not isinstance(episode, Trial):
            return Trace(grid, classes, None, None)
        # A belief about the target has no other classes. A scanpath needs them, but the picture of a search does not.
        return Trace(grid, classes, episode.cue, Semantic(len(classes)))

    def _extend_trace(self) -> None:
        """Keep the last look of the first episode, where its pictures are wanted."""
        if self._trace is None:
            return
        # Actions are chosen without values, and stored looks have no times.
        values = torch.zeros(1, self.memory.visited.shape[1])
        cell = self.cell[:1].clone()
        self._trace.fixate(
            cell, self.points(_FIRST), self.detections(_FIRST), self._belief_of(_FIRST), values, stages={}
        )

    def _view(self, row: int) -> Tensor:
        view = self.scenery.view(self.episodes[row].scene)
        canvas = self.scenery.eye.pictures(view, self.points(torch.tensor([row])))
        return view.placement.cut_out(canvas)

    def _belief_of(self, rows: Tensor) -> Belief:
        """Take the belief of some rows, without a copy where these are all."""
        return self.memory.belief if self._are_all(rows) else self.memory.belief[rows]

    def _are_all(self, rows: Tensor) -> bool:
        """Whether rows are all rows, so that their state needs no copy."""
        return len(rows) == self.count


def _goals(trials: Sequence[Trial], cells: int) -> Tensor:
    """Mark the cells of the goal of each search, `(n, X·Y)` boolean."""
    goals = torch.zeros(len(trials), cells, dtype=torch.bool)
    for number, trial in enumerate(trials):
        goals[number, list(trial.goal)] = True
    return goals

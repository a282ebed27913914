"""Looks from every cell of several scenes, in one table that a batch of episodes reads."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from semfov.belief.observers.base import Look, Observer
from semfov.detection.detections import Detections
from semfov.episode import Looks, Sight, Stopwatch, StoredLooks


class SceneLooks(Looks):
    """Stored looks (`semfov.episode.StoredLooks`) in several scenes; each is opened when an episode first enters it.

    Their evidence is one table for all scenes, so that a step of episodes in many scenes is a single gather.

    Args:
        open_scene: returns the stored looks in a scene, with all targets that are searched for in it.
        observer: weighs the looks.
        episodes: number of episodes at a time.
    """

    def __init__(self, open_scene: Callable[[int], StoredLooks], observer: Observer, episodes: int) -> None:
        self._open, self._observer = open_scene, observer
        self._scenes: dict[int, StoredLooks] = {}
        self._starts: dict[int, tuple[int, int]] = {}
        self._table: Look | None = None
        self._every_look: Detections | None = None
        # For each episode, the rows of the look from cell 0: in the table, and in the detections.
        self._row, self._place = torch.zeros(2, episodes, dtype=torch.int64)

    def enter(self, episodes: Tensor, scenes: Sequence[int], targets: Tensor | None) -> None:
        """Move episodes to other scenes.

        Args:
            episodes: `(n,)`, their numbers.
            scenes: scene of each.
            targets: `(n,)`, class that each searches for; None in explorations.
        """
        for scene in scenes:
            if scene not in self._scenes:
                self._add(scene)
        rows = []
        for number, scene in enumerate(scenes):
            target = None if targets is None else targets[number]
            rows.append(self._starts[scene][0] + int(self._scenes[scene].first_row(self._observer, target)))
        self._row[episodes] = torch.tensor(rows)
        self._place[episodes] = torch.tensor([self._starts[scene][1] for scene in scenes])

    def _add(self, scene: int) -> None:
        stored = self._open(scene)
        if not self._scenes:
            self.grid, self.like = stored.grid, stored.like
        places = len(self._scenes) * len(self.grid)
        rows = sum(each.rows(self._observer) for each in self._scenes.values())
        self._scenes[scene], self._starts[scene] = stored, (rows, places)
        self._table = self._every_look = None

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """Read the looks at the cells from the table; the fixations are the centres of the cells."""
        watch = Stopwatch()
        if self._table is None:
            tables = [stored.weighed(self._observer) for stored in self._scenes.values()]
            self._table = tables[0] if len(tables) == 1 else type(tables[0]).join(tables)
        look = self._table[self._row[episodes] + cell]
        watch.lap("weigh")
        place = self._place[episodes] + cell
        return Sight(look, lambda: self._detections()[place], watch.seconds)

    def _detections(self) -> Detections:
        if self._every_look is None:
            self._every_look = Detections.stack([stored.detections for stored in self._scenes.values()])
        return self._every_look

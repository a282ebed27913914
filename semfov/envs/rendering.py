"""Pictures of an episode in progress."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from semfov.belief.observers import Observer, Semantic
from semfov.envs.gazes import Gazes
from semfov.episode import Sight, Step
from semfov.experiments.search_protocol import Episode
from semfov.paths import Scanpath, Stimulus, trace
from semfov.viz.animation import render
from semfov.viz.fixation import plot_fixation


class Film:
    """The looks so far of the first episode of a batch.

    Args:
        gazes: the batch; its first episode has had its first look.
    """

    def __init__(self, gazes: Gazes) -> None:
        self.gazes = gazes
        self.steps: list[Step] = []
        episode = gazes.episodes[0]
        scenes = gazes.scenery.run.scenes
        self._boxes = None
        if isinstance(episode, Episode):
            objects = scenes.annotation(episode.scene)
            self._boxes = objects.boxes[objects.labels == episode.target]
        self._stimulus: Stimulus | None = None
        self.add()

    def add(self) -> None:
        """Keep the last look."""
        gazes, row = self.gazes, torch.tensor([0])
        seen, cell, point = gazes.seen(row), gazes.cell.clone(), gazes.points(row)
        sight = Sight(None, lambda: seen, {})  # type: ignore[arg-type]
        visited = gazes.memory.visited
        values = torch.zeros(visited.shape)
        step = Step(len(self.steps), row, cell, point, sight, gazes.belief, visited, values, cell, point, {})
        self.steps.append(step)

    def scanpath(self) -> Scanpath:
        """The looks so far as a scanpath."""
        gazes, episode = self.gazes, self.gazes.episodes[0]
        grid, classes = gazes.scenery.grid(episode.scene), gazes.scenery.classes
        searching = isinstance(episode, Episode)
        # A belief about the target has no other classes. A scanpath needs them, but the picture of a search does not.
        beside: Observer | None = Semantic(len(classes)) if searching else None
        with torch.inference_mode():
            return trace(self.steps, grid, classes, episode.cue if searching else None, beside)

    def draw(self) -> NDArray[np.uint8]:
        """Draw the last look, as RGB pixels `(H, W, 3)`."""
        gazes = self.gazes
        if self._stimulus is None:
            self._stimulus = Stimulus.of(gazes.scenery.run.eye, gazes.scenery.image(gazes.episodes[0].scene))
        path = self.scanpath()
        view = self._stimulus.views(path.fixations[-1:])[0]
        return render([plot_fixation(path, -1, self._stimulus.image, view, boxes=self._boxes)])[0]

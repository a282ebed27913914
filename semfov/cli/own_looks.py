"""Looks of a person with the eye and the belief of an agent, beside the looks that the agent chooses itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.belief.grid import Grid
from semfov.data.classes import class_index
from semfov.episode import LiveLooks, rollout
from semfov.gaze.choice import Given
from semfov.paths import GazeRecord, Scanpath, Stimulus, Trace, detections_in_words


@dataclass(frozen=True)
class OwnLooks:
    """The looks of a person, the cell that the agent would look at next, and its own looks from the same start."""

    record: Scanpath
    advice: int
    agent: GazeRecord

    @property
    def point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, where the agent would look next."""
        x, y = self.record.grid.centres[self.advice].tolist()
        return x, y

    def describe(self) -> str:
        """What the last look showed, what the belief is, and what the agent did, in lines of Markdown."""
        record, target = self.record, self.record.target_name
        seen = detections_in_words(record.looks[-1].detections, record.classes)
        assert record.presence is not None
        chances, (x, y) = record.presence.tolist(), self.point
        before = f", {chances[-2]:.2f} before it" if len(chances) > 1 else ""
        lines = [
            f"**Look {len(record)}** shows {seen}.",
            f"The probability that the picture holds “{target}” is {chances[-1]:.2f} after it{before}.",
            f"The agent would look next at ({x:.0f}, {y:.0f}): the orange ring.",
            f"The agent itself, from your first look and in as many looks: {self.agent.describe()}.",
        ]
        return "\n\n".join(lines)


def grid_of(agent: ActivePerception, image: Tensor) -> Grid:
    """The agent's cells over a picture `(3, H, W)`."""
    return Grid(agent.columns, agent.rows, (image.shape[-1], image.shape[-2]))


def look_at_cells(agent: ActivePerception, image: Tensor, target: str, cells: Sequence[int]) -> OwnLooks:
    """Look at given cells of a picture `(3, H, W)` one after the other, in a search for a target."""
    fovea, grid, index = agent.fovea, grid_of(agent, image), class_index(target, agent.classes[1:], "target")
    strategy, mapper = fovea.searching, fovea.exploring.observer
    with torch.inference_mode():
        looks = LiveLooks(agent.eye, agent.eye.open(image[None]), grid, index)
        beside = None if mapper is strategy.observer else mapper
        trace = Trace(grid, agent.classes, index, beside, agent.eye.detector.least)
        policy, order = strategy.policy(index, grid), torch.tensor([[*cells]])
        for step in rollout(looks, strategy.observer, policy, order[:, 0], Given(order), most=len(cells)):
            trace.add(step)
        step = trace.steps[-1]
        left = step.values[0].masked_fill(step.visited[0], -torch.inf)
        record = trace.scanpath(stimulus=Stimulus.of(agent.eye, image[None]))
        own = agent.search(image, target, how="fovea", start=cells[0], shifts=len(cells) - 1, closer=0)
    return OwnLooks(record, int(left.argmax()), own)

"""What a policy would value after each fixation of a person, had it looked where the person did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Look, Observer
from semfov.belief.observers.gathering import Gatherer
from semfov.detection.detections import Detections
from semfov.episode import Looks, Sight, Stopwatch, rollout
from semfov.experiments.candidates import Candidate
from semfov.experiments.store import SceneStore, looks_digest
from semfov.gaze.acquisition import Uniform
from semfov.gaze.choice import Given
from semfov.io.schema import Field, Schema

SOURCES = ("semfov.experiments.candidates", "semfov.gaze.policies", "semfov.gaze.saliency", "semfov.episode", __name__)
"""Modules that the maps depend on beside those of a look."""


class MapStore(SceneStore):
    """Values of the cells after each fixation of all people, one file for each picture.

    Args:
        folder: where the store lies.
        what: settings that they depend on.
        cells: X·Y.
    """

    def __init__(self, folder: Path, what: Mapping[str, object], cells: int) -> None:
        super().__init__(folder, what, looks_digest(*SOURCES), Schema({"values": Field(("E", cells))}))


class FineLooks(Looks):
    """Looks from the centres of coarse cells that a belief about finer cells is made of.

    Args:
        detections: what is seen from every coarse cell, a batch of them.
        grid: the coarse cells.
        fine: the cells of the belief.
    """

    def __init__(self, detections: Detections, grid: Grid, fine: Grid) -> None:
        self.detections, self.coarse, self.grid = detections, grid, fine
        self.like = detections.scores
        self._weighed: tuple[Observer, Look] | None = None

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """What is seen from the coarse cell that each fine cell's centre is in."""
        if self._weighed is None or self._weighed[0] is not observer:
            centres = self.coarse.centres.to(self.like)
            self._weighed = observer, observer.weigh(self.detections, centres, self.grid)
        row = self.coarse.cell_of(self.grid.centres[cell])
        return Sight(self._weighed[1][row], lambda: self.detections[row], Stopwatch().seconds)


def follow(looks: Looks, candidates: Mapping[str, Candidate], scanpaths: Sequence[Tensor]) -> dict[str, Tensor]:
    """Values `(E, X·Y)` of the cells after each fixation but the last of each scanpath, scanpath by scanpath.

    Where the gaze goes is given, so that policies which observe alike believe alike: one rollout serves all of them.

    Args:
        looks: what is seen.
        candidates: policies by name, whose observers are made alike.
        scanpaths: for each `(n,)`, cells that are fixated.
    """
    longest = max(map(len, scanpaths))
    padded = torch.stack([torch.cat([path, path[-1:].expand(longest - len(path))]) for path in scanpaths])
    observer = next(iter(candidates.values())).observer
    if isinstance(observer, Gatherer):
        # The batch is always that of all people, and so are the bits.
        observer.together = True
    tables: dict[str, list[Tensor]] = {name: [] for name in candidates}
    most = max(longest - 1, 1)
    for step in rollout(looks, observer, Uniform(), padded[:, 0], Given(padded), most=most):
        for name, candidate in candidates.items():
            tables[name].append(candidate.acquisition(None, looks.grid, step.cell)(step.belief, step.visited))
    rows = [(person, len(path) - 1) for person, path in enumerate(scanpaths)]
    stacked = {name: torch.stack(values, 1) for name, values in tables.items()}
    return {name: torch.cat([table[person, :count] for person, count in rows]) for name, table in stacked.items()}

"""Values that a policy gives to the cells after each fixation of a person, when it looks where the person looked."""

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
from semfov.gaze.acquisition import Uniform
from semfov.gaze.choice import Given
from semfov.io.schema import Field, Schema
from semfov.runs.candidates import Candidate
from semfov.runs.store import SceneStore, looks_digest

_SOURCES = ("semfov.runs.candidates", "semfov.gaze.policies", "semfov.gaze.saliency", "semfov.episode", __name__)
"""Modules that the maps depend on, in addition to those of a look."""


class MapStore(SceneStore):
    """Values of the cells after each fixation of all people, in one file for each picture.

    Args:
        folder: folder of the store.
        what: settings that the values depend on.
        cells: number of cells X·Y.
    """

    def __init__(self, folder: Path, what: Mapping[str, object], cells: int) -> None:
        super().__init__(folder, what, looks_digest(*_SOURCES), Schema({"values": Field(("E", cells))}))


class FineLooks(Looks):
    """Looks from the centres of coarse cells, for a belief about finer cells.

    Args:
        detections: detections from every coarse cell, as a batch.
        grid: the grid of coarse cells.
        fine: the grid of the belief.
    """

    def __init__(self, detections: Detections, grid: Grid, fine: Grid) -> None:
        self.detections, self.coarse, self.grid = detections, grid, fine
        self.like = detections.scores
        self._weighed: tuple[Observer, Look] | None = None

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """The look from the coarse cell in which the centre of each fine cell lies."""
        if self._weighed is None or self._weighed[0] is not observer:
            centres = self.coarse.centres.to(self.like)
            self._weighed = observer, observer.weigh(self.detections, centres, self.grid)
        row = self.coarse.cell_of(self.grid.centres[cell])
        return Sight(self._weighed[1][row], lambda: self.detections[row], Stopwatch().seconds)


def evaluate_along(looks: Looks, candidates: Mapping[str, Candidate], scanpaths: Sequence[Tensor]) -> dict[str, Tensor]:
    """Evaluate policies along given scanpaths.

    The scanpaths are given, so policies with the same kind of observer have the same belief: one rollout serves them
    all.

    Args:
        looks: the looks at the picture.
        candidates: policies by name; their observers have the same settings.
        scanpaths: for each scanpath `(n,)`, the fixated cells.

    Returns:
        For each policy `(E, X·Y)`, the values of the cells after each fixation except the last of each scanpath, one
        scanpath after the other.
    """
    longest = max(map(len, scanpaths))
    padded = torch.stack([torch.cat([path, path[-1:].expand(longest - len(path))]) for path in scanpaths])
    observer = next(iter(candidates.values())).observer
    if isinstance(observer, Gatherer):
        # The batch always consists of all people, so the bits of the result never change.
        observer.together = True
    tables: dict[str, list[Tensor]] = {name: [] for name in candidates}
    most = max(longest - 1, 1)
    for step in rollout(looks, observer, Uniform(), padded[:, 0], Given(padded), most=most):
        for name, candidate in candidates.items():
            tables[name].append(candidate.acquisition(None, looks.grid, step.cell)(step.belief, step.visited))
    rows = [(person, len(path) - 1) for person, path in enumerate(scanpaths)]
    stacked = {name: torch.stack(values, 1) for name, values in tables.items()}
    return {name: torch.cat([table[person, :count] for person, count in rows]) for name, table in stacked.items()}

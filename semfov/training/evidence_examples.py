"""Series of looks to learn search from: what each look showed of a target, and where the target really was."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from semfov.belief.grid import Grid
from semfov.belief.look_features import look_features
from semfov.data.scene import legal_targets
from semfov.experiments.samples import Sampler, Samples


@dataclass(frozen=True)
class Examples:
    """One example for each photograph and class to search for, with all looks at the photograph.

    Attributes:
        features: `(E, R, X·Y, F)`, of `look_features`.
        distance: `(E, R, X·Y)`, from each fixation to every cell, in longer sides.
        fixated: `(E, R)`, cell of each fixation.
        goal: `(E, X·Y)` boolean, cells that an object of the class overlaps.
        scene: `(E,)`, index of the photograph.
    """

    features: Tensor
    distance: Tensor
    fixated: Tensor
    goal: Tensor
    scene: Tensor

    def __len__(self) -> int:
        return len(self.scene)

    def __getitem__(self, index: Tensor) -> Examples:
        """Some of the examples."""
        return Examples(
            self.features[index], self.distance[index], self.fixated[index], self.goal[index], self.scene[index]
        )


def make_examples(
    sampler: Sampler, samples: Samples, columns: int, rows: int, min_objects: int, max_area: float
) -> Examples:
    """Examples from labelled detections and the annotations of their photographs."""
    looks = sampler.settings.fixations
    parts = []
    for index in tqdm(range(len(sampler.scenes)), desc="describing looks", unit="scene", dynamic_ncols=True):
        annotation = sampler.scenes.annotation(index)
        targets = legal_targets(annotation, max_area) if len(annotation.labels) >= min_objects else []
        if not targets:
            continue
        here = slice(index * looks, (index + 1) * looks)
        seen, fixations = samples.seen(here), samples.fixations[here]
        grid = Grid(columns, rows, annotation.size)
        distance = grid.distance(fixations)
        covered = grid.footprint(annotation.boxes)
        for target in targets:
            goal = covered[annotation.labels == target].any(0)
            if goal.any() and not goal.all():
                features = look_features(seen, fixations, grid, target)
                parts.append((features, distance, grid.cell_of(fixations), goal, torch.tensor(index)))
    return Examples(*(torch.stack(column) for column in zip(*parts, strict=True)))

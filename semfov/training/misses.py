"""Counting what the detector does not see."""

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes
from semfov.experiments.samples import Samples
from semfov.observation import MissCounts


def count_misses(
    photographs: Scenes, samples: Samples, scenes: set[int], edges: Tensor, columns: int = 10, rows: int = 10
) -> MissCounts:
    """Cells in which nothing was detected, over all looks at the given scenes (`MissCounts`)."""
    counts = torch.bincount(samples.look, minlength=len(samples.scenes)).tolist()
    misses = MissCounts(samples.scores.shape[-1], len(edges) + 1)
    for look, boxes in enumerate(samples.boxes.split(counts)):
        index = int(samples.scenes[look])
        if index not in scenes:
            continue
        annotation = photographs.annotation(index)
        grid = Grid(columns, rows, annotation.size)
        level = torch.bucketize(grid.distance(samples.fixations[look]), edges)
        detected = grid.footprint(boxes).any(0)
        misses.update(detected, grid.footprint(annotation.boxes), annotation.labels, level)
    return misses

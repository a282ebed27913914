"""Counting what the detector does not see."""

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.experiments.samples import Cells, Samples
from semfov.observation import MissCounts


def count_misses(photographs: Scenes, samples: Samples, scenes: set[int], edges: Tensor, cells: Cells) -> MissCounts:
    """Cells in which nothing was detected, over all looks at the given scenes (`MissCounts`).

    Args:
        photographs: that were looked at.
        samples: what was seen.
        scenes: indices of those that count.
        edges: between the levels of distance, or of magnification.
        cells: in which misses are counted.
    """
    counts = torch.bincount(samples.look, minlength=len(samples.scenes)).tolist()
    misses = MissCounts(samples.scores.shape[-1], len(edges) + 1)
    for look, boxes in enumerate(samples.boxes.split(counts)):
        index = int(samples.scenes[look])
        if index not in scenes:
            continue
        annotation = photographs.annotation(index)
        grid, distance, seen = cells(annotation.size, samples.fixations[look])
        level = torch.bucketize(distance, edges)[seen]
        detected, objects = grid.footprint(boxes).any(0), grid.footprint(annotation.boxes)
        misses.update(detected[seen], objects[:, seen], annotation.labels, level)
    return misses

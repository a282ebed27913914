"""Count the cells in which the detector misses objects."""

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.observation import MissCounts
from semfov.runs.samples import CellsOfLook, Samples


def count_misses(
    photographs: Scenes, samples: Samples, scenes: set[int], edges: Tensor, cells: CellsOfLook
) -> MissCounts:
    """Count cells without any detection over all looks at some photographs.

    Args:
        photographs: the photographs.
        samples: the labelled detections of the looks.
        scenes: indices of the photographs to count.
        edges: `(N-1,)`, borders between levels of distance, or of magnification.
        cells: gives the cells of each look in which misses are counted.

    Returns:
        The counts by class and level.
    """
    counts = torch.bincount(samples.look, minlength=len(samples.scenes)).tolist()
    misses = MissCounts(samples.scores.shape[-1], len(edges) + 1)
    for look, boxes in enumerate(samples.boxes.split(counts)):
        index = int(samples.scenes[look])
        if index not in scenes:
            continue
        annotation = photographs.annotation(index)
        grid, distance, in_view = cells(annotation.size, samples.fixations[look])
        level = torch.bucketize(distance, edges)[in_view]
        detected, objects = grid.footprint(boxes).any(0), grid.footprint(annotation.boxes)
        misses.update(detected[in_view], objects[:, in_view], annotation.labels, level)
    return misses

"""What a look shows of where to zoom in: hints, which are faint candidates too, and the strongest in each cell."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.zoom.lattice import Lattice

_FINEST = 32  # largest number of cells along a side of a gist
DETECTION_SCORE = 0.1  # score from which on a detection counts as a found object


class Hints(NamedTuple):
    """The hints of one look: boxes `(N, 4)` with class scores `(N, K)`, in no order; several may be of one object."""

    boxes: Tensor
    scores: Tensor


@dataclass(frozen=True)
class Gist:
    """The strongest hint of every class in each cell of a look, `(rows, columns, K)`, or in each square of cells."""

    level: int
    first: tuple[int, int]
    scale: int
    scores: Tensor
    size: Tensor
    found: Tensor

    @staticmethod
    def of(hints: Hints, detections: Detections, lattice: Lattice, action: tuple[int, int, int]) -> "Gist":
        """Compute the gist of a look at a window of the lattice; action `(level, column, row)`."""
        level, column, row = action
        span = lattice.span(level)
        scale = max(1, span // _FINEST)
        columns = -(-min(span, lattice.columns - column) // scale)
        rows = -(-min(span, lattice.rows - row) // scale)
        width, height = lattice.pitch
        numbers = (column * width, row * height), (width * scale, height * scale), (columns - 1, rows - 1)
        low, pitch, last = np.array(numbers, np.float32)
        kinds, cells = hints.scores.shape[-1], rows * columns
        boxes, scores = hints.boxes.float().numpy(), hints.scores.float()
        confident = scores.amax(-1)
        class_scores = detections.scores[0, :, 1:].detach().float().numpy()
        sure = (class_scores.max(1, initial=0) >= DETECTION_SCORE).nonzero()[0]
        corners = np.concatenate([boxes, detections.boxes[0].detach().float().numpy()[sure]])
        cell = ((corners[:, :2] + corners[:, 2:]) / 2 - low) / pitch
        across, down = np.minimum(np.maximum(cell, 0), last).astype(np.intp).T
        number = down * columns + across
        at, there = number[: len(boxes)], number[len(boxes) :]
        place = torch.from_numpy(at)
        strongest = scores.new_zeros(cells, kinds).scatter_reduce_(0, place[:, None].expand(-1, kinds), scores, "amax")
        top = confident.new_zeros(cells).scatter_reduce_(0, place, confident, "amax")
        leads = (confident.numpy() == top.numpy()[at]).nonzero()[0]
        wide, high = np.log2(np.maximum(boxes[leads, 2:] - boxes[leads, :2], 1e-3)).T
        size = np.zeros(cells, np.float32)
        size[at[leads]] = np.maximum((wide + high) / 2 + math.log2(lattice.magnifications[level]), 0)
        found = np.zeros((cells, kinds), np.bool_)
        found[there, class_scores[sure].argmax(1)] = True
        maps = (
            each.unflatten(0, (rows, columns)) for each in (strongest, torch.from_numpy(size), torch.from_numpy(found))
        )
        return Gist(level, (column, row), scale, *maps)

    @cached_property
    def best(self) -> Tensor:
        """Highest score of any class among the hints of each cell, `(rows, columns)`."""
        return self.scores.amax(-1)

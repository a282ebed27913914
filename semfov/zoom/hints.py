"""Hints of where to zoom in: all candidates of a look, also faint ones, and the strongest in each cell."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.zoom.lattice import Lattice

_MOST_CELLS = 32  # largest number of cells along a side of a gist
DETECTION_SCORE = 0.1  # score from which on a detection counts as a found object


class Hints(NamedTuple):
    """The hints of one look (candidates, also faint ones), unordered; one object may have several.

    Attributes:
        boxes: `(N, 4)`.
        scores: `(N, K)`, scores of the classes.
    """

    boxes: Tensor
    scores: Tensor


@dataclass(frozen=True)
class Gist:
    """The strongest hint of every class in each cell of a look, or in each square of cells.

    Attributes:
        level: level of the look's window.
        first: column and row of the first cell of the lattice that it covers.
        scale: cells of the lattice along a side of a cell of the gist.
        scores: `(rows, columns, K)`, strongest hints; 0 where there is none.
        size: `(rows, columns)`, logarithm (base 2) of the side of the strongest hint's box, in canvas pixels.
        found: `(rows, columns, K)` boolean, whether a detection of the class lies there.
    """

    level: int
    first: tuple[int, int]
    scale: int
    scores: Tensor
    size: Tensor
    found: Tensor

    @staticmethod
    def of(hints: Hints, detections: Detections, lattice: Lattice, action: tuple[int, int, int]) -> "Gist":
        """Compute the gist of a look: its strongest hint of every class in each cell.

        Args:
            hints: hints of the look.
            detections: its detections, a batch of one.
            lattice: the lattice.
            action: level, column and row of the window.

        Returns:
            The gist.
        """
        level, column, row = action
        cells = _GistCells.of_window(lattice, level, column, row)
        hint_boxes = hints.boxes.float().numpy()
        detection_boxes, labels = _found_objects(detections)
        # One call for the cells of both: most of its time does not depend on the number of boxes.
        numbers = cells.numbers_of(np.concatenate([hint_boxes, detection_boxes]))
        hint_cells = numbers[: len(hint_boxes)]
        detection_cells = numbers[len(hint_boxes) :]

        scores = hints.scores.float()
        kinds = scores.shape[-1]
        confidence = scores.amax(-1)
        place = torch.from_numpy(hint_cells)
        strongest = scores.new_zeros(cells.total, kinds)
        strongest.scatter_reduce_(0, place[:, None].expand(-1, kinds), scores, "amax")
        top = confidence.new_zeros(cells.total).scatter_reduce_(0, place, confidence, "amax")
        # By the scores, as in the fit: the confidence of the detector can rank otherwise.
        leads = np.flatnonzero(confidence.numpy() == top.numpy()[hint_cells])
        size = np.zeros(cells.total, np.float32)
        size[hint_cells[leads]] = _log_sides(hint_boxes[leads], lattice.magnifications[level])
        found = np.zeros((cells.total, kinds), np.bool_)
        found[detection_cells, labels] = True
        return Gist(
            level,
            (column, row),
            cells.scale,
            scores=strongest.unflatten(0, cells.shape),
            size=torch.from_numpy(size).unflatten(0, cells.shape),
            found=torch.from_numpy(found).unflatten(0, cells.shape),
        )

    def equals(self, other: "Gist") -> bool:
        """Tell whether another gist has the same hints in the same cells."""
        are_same_cells = (self.level, self.first, self.scale) == (other.level, other.first, other.scale)
        return (
            are_same_cells
            and torch.equal(self.scores, other.scores)
            and torch.equal(self.size, other.size)
            and torch.equal(self.found, other.found)
        )

    @cached_property
    def best(self) -> Tensor:
        """Highest score of any class among the hints of each cell, `(rows, columns)`."""
        return self.scores.amax(-1)


class _GistCells(NamedTuple):
    """The cells of a gist.

    Attributes:
        scale: cells of the lattice along a side of one.
        shape: rows and columns.
        origin: `(x, y)` of the first one in picture pixels.
        pitch: `(width, height)` of one in picture pixels.
    """

    scale: int
    shape: tuple[int, int]
    origin: tuple[float, float]
    pitch: tuple[float, float]

    @classmethod
    def of_window(cls, lattice: Lattice, level: int, column: int, row: int) -> "_GistCells":
        """Divide the part of a window inside the picture into at most `_MOST_CELLS` cells along a side."""
        span = lattice.span(level)
        scale = max(1, span // _MOST_CELLS)
        columns = -(-min(span, lattice.columns - column) // scale)
        rows = -(-min(span, lattice.rows - row) // scale)
        width, height = lattice.pitch
        return cls(scale, (rows, columns), (column * width, row * height), (width * scale, height * scale))

    @property
    def total(self) -> int:
        """Number of cells."""
        rows, columns = self.shape
        return rows * columns

    def numbers_of(self, boxes: NDArray[np.float32]) -> NDArray[np.intp]:
        """Find the cells of the centres of boxes `(N, 4)`, row by row; beyond the cells the nearest one; → `(N,)`."""
        rows, columns = self.shape
        # One array for all numbers: arrays this small spend their time in calls.
        origin, pitch, last = np.array([self.origin, self.pitch, (columns - 1, rows - 1)], np.float32)
        centres = (boxes[:, :2] + boxes[:, 2:]) / 2
        cells = (centres - origin) / pitch
        nearest = np.minimum(np.maximum(cells, 0), last)
        column, row = nearest.astype(np.intp).T
        return row * columns + column


def _found_objects(detections: Detections) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Take the boxes `(M, 4)` of detections that count as found objects, and their classes from 0 `(M,)`."""
    scores = detections.scores[0, :, 1:].detach().float().numpy()
    rows = np.flatnonzero(scores.max(1, initial=0) >= DETECTION_SCORE)
    boxes = detections.boxes[0].detach().float().numpy()[rows]
    return boxes, scores[rows].argmax(1)


def _log_sides(boxes: NDArray[np.float32], magnification: float) -> NDArray[np.float32]:
    """Compute the mean logarithms (base 2) of the sides of boxes `(N, 4)` in canvas pixels, from 0 on."""
    widths, heights = np.log2(np.maximum(boxes[:, 2:] - boxes[:, :2], 1e-3)).T
    return np.maximum((widths + heights) / 2 + math.log2(magnification), 0)

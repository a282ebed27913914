"""What a look at a window says of its cells: the strongest hint of every class in each."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.zoom.lattice import Lattice

FINEST = 32
"""Cells along a side of a gist, at most."""

FOUND = 0.1
"""Score of a detection, from which on its object counts as found."""


@dataclass(frozen=True)
class Gist:
    """A look at a window, cell by cell. Cells are those of the lattice, or squares of them where these are too fine.

    Attributes:
        level: of the window.
        first: `(column, row)` of the window's first cell on the lattice.
        scale: cells of the lattice along a side of a cell of the gist.
        scores: `(rows, columns, K)`, highest score of each class in a hint whose centre lies in the cell, 0 for none.
        size: `(rows, columns)`, logarithm (base 2) of the size in canvas pixels of the most confident hint, 0 for none.
        found: `(rows, columns, K)` boolean, classes of detections whose centre lies in the cell.
    """

    level: int
    first: tuple[int, int]
    scale: int
    scores: Tensor
    size: Tensor
    found: Tensor


def gist(hints: Detections, detections: Detections, lattice: Lattice, action: tuple[int, int, int]) -> Gist:
    """The gist of a look at a window of the lattice.

    Args:
        hints: of the look, a batch of one in picture pixels.
        detections: of the look, likewise.
        lattice: of the picture.
        action: level, column and row of the window.
    """
    level, column, row = action
    span = lattice.span(level)
    scale = max(1, span // FINEST)
    columns = -(-min(span, lattice.columns - column) // scale)
    rows = -(-min(span, lattice.rows - row) // scale)
    low = torch.tensor([column * lattice.pitch[0], row * lattice.pitch[1]])
    pitch = torch.tensor(lattice.pitch) * scale
    kinds = hints.scores.shape[-1] - 1

    def cells(boxes: Tensor) -> Tensor:
        place = (((boxes[:, :2] + boxes[:, 2:]) / 2 - low) / pitch).floor().long()
        return place[:, 1].clamp(0, rows - 1) * columns + place[:, 0].clamp(0, columns - 1)

    kept = hints.mask[0]
    boxes, scores = hints.boxes[0, kept], hints.scores[0, kept, 1:].float()
    at = cells(boxes)
    strongest = scores.new_zeros(rows * columns, kinds).scatter_reduce(0, at[:, None].expand(-1, kinds), scores, "amax")
    size = scores.new_zeros(rows * columns)
    order = scores.amax(-1).argsort() if len(scores) else at
    canvas = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3).log2().mean(-1)
    canvas = canvas + torch.tensor(lattice.magnifications[level]).log2()
    # Of several hints in a cell the last that is written stays: the most confident.
    for place, value in zip(at[order].tolist(), canvas[order].clamp(min=0).tolist(), strict=True):
        size[place] = value
    found = torch.zeros(rows * columns, kinds, dtype=torch.bool)
    sure = detections.mask[0] & (detections.confidence[0] >= FOUND)
    found[cells(detections.boxes[0, sure]), detections.labels[0, sure] - 1] = True
    shape = rows, columns
    return Gist(level, (column, row), scale, strongest.view(*shape, -1), size.view(shape), found.view(*shape, -1))

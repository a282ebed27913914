"""Figures of merit of scene exploration."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.scene import Annotation

Array = NDArray[np.float64]


def answers_of(annotation: Annotation, grid: Grid, components: int) -> Tensor:
    """Which classes are right for each cell, `(X·Y, K+1)` boolean: those of the objects that overlap it."""
    overlap = grid.footprint(annotation.boxes)
    classes = F.one_hot(annotation.labels, components)
    return overlap.T.float() @ classes.float() > 0


def count_right(beta: Tensor, answers: Tensor) -> Tensor:
    """Number of cells whose most probable class is an object's there, `(B,)`.

    A cell of which nothing is known has no most probable class: where classes are tied, the answer is wrong.

    Args:
        beta: `(B, X·Y, C)`, Dirichlet parameters, of all classes or of some.
        answers: `(X·Y, C)`, right classes of each cell.

    >>> import torch
    >>> beta = torch.tensor([[[0.5, 0.7], [0.9, 0.1], [0.5, 0.5]]])
    >>> count_right(beta, torch.tensor([[False, True]] * 3))
    tensor([1])
    """
    return right_cells(beta, answers).sum(-1)


def right_cells(beta: Tensor, answers: Tensor) -> Tensor:
    """Which cells `count_right` counts, `(B, X·Y)` boolean; arguments as there."""
    best = beta == beta.amax(-1, keepdim=True)
    return (best & answers).any(-1) & (best.sum(-1) == 1)


def success_rate(right: Sequence[int], cells: int) -> Array:
    """Share of the cells with objects whose class is right, after each gaze shift.

    >>> success_rate([1, 3, 4], 4)
    array([0.25, 0.75, 1.  ])
    """
    return np.asarray(right) / cells

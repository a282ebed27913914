"""Measures of scene exploration."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.scene import Annotation
from semfov.metrics.labels import as_outcomes

_Array = NDArray[np.float64]


def answers_of(annotation: Annotation, grid: Grid, components: int) -> Tensor:
    """The classes that are correct for each cell: those of the objects whose boxes overlap it; → `(X·Y, K+1)`."""
    overlap = grid.footprint(annotation.boxes)
    classes = F.one_hot(annotation.labels, components)
    return overlap.T.float() @ classes.float() > 0


def count_right(beta: Tensor, answers: Tensor) -> Tensor:
    """Number of cells whose most probable class is that of an overlapping object.

    A cell where several classes are tied for the most probable one counts as wrong, so a cell without information does.

    Shapes: beta `(B, X·Y, C)`, answers `(X·Y, C)` → `(B,)`.
    """
    return right_cells(beta, answers).sum(-1)


def right_cells(beta: Tensor, answers: Tensor) -> Tensor:
    """The cells whose most probable class is that of an overlapping object; `count_right` counts them.

    >>> import torch
    >>> right_cells(torch.tensor([[[0.5, 0.7], [0.5, 0.5]]]), torch.tensor([[False, True]] * 2))
    tensor([[ True, False]])

    Shapes: beta `(B, X·Y, C)`, answers `(X·Y, C)` → `(B, X·Y)`.
    """
    best = beta == beta.amax(-1, keepdim=True)
    # Sums of a short dimension take a seventh of the time of `any`.
    return ((best & as_outcomes(answers, "answers")).sum(-1) > 0) & (best.sum(-1) == 1)


def success_rate(right: Sequence[int], cells: int) -> _Array:
    """Fraction of the cells with objects whose most probable class is correct, after each gaze shift."""
    return np.asarray(right) / cells

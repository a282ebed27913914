"""The choice of the next fixation: the best cell not yet visited, ties broken at random."""

import torch
from torch import Tensor

from semfov.errors import check, check_shape, values_known


def select_fixation(values: Tensor, visited: Tensor, noise: Tensor, *, tolerance: float = 1e-6) -> Tensor:
    r"""Cell with the highest acquisition value among those not visited (inhibition of return).

    .. math:: f = \arg\max_{x \notin \mathcal V} a(x)

    Cells whose values equal the best to within `tolerance` (relative) are tied, and the one with the highest
    `noise` wins. A tolerance of a few rounding errors keeps equal beliefs tied, whatever the order of summation.

    Args:
        values: `(B, X·Y)`, acquisition values.
        visited: `(B, X·Y)` boolean, cells that were fixated and may not be chosen.
        noise: `(B, X·Y)`, random numbers in [0, 1) from each episode's own generator.
        tolerance: relative difference up to which values count as equal.

    Returns:
        `(B,)`, the chosen cell, or -1 where every cell has been visited.

    Raises:
        InputError: the shapes differ, or a cell that is not visited has the value NaN.

    >>> select_fixation(torch.tensor([[0.2, 0.9, 0.9]]), torch.tensor([[False, True, False]]), torch.rand(1, 3))
    tensor([2])
    """
    check_shape(values, "values", None, None)
    check_shape(visited, "visited", *values.shape)
    check_shape(noise, "noise", *values.shape)
    if values_known(values, visited):
        unusable = torch.isnan(values) & ~visited
        check(not bool(unusable.any()), "values", "numbers for all cells not visited", f"{int(unusable.sum())} NaN")
    choice = torch.where(best_cells(values, visited, tolerance), noise, -1.0).argmax(-1)
    return torch.where(visited.all(-1), -1, choice)


def best_cells(values: Tensor, visited: Tensor, tolerance: float = 1e-6) -> Tensor:
    """The cells that are tied for the highest value among those not visited, `(B, X·Y)`; see `select_fixation`."""
    open_values = values.masked_fill(visited, -torch.inf)
    best = open_values.amax(-1, keepdim=True)
    return (open_values >= best - tolerance * best.abs()) & ~visited

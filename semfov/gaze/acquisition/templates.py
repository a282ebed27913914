"""Attention to what is like the target, gathered over foveal looks."""

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import check, check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.closer_look import acuity


class TemplateAttention(AcquisitionFunction):
    r"""How like the target's template each cell is, by all looks so far, those from near counting more.

    .. math:: a(x) = \frac{\sum_{f \in \mathcal V} v(d(x, f)) \, M_t^f(x)}{\sum_{f \in \mathcal V} v(d(x, f))},
              \qquad v(d) = e^{-\max(d / r - 1,\, 0)}

    with :math:`M_t^f` the attention for the target of what the fovea shows from f (`semfov.gaze.ClassTemplates`), and
    :math:`\mathcal V` the fixated cells. It is IVSN (Zhang et al., 2018) "with foveal vision, extracting top-down
    characteristics along the way", as the outlook of Luzio, Bernardino and Moreno (2024) asks. How looks are weighed
    is our choice; v is that of `CloserLook`.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        attention: `(X·Y, K, X·Y)`, M of every class in every cell, seen from the centre of every cell.
        grid: the cells of one image.
        fovea: r in longer sides of the image.
    """

    target: Tensor
    attention: Tensor
    weight: Tensor

    def __init__(self, target: int | Tensor, attention: Tensor, grid: Grid, fovea: float = 100 / 640) -> None:
        super().__init__()
        check(fovea > 0, "fovea", "a positive number", fovea)
        check_shape(attention, "attention", len(grid), None, len(grid))
        wanted = torch.as_tensor(target)
        inside = bool(((wanted >= 1) & (wanted <= attention.shape[1])).all())
        check(inside, "target", f"classes from 1 to {attention.shape[1]}", wanted.tolist())
        self.register_buffer("target", wanted)
        self.register_buffer("attention", attention)
        self.register_buffer("weight", acuity(grid.cell_distance, fovea))

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)`; the belief has no part in them."""
        seen = self.attention.transpose(0, 1)[(self.target - 1).expand(len(visited))]
        return one_by_one(self._values, seen, visited.to(seen))

    def _values(self, seen: Tensor, visited: Tensor) -> Tensor:
        weight = visited[..., None] * self.weight.to(seen)
        return (weight * seen).sum(-2) / weight.sum(-2).clamp(min=torch.finfo(seen.dtype).tiny)

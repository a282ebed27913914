"""IVSN over foveal looks: attention to what resembles the target, and the search that follows it."""

import torch
from torch import Tensor

from eval.comparison.looking import Candidate
from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import check, check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.closer_look import acuity
from semfov.gaze.policies import Policy
from semfov.strategy import Strategy


class TemplateAttention(AcquisitionFunction):
    r"""Similarity of each cell to the target's template, averaged over all looks so far; near looks have more weight.

    .. math:: a(x) = \frac{\sum_{f \in \mathcal V} v(d(x, f)) \, M_t^f(x)}{\sum_{f \in \mathcal V} v(d(x, f))},
              \qquad v(d) = e^{-\max(d / r - 1,\, 0)}

    :math:`M_t^f` is the attention map for the target of the foveated image seen from f (`ClassTemplates`), and
    :math:`\mathcal V` are the fixated cells. This is IVSN (Zhang et al., 2018) "with foveal vision, extracting
    top-down characteristics along the way", as the outlook of Luzio, Bernardino and Moreno (2024) proposes. The weights
    v of the looks are our choice; they are those of `CloserLook`.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        attention: `(X·Y, K, X·Y)`, M for each fixated cell, class and seen cell.
        grid: the cells of one image.
        fovea: r in units of the image's longer side.

    Raises:
        InputError: the shape of `attention` does not fit the grid, `fovea` is not positive, or there is no such class.

    >>> from semfov import DirichletBelief
    >>> attention = torch.tensor([[0.1, 0.9], [0.2, 0.3]])[:, None]
    >>> search = TemplateAttention(1, attention, Grid(2, 1, (20, 10)))
    >>> search(DirichletBelief(torch.ones(1, 2, 2)), torch.tensor([[True, False]]))
    tensor([[0.1000, 0.9000]])
    """

    name, tasks, by_belief = "ivsn", ("search",), False
    target: Tensor
    attention: Tensor
    weight: Tensor

    def __init__(self, target: int | Tensor, attention: Tensor, grid: Grid, fovea: float = 100 / 640) -> None:
        super().__init__()
        check(fovea > 0, "fovea", "a positive number", fovea)
        check_shape(attention, "attention", len(grid), None, len(grid))
        targets = torch.as_tensor(target)
        inside = bool(((targets >= 1) & (targets <= attention.shape[1])).all())
        check(inside, "target", f"classes from 1 to {attention.shape[1]}", targets.tolist())
        self.register_buffer("target", targets)
        self.register_buffer("attention", attention)
        self.register_buffer("weight", acuity(grid.cell_distance, fovea))

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)`; they do not depend on the belief."""
        attention = self.attention.transpose(0, 1)[(self.target - 1).expand(len(visited))]
        return one_by_one(self._values, attention, visited.to(attention))

    def _values(self, attention: Tensor, visited: Tensor) -> Tensor:
        weight = visited[..., None] * self.weight.to(attention)
        return (weight * attention).sum(-2) / weight.sum(-2).clamp(min=torch.finfo(attention.dtype).tiny)


class Attending(Candidate):
    """IVSN in one scene, with the attention `(X·Y, K, X·Y)` of `TemplateAttention`."""

    def __init__(self, strategy: Strategy, attention: Tensor, fovea: float) -> None:
        super().__init__(strategy)
        self.attention, self.fovea = attention, fovea

    def acquisition(self, target: int | Tensor | None, grid: Grid, cell: Tensor) -> AcquisitionFunction:
        """Compute the attention to the target, accumulated over the fixated cells."""
        return Policy(TemplateAttention, attention=self.attention, fovea=self.fovea)(target, grid)

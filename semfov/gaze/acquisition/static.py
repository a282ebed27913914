"""Acquisition functions that do not depend on the belief."""

from torch import Tensor

from semfov.belief.belief import Belief
from semfov.errors import check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction


class Uniform(AcquisitionFunction):
    """The same value for every cell: with ties broken at random this is uniform random gaze.

    >>> import torch
    >>> from semfov import DirichletBelief
    >>> Uniform()(DirichletBelief(torch.ones(1, 3, 2)), torch.zeros(1, 3, dtype=torch.bool))
    tensor([[0., 0., 0.]])
    """

    name = "random"
    tasks = ("search", "exploration")
    by_belief = False

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Return zeros `(..., X·Y)`."""
        return belief.closest.new_zeros(belief.closest.shape)


class Static(AcquisitionFunction):
    """Fixed values of the cells, such as a saliency map, which do not depend on the belief.

    Args:
        values: `(..., X·Y)`.

    >>> import torch
    >>> from semfov import DirichletBelief
    >>> salient = Static(torch.tensor([0.1, 0.7, 0.2]))
    >>> salient(DirichletBelief(torch.ones(1, 3, 2)), torch.zeros(1, 3, dtype=torch.bool))
    tensor([[0.1000, 0.7000, 0.2000]])
    """

    name = "saliency"
    tasks = ("search", "exploration")
    by_belief = False
    values: Tensor

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.register_buffer("values", values)

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Return the fixed values `(..., X·Y)`; the belief must have as many cells."""
        check_shape(self.values, "values", belief.closest.shape[-1])
        return self.values.expand(belief.closest.shape)

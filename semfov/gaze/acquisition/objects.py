"""Exploration that looks at objects."""

from torch import Tensor

from semfov.belief.belief import Belief
from semfov.gaze.acquisition.base import AcquisitionFunction


class ObjectEvidence(AcquisitionFunction):
    r"""Probability of any object in each cell: the sum over all classes except background.

    .. math:: a(x) = \sum_{k \ge 1} P(C^x = k)

    >>> import torch
    >>> from semfov import DirichletBelief
    >>> belief = DirichletBelief(torch.tensor([[[1.0, 1.0, 2.0], [8.0, 1.0, 1.0]]]))
    >>> ObjectEvidence()(belief, torch.zeros(1, 2, dtype=torch.bool))
    tensor([[0.7500, 0.2000]])
    """

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)` for a belief about all classes."""
        return belief.class_probabilities()[..., 1:].sum(-1)

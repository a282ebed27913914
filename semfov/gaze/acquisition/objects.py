"""Exploration that looks at things."""

from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.gaze.acquisition.base import AcquisitionFunction


class ObjectProbability(AcquisitionFunction):
    r"""Probability that a cell holds anything but background.

    .. math:: a(x) = 1 - P(C^x = 0)

    (Objects tell where people look better than early saliency does: Einhäuser, Spain and Perona, 2008. There it is a
    map of objects that people named; here it is what the belief knows of them so far.)

    >>> import torch
    >>> from semfov import DirichletBelief
    >>> belief = DirichletBelief(torch.tensor([[[3.0, 0.5, 0.5], [1.0, 1.0, 2.0]]]))
    >>> ObjectProbability()(belief, torch.zeros(1, 2, dtype=torch.bool))
    tensor([[0.2500, 0.7500]])
    """

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)` for a belief about all classes."""
        return one_by_one(lambda p: p[..., 1:].sum(-1) / p.sum(-1), belief.class_probabilities())

"""The base class of acquisition functions."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from semfov.belief.belief import Belief


class AcquisitionFunction(nn.Module, ABC):
    """Base of all acquisition functions: the value of fixating each cell next.

    A subclass implements `forward`. The next fixation is the cell of the highest value that was not visited
    (`semfov.gaze.select_fixation`). The function itself may value visited cells too: inhibition of return excludes
    them.

    >>> import torch
    >>> from semfov import DirichletBelief
    >>> class Background(AcquisitionFunction):
    ...     def forward(self, belief, visited):
    ...         return belief.class_probabilities()[..., 0]
    >>> Background()(DirichletBelief(torch.tensor([[[1.0, 3.0], [1.0, 1.0]]])), torch.zeros(1, 2, dtype=torch.bool))
    tensor([[0.2500, 0.5000]])
    """

    @abstractmethod
    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Value of fixating each cell next.

        Args:
            belief: belief of B episodes after their last look.
            visited: `(B, X·Y)` boolean, cells that were fixated.

        Returns:
            `(B, X·Y)`; only the order of the values matters, unless the subclass gives them a unit.
        """

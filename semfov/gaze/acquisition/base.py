"""What an acquisition function is."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from semfov.belief.belief import Belief


class AcquisitionFunction(nn.Module, ABC):
    """Base of all acquisition functions: what it is worth to fixate each cell next.

    A subclass implements `forward`; the agent takes the cell of the highest value that was not visited yet
    (`semfov.gaze.select_fixation`). A value need not care for visited cells: inhibition of return takes them out.
    """

    @abstractmethod
    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)`.

        Args:
            belief: what the episodes believe after their last look.
            visited: `(B, X·Y)` boolean, cells that were fixated.
        """

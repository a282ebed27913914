"""What a batch of episodes believes."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Belief:
    """Beliefs about the cells of a batch of episodes.

    Attributes:
        beta: `(B, X·Y, C)`, Dirichlet parameters of every cell's class.
        closest: `(B, X·Y)`, distance to the closest fixation so far, in longer sides; infinite before the first look.
    """

    beta: Tensor
    closest: Tensor

    def __getitem__(self, index: Tensor | slice) -> "Belief":
        """Beliefs of some of the episodes."""
        return Belief(self.beta[index], self.closest[index])

    @classmethod
    def uniform(cls, batch: int, cells: int, components: int, prior: float, like: Tensor) -> "Belief":
        """The same parameter for every class, before any look; dtype and device as `like`."""
        return cls(like.new_full((batch, cells, components), prior), like.new_full((batch, cells), float("inf")))

"""What a batch of episodes believes."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from semfov.errors import InputError, check, values_known
from semfov.observation import dirichlet


class Belief(ABC):
    """Base of all beliefs about the cells of a batch of episodes.

    Attributes:
        closest: `(B, X·Y)`, distance to the closest fixation so far, in longer sides; infinite before the first look.
    """

    closest: Tensor

    @abstractmethod
    def probability(self, target: int | Tensor) -> Tensor:
        """Probability that each cell holds the target, `(B, X·Y)`.

        Args:
            target: class 1..K, or a tensor `(B,)` with one for each episode. A belief about one target alone answers
                for that target, whatever is asked.
        """

    def chance(self, target: int | Tensor) -> Tensor:
        """Probability that each cell holds the target if no fixated cell does, as in a search that goes on, `(B, X·Y)`.

        Without knowing better that is `probability`. Values of fixated cells have no meaning.
        """
        return self.probability(target)

    def presence(self, target: int | Tensor) -> Tensor:
        """Probability that the target is anywhere in the image, `(B,)`.

        A belief that was not made to tell gives a bound: the probability of the most probable cell.
        """
        return self.probability(target).amax(-1)

    def class_probabilities(self) -> Tensor:
        """Probability of every class in every cell, background first, `(B, X·Y, K+1)`.

        Raises:
            InputError: the belief is about a target alone.
        """
        raise InputError(f"belief: expected a belief about all classes, got {type(self).__name__}")

    @abstractmethod
    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """The belief with every tensor, each `(B, ...)`, replaced by `function` of it."""

    def __getitem__(self, index: Tensor | slice) -> Self:
        """Beliefs of some of the episodes."""
        return self.map(lambda tensor: tensor[index])

    def put(self, index: Tensor, other: Self) -> Self:
        """The belief in which the episodes `index` `(n,)` believe what those of `other` do.

        >>> before = DirichletBelief(torch.ones(2, 1, 2))
        >>> before.put(torch.tensor([1]), DirichletBelief(torch.tensor([[[1.0, 3.0]]]))).probability(1)
        tensor([[0.5000],
                [0.7500]])
        """
        theirs: list[Tensor] = []

        def collect(tensor: Tensor) -> Tensor:
            theirs.append(tensor)
            return tensor

        other.map(collect)
        rows = iter(theirs)
        return self.map(lambda tensor: tensor.index_copy(0, index, next(rows)))

    def detach(self) -> Self:
        """The same belief as a constant, through which no gradient flows."""
        return self.map(Tensor.detach)


@dataclass(frozen=True)
class DirichletBelief(Belief):
    r"""A Dirichlet belief about the class of every cell, :math:`P(C^x) \sim \mathrm{Dir}(\beta^x)`.

    (Luzio, Bernardino and Moreno, 2024, the equation of the map B.)

    Attributes:
        beta: `(B, X·Y, K+1)`, Dirichlet parameters, background first.
        closest: `(B, X·Y)`, see `Belief`; left out, there was no look yet.

    >>> belief = DirichletBelief(torch.tensor([[[1.0, 3.0], [1.0, 1.0]]]))
    >>> belief.probability(1)
    tensor([[0.7500, 0.5000]])
    """

    beta: Tensor
    closest: Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.closest is None:
            object.__setattr__(self, "closest", torch.full_like(self.beta[..., 0], torch.inf))

    def map(self, function: Callable[[Tensor], Tensor]) -> "DirichletBelief":
        """The belief with both tensors replaced."""
        return DirichletBelief(function(self.beta), function(self.closest))

    @classmethod
    def uniform(cls, batch: int, cells: int, components: int, prior: float, like: Tensor) -> "DirichletBelief":
        """The same parameter for every class, before any look; dtype and device as `like`."""
        return cls(like.new_full((batch, cells, components), prior))

    @property
    def probabilities(self) -> Tensor:
        r"""Posterior of every class, :math:`p_k = \beta_k / \sum_j \beta_j`, `(B, X·Y, K+1)`."""
        return dirichlet.mean(self.beta)

    def class_probabilities(self) -> Tensor:
        """The posterior of every class."""
        return self.probabilities

    def probability(self, target: int | Tensor) -> Tensor:
        """Posterior of the target class in each cell, `(B, X·Y)`."""
        return pick(self.beta, torch.as_tensor(target)) / self.beta.sum(-1)


def dirichlet_belief(belief: Belief) -> DirichletBelief:
    """The belief, as one about all classes.

    Raises:
        InputError: it is about a target alone.
    """
    if not isinstance(belief, DirichletBelief):
        raise InputError(f"belief: expected a belief about all classes (DirichletBelief), got {type(belief).__name__}")
    return belief


def pick(values: Tensor, target: Tensor) -> Tensor:
    """Component `target` (a scalar, or `(B,)`) of `values` `(B, ..., K+1)`, `(B, ...)`.

    Raises:
        InputError: there is no such component.

    >>> pick(torch.tensor([[[0.1, 0.9]], [[0.3, 0.7]]]), torch.tensor([1, 0]))
    tensor([[0.9000],
            [0.3000]])
    """
    components = values.shape[-1]
    if values_known(target):
        inside = bool(((target >= 0) & (target < components)).all())
        check(inside, "target", f"a class index from 0 to {components - 1}", target.tolist())
    if target.ndim == 0:
        return values[..., target]
    index = target.reshape(*target.shape, *[1] * (values.ndim - target.ndim))
    return values.take_along_dim(index.expand(*values.shape[:-1], 1), -1)[..., 0]


def one_by_one(function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
    """`function` of the rows of tensors `(B, ...)`, each row alone, joined again.

    Matrix products of other sizes may round otherwise, and so may exponentials and logarithms, of which the last few of
    a tensor are not computed in vectors. Taken alone, an episode's figures do not depend on how many others are run
    with it. Where a graph is traced, and inside `torch.func.vmap`, all rows are taken at once.

    >>> one_by_one(lambda row: row @ torch.ones(3, 1), torch.ones(2, 1, 3)).shape
    torch.Size([2, 1, 1])
    """
    if not values_known(*rows) or len(rows[0]) <= 1:
        return function(*rows)
    return torch.cat([function(*(row[index : index + 1] for row in rows)) for index in range(len(rows[0]))])

"""Beliefs of a batch of episodes about the cells of an image."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self, TypeVar

import torch
from torch import Tensor

from semfov.attribute_words import BELIEF, OtherWords
from semfov.belief.fusion import check_parameters
from semfov.errors import InputError, check, values_known
from semfov.observation import dirichlet
from semfov.precision import without_autocast

_TOGETHER = 1 << 22  # elements of the rows that an accelerator computes at once

_DataClass = TypeVar("_DataClass")


def with_fields(instance: _DataClass, change: Callable[[Any], Any]) -> _DataClass:
    """Copy a data class with every field changed; of a field that is a tuple, every value in it.

    Args:
        instance: the data class.
        change: maps a value to the new one.

    Returns:
        The copy.
    """

    def changed(value: Any) -> Any:
        return tuple(changed(part) for part in value) if isinstance(value, tuple) else change(value)

    names = [field.name for field in fields(instance)]  # type: ignore[arg-type]
    return replace(instance, **{name: changed(getattr(instance, name)) for name in names})  # type: ignore[type-var]


class Belief(OtherWords, ABC):
    """Base of all beliefs about the cells of an image, for a batch of episodes.

    A subclass implements `probability`. It is a dataclass whose fields are tensors `(B, ...)`, other beliefs, tuples of
    these, or values that all episodes share; a subclass with other fields also implements `map`.

    Attributes:
        closest: `(B, X·Y)`, distance from each cell to the closest fixation so far, in units of the image's longer
            side; infinite before the first look.

    >>> belief = DirichletBelief(torch.tensor([[[1.0, 3.0], [1.0, 1.0]]]))  # one episode, two cells, one class
    >>> belief.probability(1), belief.presence(1)
    (tensor([[0.7500, 0.5000]]), tensor([0.7500]))
    """

    closest: Tensor

    _other_words = BELIEF

    @abstractmethod
    def probability(self, target: int | Tensor) -> Tensor:
        """Return the probability that each cell holds the target, given all looks.

        Args:
            target: class 1..K, or a tensor `(B,)` with one class for each episode. A belief about a single target
                ignores this argument and answers for its own target.

        Returns:
            `(B, X·Y)`.
        """

    def chance(self, target: int | Tensor) -> Tensor:
        """Return the probability that each cell holds the target, given that no fixated cell holds it.

        This is the case while a search continues. The base class returns `probability`.

        Args:
            target: as for `probability`.

        Returns:
            `(B, X·Y)`. The values of fixated cells have no meaning.
        """
        return self.probability(target)

    def presence(self, target: int | Tensor) -> Tensor:
        """Return the probability that the target is anywhere in the image.

        The base class returns a lower bound: the probability of the most probable cell.

        Args:
            target: as for `probability`.

        Returns:
            `(B,)`.
        """
        return self.probability(target).amax(-1)

    def class_probabilities(self) -> Tensor:
        """Return the probability of every class in every cell.

        Returns:
            `(B, X·Y, K+1)`, background first.

        Raises:
            InputError: the belief is about a single target.
        """
        raise InputError(
            f"belief: expected a belief about all classes (of observers.Semantic, SemanticMap or SemanticSearch), got "
            f"{type(self).__name__}"
        )

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """Apply a function to every tensor of the belief, and of the beliefs that it holds.

        Args:
            function: maps a tensor `(B, ...)` to another one.

        Returns:
            A new belief.
        """

        def mapped(value: Any) -> Any:
            if isinstance(value, Tensor):
                return function(value)
            return value.map(function) if isinstance(value, Belief) else value

        return with_fields(self, mapped)

    def __getitem__(self, index: Tensor | slice) -> Self:
        """Select the belief of episodes."""
        return self.map(lambda tensor: tensor[index])

    def put(self, index: Tensor, other: Self) -> Self:
        """Replace the belief of some episodes.

        Args:
            index: `(n,)`, the episodes.
            other: their new belief, of n episodes.

        Returns:
            A new belief of all B episodes.

        >>> before = DirichletBelief(torch.ones(2, 1, 2))
        >>> before.put(torch.tensor([1]), DirichletBelief(torch.tensor([[[1.0, 3.0]]]))).probability(1)
        tensor([[0.5000],
                [0.7500]])
        """
        tensors: list[Tensor] = []

        def collect(tensor: Tensor) -> Tensor:
            tensors.append(tensor)
            return tensor

        # `map` goes through both beliefs in the same order.
        other.map(collect)
        rows = iter(tensors)
        return self.map(lambda tensor: tensor.index_copy(0, index, next(rows)))

    def __repr__(self) -> str:
        """Write the shapes of the tensors, as their numbers would fill the screen."""
        shapes = [f"{name}: {tuple(value.shape)}" for name, value in vars(self).items() if isinstance(value, Tensor)]
        return f"{type(self).__name__}({', '.join(shapes)})"

    def detach(self) -> Self:
        """Detach every tensor from the graph, so that no gradient flows through the belief.

        Returns:
            A new belief.
        """

        def detached(value: Any) -> Any:
            if isinstance(value, Mapping):
                return {key: detached(part) for key, part in value.items()}
            return value.detach() if isinstance(value, Tensor | Belief) else value

        return with_fields(self, detached)


@dataclass(frozen=True, repr=False)
class DirichletBelief(Belief):
    r"""A Dirichlet belief about the class of every cell, :math:`P(C^x) \sim \mathrm{Dir}(\beta^x)`.

    This is the map B of Luzio, Bernardino and Moreno (2024, equation 3).

    Attributes:
        beta: `(B, X·Y, K+1)`, Dirichlet parameters, positive, background first.
        closest: `(B, X·Y)`, see `Belief`; by default no look was made yet.

    >>> belief = DirichletBelief(torch.tensor([[[1.0, 3.0], [1.0, 1.0]]]))
    >>> belief.probability(1)
    tensor([[0.7500, 0.5000]])
    """

    beta: Tensor
    closest: Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.closest is None:
            check_parameters(self.beta)
            object.__setattr__(self, "closest", torch.full_like(self.beta[..., 0], torch.inf))

    @property
    def probabilities(self) -> Tensor:
        r"""Posterior of every class, :math:`p_k = \beta_k / \sum_j \beta_j`, `(B, X·Y, K+1)`."""
        return dirichlet.mean(self.beta)

    def class_probabilities(self) -> Tensor:
        """Return the posterior of every class, `(B, X·Y, K+1)`."""
        return self.probabilities

    def probability(self, target: int | Tensor) -> Tensor:
        """Return the posterior of the target class in each cell, `(B, X·Y)`."""
        return pick(self.beta, target) / self.beta.sum(-1)


def dirichlet_belief(belief: Belief) -> DirichletBelief:
    """Check that a belief is a `DirichletBelief`."""
    if not isinstance(belief, DirichletBelief):
        raise InputError(
            f"belief: expected a belief about all classes (DirichletBelief), got {type(belief).__name__}; use "
            "observers.Semantic, or an acquisition function that uses the probability of the target alone"
        )
    return belief


def pick(values: Tensor, target: int | Tensor) -> Tensor:
    """Select the values of one class.

    Args:
        values: `(B, ..., K+1)`.
        target: the class, a number or `()`, or one for each episode, `(B,)`.

    Returns:
        `(B, ...)`.

    Raises:
        InputError: there is no such class.
    """
    components = values.shape[-1]
    expected = f"a class index from 0 to {components - 1}"
    if isinstance(target, int):
        check(0 <= target < components, "target", expected, target)
        return values[..., target]
    target = torch.as_tensor(target)  # of a list or an array
    if values_known(target):
        inside = bool(((target >= 0) & (target < components)).all())
        check(inside, "target", expected, target.tolist())
    if target.ndim == 0:
        return values[..., target]
    # `(B, 1, …, 1)`: the class of an episode, at all its places.
    index = target.reshape(*target.shape, *[1] * (values.ndim - target.ndim))
    column = values.take_along_dim(index.expand(*values.shape[:-1], 1), -1)
    return column[..., 0]


def one_by_one(function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
    """Apply a function row by row, because rounding depends on the batch; on an accelerator to many rows.

    Args:
        function: maps tensors `(b, ...)` to one tensor `(b, ...)`.
        rows: its arguments for all rows, `(B, ...)`.

    Returns:
        `(B, ...)`.
    """
    first = rows[0]
    together = 1
    if first.device.type != "cpu":
        elements_of_row = max(1, first.shape[1:].numel())
        together = max(1, _TOGETHER // elements_of_row)
    if not values_known(*rows) or len(first) <= together:
        return function(*rows)
    parts = zip(*(row.split(together) for row in rows), strict=True)
    results = [function(*part) for part in parts]
    with without_autocast(first):  # it would join no results in another half precision than its own
        return torch.cat(results)

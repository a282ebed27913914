"""A strategy: the observer and the policy for one task."""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from semfov.belief.grid import Grid
from semfov.belief.observers import AnyOf, Observer, SemanticSearch
from semfov.belief.observers.any_of import TargetLike
from semfov.belief.prior import Prior, PriorLike
from semfov.data.classes import class_index
from semfov.errors import check, type_of
from semfov.gaze.acquisition import AcquisitionFunction, TargetPosterior, Uniform
from semfov.gaze.policies import Policy
from semfov.observation.presence import EVEN


def classes_named(target: TargetLike) -> list[str | int]:
    """List the classes of a target, which may be one class or any of several.

    Args:
        target: a class by name or index, several in a list, or several with weights.

    Returns:
        The classes, by name or index.

    >>> classes_named("cup"), classes_named({"cup": 0.9, "bowl": 0.1})
    (['cup'], ['cup', 'bowl'])
    """
    # Indices may be those of NumPy or a tensor, which have no length.
    if isinstance(target, str) or not isinstance(target, Mapping | Sequence):
        return [target]
    return list(target)


class Strategy(nn.Module):
    """Observer and policy for a task."""

    def __init__(self, observer: Observer, policy: Policy) -> None:
        super().__init__()
        for argument, part, kind in (("observer", observer, Observer), ("policy", policy, Policy)):
            got = f"the class {part.__name__}" if isinstance(part, type) else type_of(part)
            check(isinstance(part, kind), argument, f"an instance of a subclass of {kind.__name__}", got)
        self.observer = observer
        self.policy = policy

    def acquisition(self, target: int | Tensor | None, grid: Grid, cell: Tensor) -> AcquisitionFunction:
        """Make the acquisition function of episodes that fixate `cell` `(B,)`."""
        return self.policy(target, grid)

    def with_prior(self, prior: PriorLike, target: int) -> tuple["Strategy", Prior]:
        """Make the strategy for a search in which the target is present with a given prior.

        Args:
            prior: share of searches in which the class is there (`Prior.of`).
            target: the class, 1..K.

        Returns:
            The strategy of the search, and the prior by which its probabilities change.
        """
        observer = self.observer
        if isinstance(observer, AnyOf):
            check(prior is None, "prior", "None for a search for any of several classes", prior)
            return self._with_any_there(observer)
        if not isinstance(observer, SemanticSearch):
            return self, Prior.of(prior, None)
        changed = observer.with_prior(prior, target)
        return Strategy(changed, self.policy), changed.prior

    def _with_any_there(self, observer: AnyOf) -> tuple["Strategy", Prior]:
        r"""Assume that any of n classes is there in half of the pictures: each in :math:`1 - 2^{-1/n}` of them."""
        inner = observer.observer
        if not isinstance(inner, SemanticSearch) or inner.model.presence is None:
            return self, Prior.of(None, None)
        share = 1 - (1 - EVEN) ** (1 / len(observer.weights))
        prior_of_class = Prior(share, EVEN, known=False)
        changed = SemanticSearch(inner.model, prior=prior_of_class, footprint=inner.footprint)
        return Strategy(AnyOf(changed, observer.weights), self.policy), prior_of_class

    def sought(self, target: TargetLike, classes: Sequence[str]) -> tuple["Strategy", int, dict[int, float]]:
        """Prepare the search for a target.

        Args:
            target: a class by name or index 1..K, several, of which any will do, or each with the probability that it
                is meant.
            classes: names of the classes, background first.

        Returns:
            The strategy, the most probable class 1..K, and the weight of each class that is meant.

        Raises:
            InputError: a class is unknown or named twice, or the policy does not suit several classes.
        """
        if isinstance(target, str) or not isinstance(target, Mapping | Sequence):
            index = class_index(target, classes[1:], "target")
            return self, index, {index: 1.0}
        by_target: Mapping[Any, float] = target if isinstance(target, Mapping) else dict.fromkeys(target, 1.0)
        check(len(by_target) > 0, "target", "a class, or several classes with weights", "none")
        weights = _weights_by_index(by_target, classes)
        policy = self.policy
        uses_probabilities = policy.name in (TargetPosterior.name, Uniform.name) or policy.function.by_place
        expected = f"one class for policy {policy.name!r}, which does not use probabilities"
        check(uses_probabilities, "target", expected, dict(by_target))
        most_probable = max(weights, key=weights.__getitem__)
        return Strategy(AnyOf(self.observer, weights), policy), most_probable, weights


def _weights_by_index(by_target: Mapping[str | int, float], classes: Sequence[str]) -> dict[int, float]:
    """Find the weights of the classes 1..K that are meant; raises `InputError` for an unknown class, or one twice."""
    weights: dict[int, float] = {}
    for target, weight in by_target.items():
        index = class_index(target, classes[1:], "target")
        check(index not in weights, "target", "each class once", f"{classes[index]!r} twice")
        weights[index] = weight
    return weights

"""A strategy: the observer and the policy for one task."""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from semfov.belief.grid import Grid
from semfov.belief.observers import AnyOf, Observer, Target
from semfov.belief.observers.any_of import TargetLike
from semfov.belief.prior import Prior
from semfov.data.classes import class_index
from semfov.errors import check
from semfov.gaze.acquisition import AcquisitionFunction, TargetPosterior, Uniform
from semfov.gaze.policies import Policy


class Strategy(nn.Module):
    """Observer and policy for a task."""

    def __init__(self, observer: Observer, policy: Policy) -> None:
        super().__init__()
        for argument, part, kind in (("observer", observer, Observer), ("policy", policy, Policy)):
            got = f"the class {part.__name__}" if isinstance(part, type) else f"a {type(part).__name__}"
            check(isinstance(part, kind), argument, f"an instance of a subclass of {kind.__name__}", got)
        self.observer = observer
        self.policy = policy

    def acquisition(self, target: int | Tensor | None, grid: Grid, cell: Tensor) -> AcquisitionFunction:
        """The acquisition function of episodes that fixate `cell` `(B,)`."""
        return self.policy(target, grid)

    def with_prior(self, share: float, target: int) -> tuple["Strategy", Prior]:
        """Search for a class 1..K that is there in this share of searches."""
        observer = self.observer
        check(not isinstance(observer, AnyOf), "prior", "None for a search for any of several classes", share)
        prior = Prior.of(share, observer.model.shares if isinstance(observer, Target) else None, target)
        assert isinstance(observer, Target)
        return Strategy(Target(observer.model, together=observer.together, prior=prior), self.policy), prior

    def sought(self, target: TargetLike, classes: Sequence[str]) -> tuple["Strategy", int, dict[int, float]]:
        """Prepare the search for a target."""
        if isinstance(target, str) or not isinstance(target, Mapping | Sequence):
            index = class_index(target, classes[1:], "target")
            return self, index, {index: 1.0}
        by_target: Mapping[Any, float] = target if isinstance(target, Mapping) else dict.fromkeys(target, 1.0)
        check(len(by_target) > 0, "target", "a class, or several classes with weights", "none")
        weights: dict[int, float] = {}
        for name, weight in by_target.items():
            index = class_index(name, classes[1:], "target")
            check(index not in weights, "target", "each class once", f"{classes[index]!r} twice")
            weights[index] = weight
        policy = self.policy
        suits = policy.name in (TargetPosterior.name, Uniform.name) or policy.function.by_place
        check(
            suits, "target", f"one class for policy {policy.name!r}, which does not use probabilities", dict(by_target)
        )
        return Strategy(AnyOf(self.observer, weights), policy), max(weights, key=weights.__getitem__), weights

"""The observer of a search for any of several classes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Evidence, Observer, own
from semfov.detection.detections import Detections
from semfov.errors import check, check_number
from semfov.observation.thresholds import Thresholds

TargetLike = str | int | Sequence[str | int] | Mapping[str, float] | Mapping[int, float]
"""A class by name or index 1..K; several, of which any will do; or several with the probability that each is meant."""


@dataclass(frozen=True)
class _AnyEvidence(Evidence):
    """Looks of the inner observer: one for each class, or a single one about all classes."""

    inner: tuple[Evidence, ...]


@dataclass(frozen=True, repr=False)
class _AnyBelief(Belief):
    """Belief about any of several classes with weights w, P(x) = 1 - Π_k (1 - w_k p_k(x)), whichever is asked for."""

    inner: tuple[Belief, ...]
    weights: Mapping[int, float]
    closest: Tensor

    def probability(self, target: int | Tensor) -> Tensor:
        return self._any(lambda belief, index: belief.probability(index))

    def chance(self, target: int | Tensor) -> Tensor:
        return self._any(lambda belief, index: belief.chance(index))

    def presence(self, target: int | Tensor) -> Tensor:
        return self._any(lambda belief, index: belief.presence(index))

    def by_class(self) -> list[tuple[Belief, int, float]]:
        """List the belief about each class, the class and its weight."""
        # A single belief about all classes answers for each of them.
        beliefs = self.inner if len(self.inner) > 1 else self.inner * len(self.weights)
        return [(belief, index, weight) for belief, (index, weight) in zip(beliefs, self.weights.items(), strict=True)]

    def _any(self, probability: Callable[[Belief, int], Tensor]) -> Tensor:
        """Compute the probability of any class that is meant from a probability of each."""
        missing = [1 - weight * probability(belief, index) for belief, index, weight in self.by_class()]
        return 1 - torch.stack(missing).prod(0)


class AnyOf(Observer):
    """Observer of a search for any of several classes, built on an observer for one class.

    The weight of a class is the probability that an object of this class is one that is meant. Classes are treated as
    independent. It fits policies that use the probability of the target alone (`TargetPosterior`).

    Args:
        observer: the inner observer, applied to each class.
        weights: by class 1..K, in [0, 1], at least one above 0.

    Raises:
        InputError: no class has a weight above 0, or a weight is out of range.

    >>> from semfov.belief.observers import Semantic
    >>> observer, grid = AnyOf(Semantic(3), {1: 1.0, 2: 0.5}), Grid(1, 1, (10, 10))
    >>> observer.start(1, grid, torch.zeros(1)).probability(1)  # each class has the probability 1/3
    tensor([[0.4444]])
    """

    def __init__(self, observer: Observer, weights: Mapping[int, float]) -> None:
        super().__init__()
        check(any(weight > 0 for weight in weights.values()), "weights", "a class with a weight above 0", dict(weights))
        for weight in weights.values():
            check_number(weight, "weights", 0, 1)
        self.observer = observer
        # A class that is never meant changes no probability, and would cost a belief.
        self.weights = {index: float(weight) for index, weight in weights.items() if weight > 0}
        self._targets: list[int | None] = list(self.weights) if observer.by_target else [None]

    @property
    def thresholds(self) -> Thresholds | None:
        """Thresholds of the inner observer."""
        return self.observer.thresholds

    def start(self, batch: int, grid: Grid, like: Tensor) -> _AnyBelief:
        """Make the first belief of the inner observer, for each class."""
        inner = tuple(self.observer.start(batch, grid, like) for _ in self._targets)
        return _AnyBelief(inner, self.weights, inner[0].closest)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> _AnyEvidence:
        """Weigh the evidence for each class; `target` is ignored."""
        return _AnyEvidence(tuple(self.observer.weigh(detections, fixation, grid, index) for index in self._targets))

    def fade(self, belief: Belief, look: Evidence, keep: float, visited: Tensor) -> _AnyBelief:
        """Fade the beliefs of the inner observer."""
        return self._change(belief, look, lambda inner, evidence: self.observer.fade(inner, evidence, keep, visited))

    def update(self, belief: Belief, look: Evidence) -> _AnyBelief:
        """Update the beliefs of the inner observer."""
        return self._change(belief, look, self.observer.update)

    def _change(self, belief: Belief, look: Evidence, change: Callable[[Belief, Evidence], Belief]) -> _AnyBelief:
        """Change the beliefs of the inner observer by its looks."""
        any_belief = own(belief, _AnyBelief, "belief")
        any_evidence = own(look, _AnyEvidence, "look")
        inner = tuple(change(*pair) for pair in zip(any_belief.inner, any_evidence.inner, strict=True))
        # All inner beliefs have had the same looks, so that the first one tells.
        return replace(any_belief, inner=inner, closest=inner[0].closest)


def class_meant(belief: Belief, target: int) -> int:
    """Find the most probable class of a search for any of several classes.

    Args:
        belief: the belief of the search, of one episode.
        target: its target, 1..K.

    Returns:
        The target; of several (`AnyOf`) the one with the most probable cell, weights included.
    """
    if not isinstance(belief, _AnyBelief):
        return target
    peaks = [weight * inner.probability(index).amax(-1) for inner, index, weight in belief.by_class()]
    return list(belief.weights)[int(torch.stack(peaks).argmax(0))]

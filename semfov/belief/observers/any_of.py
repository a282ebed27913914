"""An observer of searches for any of several classes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer, own
from semfov.belief.target_evidence import Thresholds
from semfov.data.classes import class_index
from semfov.detection.detections import Detections
from semfov.errors import check, check_number

TargetLike = str | int | Mapping[str, float] | Mapping[int, float]
"""A class by name or by index 1..K, or several, each with the probability that it is meant."""


@dataclass(frozen=True)
class AnyLook(Look):
    """What looks say, as the other observer weighs it: of each class in turn, or of all of them."""

    inner: tuple[Look, ...]

    def __getitem__(self, index: Tensor | slice) -> "AnyLook":
        """Some of the looks."""
        return AnyLook(tuple(look[index] for look in self.inner))

    @classmethod
    def join(cls, looks: Sequence[Self]) -> "AnyLook":
        """All looks of several batches."""
        parts = zip(*(look.inner for look in looks), strict=True)
        return AnyLook(tuple(type(part[0]).join(part) for part in parts))


@dataclass(frozen=True)
class AnyBelief(Belief):
    r"""Belief about any of several classes; it answers for all of them together, whatever target is asked for.

    .. math:: P(x) = 1 - \prod_k (1 - w_k \, p_k(x))

    Attributes:
        inner: beliefs of the other observer: about each class in turn, or one about all of them.
        weights: w, by class.
        closest: `(B, X·Y)`, see `Belief`.
    """

    inner: tuple[Belief, ...]
    weights: Mapping[int, float]
    closest: Tensor

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability that a cell holds one that is meant, `(B, X·Y)`."""
        return self._any(lambda belief, index: belief.probability(index))

    def chance(self, target: int | Tensor) -> Tensor:
        """As for `probability`, if no fixated cell holds one."""
        return self._any(lambda belief, index: belief.chance(index))

    def presence(self, target: int | Tensor) -> Tensor:
        """Probability that one that is meant is anywhere in the image, `(B,)`."""
        return self._any(lambda belief, index: belief.presence(index))

    def likeliest(self) -> Tensor:
        """The class of which a cell most probably holds one that is meant, `(B,)`."""
        peaks = [weight * belief.probability(index).amax(-1) for belief, index, weight in self._each()]
        return torch.tensor(list(self.weights), device=peaks[0].device)[torch.stack(peaks).argmax(0)]

    def map(self, function: Callable[[Tensor], Tensor]) -> "AnyBelief":
        """The belief with all tensors replaced."""
        return AnyBelief(tuple(belief.map(function) for belief in self.inner), self.weights, function(self.closest))

    def _each(self) -> list[tuple[Belief, int, float]]:
        beliefs = self.inner if len(self.inner) > 1 else self.inner * len(self.weights)
        return [(belief, index, weight) for belief, (index, weight) in zip(beliefs, self.weights.items(), strict=True)]

    def _any(self, told: Callable[[Belief, int], Tensor]) -> Tensor:
        missing = [1 - weight * told(belief, index) for belief, index, weight in self._each()]
        return 1 - torch.stack(missing).prod(0)


class AnyOf(Observer):
    """Searches for any of several classes, as another observer searches for one.

    A class counts by its weight, the probability that an object of it is one that is meant. Classes count as if they
    were independent. It suits policies that go by the probability of the target alone (`TargetPosterior`).

    Args:
        observer: what it asks about each class.
        weights: by class 1..K, in [0, 1], the largest of them above 0.

    Raises:
        InputError: there is no class, or a weight is out of its range.
    """

    def __init__(self, observer: Observer, weights: Mapping[int, float]) -> None:
        super().__init__()
        check(any(weight > 0 for weight in weights.values()), "weights", "a class with a weight above 0", dict(weights))
        for weight in weights.values():
            check_number(weight, "weights", 0, 1)
        self.observer = observer
        self.weights = {index: float(weight) for index, weight in weights.items() if weight > 0}
        self._asked: list[int | None] = list(self.weights) if observer.by_target else [None]

    @property
    def thresholds(self) -> Thresholds | None:
        """Those of the other observer."""
        return self.observer.thresholds

    def start(self, batch: int, grid: Grid, like: Tensor) -> AnyBelief:
        """As the other observer starts, for each class."""
        inner = tuple(self.observer.start(batch, grid, like) for _ in self._asked)
        return AnyBelief(inner, self.weights, inner[0].closest)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> AnyLook:
        """What looks say of each class; `target` is not asked for."""
        return AnyLook(tuple(self.observer.weigh(detections, fixation, grid, index) for index in self._asked))

    def fade(self, belief: Belief, look: Look, keep: float, visited: Tensor) -> AnyBelief:
        """The other observer's beliefs fade."""
        known, said = own(belief, AnyBelief, "belief"), own(look, AnyLook, "look")
        pairs = zip(known.inner, said.inner, strict=True)
        return _with(known, tuple(self.observer.fade(each, of, keep, visited) for each, of in pairs))

    def update(self, belief: Belief, look: Look) -> AnyBelief:
        """Belief after a look in each episode."""
        known, said = own(belief, AnyBelief, "belief"), own(look, AnyLook, "look")
        pairs = zip(known.inner, said.inner, strict=True)
        return _with(known, tuple(self.observer.update(each, of) for each, of in pairs))


def _with(belief: AnyBelief, inner: tuple[Belief, ...]) -> AnyBelief:
    return replace(belief, inner=inner, closest=inner[0].closest)


def weights_by_class(target: Mapping[str, float] | Mapping[int, float], classes: Sequence[str]) -> dict[int, float]:
    """Weights by class 1..K of a target that is any of several; names are found as `class_index` does.

    Raises:
        InputError: a class is unknown, there twice, or there is none.
    """
    check(len(target) > 0, "target", "a class, or several with weights", "none")
    found: dict[int, float] = {}
    for name, weight in target.items():
        index = class_index(name, classes, "target")
        check(index not in found, "target", "each class once", f"{classes[index - 1]!r} twice")
        found[index] = weight
    return found

"""An observer that adds context to what another one believes of the target."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.context import ContextPrior, presence_of
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer, own
from semfov.belief.target_evidence import Thresholds
from semfov.detection.detections import Detections
from semfov.errors import InputError


@dataclass(frozen=True)
class ContextLook(Look):
    """What looks say of the target, and which classes they show where.

    Attributes:
        inner: what the other observer takes the looks to say.
        presence: `(B, X·Y, K+1)`, of `presence_of`.
        target: `(B,)`, class that is searched for.
        grid: the cells.
    """

    inner: Look
    presence: Tensor
    target: Tensor
    grid: Grid

    def __getitem__(self, index: Tensor | slice) -> "ContextLook":
        """Some of the looks."""
        return replace(self, inner=self.inner[index], presence=self.presence[index], target=self.target[index])

    @classmethod
    def join(cls, looks: Sequence["ContextLook"]) -> "ContextLook":
        """All looks of several batches."""
        inner = [look.inner for look in looks]
        presence = torch.cat([look.presence for look in looks])
        return cls(type(inner[0]).join(inner), presence, torch.cat([look.target for look in looks]), looks[0].grid)


@dataclass(frozen=True)
class ContextBelief(Belief):
    """Belief about one target alone.

    Attributes:
        present: `(B, X·Y)`, probability that a cell holds the target.
        following: `(B, X·Y)`, the same if no fixated cell holds it.
        closest: `(B, X·Y)`, see `Belief`.
        inner: belief of the other observer.
        shown: `(B, X·Y, K+1)`, highest score of each class in each cell in any look.
    """

    present: Tensor
    following: Tensor
    closest: Tensor
    inner: Belief
    shown: Tensor

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability of the target that was searched for, `(B, X·Y)`, whatever `target` is."""
        return self.present

    def chance(self, target: int | Tensor) -> Tensor:
        """As for `probability`, if no fixated cell holds the target."""
        return self.following

    def presence(self, target: int | Tensor) -> Tensor:
        """As the other observer has it: context tells of places."""
        return self.inner.presence(target)

    def map(self, function: Callable[[Tensor], Tensor]) -> "ContextBelief":
        """The belief with all tensors replaced, those of the other observer's among them."""
        inner = self.inner.map(function)
        return ContextBelief(
            function(self.present), function(self.following), function(self.closest), inner, function(self.shown)
        )


class Context(Observer):
    r"""Adds context to the log odds of the target that another observer arrives at.

    .. math:: \operatorname{logit} P(t \in x) = \operatorname{logit} p_t(x) + c_t(x)

    with c of `ContextPrior`, from the strongest sight of every class so far. It suits policies that go by the
    probability of the target alone (`TargetPosterior`).

    Args:
        observer: what it adds to.
        prior: the context.
        weights: of place and co-occurrence; None takes those fitted for the kind of observer.
    """

    by_target = True

    def __init__(self, observer: Observer, prior: ContextPrior, weights: tuple[float, float] | None = None) -> None:
        super().__init__()
        self.observer = observer
        self.prior = prior
        self.weights = weights or prior.weights_for("evidence" if observer.by_target else "map")

    @property
    def thresholds(self) -> Thresholds | None:
        """Those of the other observer."""
        return self.observer.thresholds

    def start(self, batch: int, grid: Grid, like: Tensor) -> ContextBelief:
        """Even odds in every cell, nothing seen."""
        inner = self.observer.start(batch, grid, like)
        even = like.new_full((batch, len(grid)), 0.5)
        nothing = like.new_zeros(batch, len(grid), len(self.prior.classes) + 1)
        return ContextBelief(even, even, inner.closest, inner, nothing)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> ContextLook:
        """What looks from `fixation` `(B, 2)` say of the target, and what they show around it."""
        if target is None:
            raise InputError("target: expected a class to search for, got None")
        inner = self.observer.weigh(detections, fixation, grid, target)
        wanted = torch.full((len(fixation),), target, device=fixation.device)
        return ContextLook(inner, presence_of(detections, grid), wanted, grid)

    def fade(self, belief: Belief, look: Look, keep: float, visited: Tensor) -> ContextBelief:
        """The other observer's belief fades, and so do the scores that were shown."""
        known, said = own(belief, ContextBelief, "belief"), own(look, ContextLook, "look")
        inner = self.observer.fade(known.inner, said.inner, keep, visited)
        return replace(known, inner=inner, closest=inner.closest, shown=keep * known.shown)

    def update(self, belief: Belief, look: Look) -> ContextBelief:
        """Belief after a look in each episode."""
        known, said = own(belief, ContextBelief, "belief"), own(look, ContextLook, "look")
        inner = self.observer.update(known.inner, said.inner)
        presence = torch.maximum(known.shown, said.presence)

        def in_context(alone: Tensor, shown: Tensor, target: Tensor) -> Tensor:
            return (log_odds(alone) + self.prior(shown, said.grid, target, self.weights)).sigmoid()

        present, following = (
            one_by_one(in_context, alone, presence, said.target)
            for alone in (inner.probability(said.target), inner.chance(said.target))
        )
        return ContextBelief(present, following, inner.closest, inner, presence)


def log_odds(probability: Tensor) -> Tensor:
    """What context is added to: the logit, kept finite."""
    return probability.logit(eps=1e-6)

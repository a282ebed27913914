"""An observer that adds context to another observer's belief about the target."""

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
class _ContextLook(Look):
    """Evidence of looks about the target, and the classes that they show in each cell.

    Shapes: presence `(B, X·Y, K+1)`, target `(B,)`.
    """

    inner: Look
    presence: Tensor
    target: Tensor
    grid: Grid


@dataclass(frozen=True)
class ContextBelief(Belief):
    """Belief about a single target, with context.

    Attributes:
        present: `(B, X·Y)`, probability that a cell holds the target.
        following: `(B, X·Y)`, probability that a cell holds the target, given that no fixated cell holds it.
        closest: `(B, X·Y)`, see `Belief`.
        inner: belief of the inner observer, without context.
        scores: `(B, X·Y, K+1)`, highest score of each class in each cell in any look.

    >>> from semfov.belief.observers import Semantic
    >>> prior = ContextPrior(["cup"], torch.zeros(2, 1, 1), torch.zeros(2, 2, 1), [])
    >>> Context(Semantic(2), prior, weights=(1.0, 1.0)).start(1, Grid(2, 1, (10, 10)), torch.zeros(1)).probability(1)
    tensor([[0.5000, 0.5000]])
    """

    present: Tensor
    following: Tensor
    closest: Tensor
    inner: Belief
    scores: Tensor

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability that each cell holds the target of the search, `(B, X·Y)`; `target` is ignored."""
        return self.present

    def chance(self, target: int | Tensor) -> Tensor:
        """As `probability`, given that no fixated cell holds the target."""
        return self.following

    def presence(self, target: int | Tensor) -> Tensor:
        """Probability of the inner observer: context changes where the target is, not whether it is there."""
        return self.inner.presence(target)


class Context(Observer):
    r"""Observer that adds context to the log odds of the target that another observer computes.

    .. math:: \operatorname{logit} P(t \in x) = \operatorname{logit} p_t(x) + c_t(x)

    c is the context of `ContextPrior`, given the highest score of every class in each cell so far. It fits policies
    that use the probability of the target alone (`TargetPosterior`).

    Args:
        observer: the inner observer.
        prior: the context.
        weights: weights of place and co-occurrence; None takes those of the prior for the kind of observer.

    >>> from semfov.belief.observers import Semantic
    >>> place = torch.zeros(2, 2, 2)
    >>> place[1, 1] = 1.0  # cups are in the lower half
    >>> prior = ContextPrior(["cup"], place, torch.zeros(2, 2, 1), [])
    >>> observer, grid = Context(Semantic(2), prior, weights=(1.0, 1.0)), Grid(1, 2, (10, 10))
    >>> seen = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 2), torch.zeros(1, 0, dtype=torch.bool))
    >>> observer(observer.start(1, grid, torch.zeros(1)), seen, torch.zeros(1, 2), grid, target=1).probability(1)
    tensor([[0.5000, 0.7311]])
    """

    by_target = True

    def __init__(self, observer: Observer, prior: ContextPrior, weights: tuple[float, float] | None = None) -> None:
        super().__init__()
        self.observer = observer
        self.prior = prior
        self.weights = weights or prior.weights_for("evidence" if observer.by_target else "map")

    @property
    def thresholds(self) -> Thresholds | None:
        """Thresholds of the inner observer."""
        return self.observer.thresholds

    def start(self, batch: int, grid: Grid, like: Tensor) -> ContextBelief:
        """Even odds in every cell, and no evidence."""
        inner = self.observer.start(batch, grid, like)
        even = like.new_full((batch, len(grid)), 0.5)
        nothing = like.new_zeros(batch, len(grid), len(self.prior.classes) + 1)
        return ContextBelief(even, even, inner.closest, inner, nothing)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> _ContextLook:
        """Evidence for the target, and the classes that are shown in each cell.

        Returns:
            A batch of B looks.

        Raises:
            InputError: `target` is None.
        """
        if target is None:
            raise InputError("target: expected a class to search for, got None")
        inner = self.observer.weigh(detections, fixation, grid, target)
        targets = torch.full((len(fixation),), target, device=fixation.device)
        return _ContextLook(inner, presence_of(detections, grid), targets, grid)

    def fade(self, belief: Belief, look: Look, keep: float, visited: Tensor) -> ContextBelief:
        """Fade the belief of the inner observer and the scores of the shown classes."""
        belief, look = own(belief, ContextBelief, "belief"), own(look, _ContextLook, "look")
        inner = self.observer.fade(belief.inner, look.inner, keep, visited)
        return replace(belief, inner=inner, closest=inner.closest, scores=keep * belief.scores)

    def update(self, belief: Belief, look: Look) -> ContextBelief:
        """Update the inner belief and the shown classes, and add the context."""
        belief, look = own(belief, ContextBelief, "belief"), own(look, _ContextLook, "look")
        grid, targets = look.grid, look.target
        inner = self.observer.update(belief.inner, look.inner)
        presence = torch.maximum(belief.scores, look.presence)

        def in_context(alone: Tensor, scores: Tensor, target: Tensor) -> Tensor:
            return (log_odds(alone) + self.prior(scores, grid, target, self.weights)).sigmoid()

        present, following = (
            one_by_one(in_context, alone, presence, targets)
            for alone in (inner.probability(targets), inner.chance(targets))
        )
        return ContextBelief(present, following, inner.closest, inner, presence)


def log_odds(probability: Tensor) -> Tensor:
    """Log odds of a probability, kept finite."""
    return probability.logit(eps=1e-6)

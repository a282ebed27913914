"""Base classes of observers, which turn looks into a belief."""

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar, Self, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from semfov.belief.belief import Belief, DirichletBelief, with_fields
from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.errors import InputError, check, check_shape, type_of
from semfov.observation.thresholds import Thresholds

_Kind = TypeVar("_Kind")

WEAK_PRIOR = 1e-5
"""ε, the Dirichlet parameter of every class before the first look, which one look outweighs."""

_REACH = 1 / 6  # distance, in longer sides of the image, over which a faded look counts as farther by a factor e


class Evidence:
    """Base of the evidence of a batch of looks about the cells. `Observer.weigh` returns it, `Observer.update` uses it.

    A subclass is a dataclass of tensors `(B, ...)`, of other looks, also in tuples, and of values that all looks share.
    One that holds its tensors in another way implements indexing and `join`.

    Attributes:
        by_detection: names of tensors `(B, L, D)` with a row for each detection, which are padded to be joined.

    >>> from semfov.belief.observers.semantic import SemanticEvidence
    >>> look = SemanticEvidence(torch.ones(2, 5, 3), torch.ones(2, 5, 4), torch.zeros(2, 4))  # two looks, four cells
    >>> SemanticEvidence.join([look[:1], look]).distance.shape
    torch.Size([3, 4])
    """

    by_detection: ClassVar[tuple[str, ...]] = ()

    def __getitem__(self, index: Tensor | slice) -> Self:
        """Select looks of the batch."""
        return with_fields(self, lambda value: value[index] if isinstance(value, Tensor | Evidence) else value)

    @classmethod
    def join(cls, looks: Sequence[Self]) -> Self:
        """Concatenate several batches of looks.

        Args:
            looks: the batches, all of this class.

        Returns:
            One batch with all looks, in order.
        """
        changes = {}
        for field in fields(cls):  # type: ignore[arg-type]
            values = [getattr(look, field.name) for look in looks]
            if field.name in cls.by_detection:
                values = _padded(values)
            changes[field.name] = _joined(values)
        return replace(looks[0], **changes)  # type: ignore[type-var]


def _joined(values: Sequence[Any]) -> Any:
    """Join the values of a field of several batches of looks; a value that all looks share is that of the first."""
    first = values[0]
    if isinstance(first, Tensor):
        return torch.cat(list(values))
    if isinstance(first, Evidence):
        return type(first).join(values)
    if isinstance(first, tuple):
        return tuple(_joined(parts) for parts in zip(*values, strict=True))
    return first


def _padded(values: Sequence[Tensor]) -> list[Tensor]:
    """Pad tensors `(B, L, D)` to the largest number L of detections."""
    detections = max(value.shape[1] for value in values)
    return [pad(value, (0, 0, 0, detections - value.shape[1])) for value in values]


class Observer(nn.Module, ABC):
    """Base of all observers, which turn looks into a belief.

    A subclass implements `start`, `weigh` and `update`. Only the observer's own `update` reads the result of `weigh`,
    and `weigh` does not depend on the episode, so a look can be weighed once and used by many episodes.

    A look that detects nothing in a cell tells something, too, and each observer says what: `Semantic` nothing, as
    published, or with `misses` the miss rates of the classes; `SemanticSearch` and `SemanticMap` their odds of a miss.
    Looks at windows have a belief of their own (`semfov.zoom.belief.ZoomBelief`).

    Attributes:
        by_target: whether the evidence of a look depends on the target that is searched for.

    >>> import torch
    >>> from semfov.belief.observers import Semantic
    >>> observer, grid = Semantic(2), Grid(2, 1, (10, 10))  # background and one class, two cells
    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.2, 0.8]]]), torch.ones(1, 1).bool())
    >>> look = observer.weigh(seen, torch.zeros(1, 2), grid)
    >>> observer.update(observer.start(1, grid, torch.zeros(1)), look).probability(1)
    tensor([[0.6500, 0.5000]])
    """

    by_target: ClassVar[bool] = False

    @property
    def thresholds(self) -> Thresholds | None:
        """Thresholds at which a search decides; None for a belief without calibrated thresholds."""
        return None

    @abstractmethod
    def start(self, batch: int, grid: Grid, like: Tensor) -> Belief:
        """Make the belief before the first look.

        Args:
            batch: B, number of episodes.
            grid: the cells.
            like: a tensor; the belief takes its dtype and device.

        Returns:
            The belief of B episodes.
        """

    @abstractmethod
    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> Evidence:
        """Weigh the evidence of looks about the cells.

        Args:
            detections: the detections of B looks, boxes in pixels of the grid's image.
            fixation: `(B, 2)`, fixation of each look as `(x, y)` in pixels.
            grid: the cells.
            target: class 1..K that is searched for; ignored by an observer that is not `by_target`.

        Returns:
            The evidence, a batch of B looks.
        """

    @abstractmethod
    def update(self, belief: Belief, look: Evidence) -> Belief:
        """Update the belief with one more look in each episode.

        Args:
            belief: of B episodes.
            look: B looks of this observer's `weigh`.

        Returns:
            The new belief.
        """

    def fade(self, belief: Belief, look: Evidence, keep: float, visited: Tensor) -> Belief:
        r"""Discount the evidence of past looks before the next look at a changing scene.

        .. math:: e \leftarrow e_0 + k \, (e - e_0)

        :math:`e` is the evidence of all looks so far, :math:`e_0` the evidence without any look, and k is `keep`.
        Subclasses define both. Probabilities that are computed from the evidence stay as they are until the next
        `update`.

        Args:
            belief: the belief after the looks so far.
            look: the next look, which is not in the belief yet.
            keep: k, the share of the evidence to keep, in (0, 1].
            visited: `(B, X·Y)` boolean, cells that still count as fixated.

        Returns:
            The faded belief.

        Raises:
            InputError: this observer's belief cannot fade.
        """
        raise InputError(
            f"observer: expected one whose belief can fade, got {type(self).__name__}; define its method `fade`, or "
            "use it on still pictures alone"
        )

    def forward(
        self,
        belief: Belief,
        detections: Detections,
        fixation: Tensor,
        grid: Grid,
        target: int | None = None,
    ) -> Belief:
        """Weigh looks and update the belief with them.

        Args:
            belief: of B episodes.
            detections: the detections of B looks, boxes in pixels of the grid's image.
            fixation: `(B, 2)`, fixation of each look as `(x, y)` in pixels.
            grid: the cells.
            target: class 1..K that is searched for.

        Returns:
            The new belief.

        Raises:
            InputError: an argument is of another type, or the numbers of episodes, looks and fixations differ.
        """
        _check_looks(belief, detections, fixation, grid)
        return self.update(belief, self.weigh(detections, fixation, grid, target))


def _check_looks(belief: Belief, detections: Detections, fixation: Tensor, grid: Grid) -> None:
    """Check the types of what an observer is called with, and that there is a look for each episode."""
    is_belief = isinstance(belief, Belief)
    check(is_belief, "belief", "a belief, such as observer.start(batch, grid, like)", type_of(belief))
    are_detections = isinstance(detections, Detections)
    remedy = "give what a detector or an eye returns, or semfov.Detections(boxes, scores)"
    check(are_detections, "detections", "detections", f"{type_of(detections)}; {remedy}")
    check_shape(fixation, "fixation", None, 2)
    check(isinstance(grid, Grid), "grid", "a grid, such as semfov.Grid(10, 10, (width, height))", type_of(grid))
    looks = detections.mask.shape[0]
    check(fixation.shape[0] == looks, "fixation", f"one for each of {looks} looks", fixation.shape[0])
    episodes = belief.closest.shape[0]
    check(looks == episodes, "detections", f"a look for each of {episodes} episodes", looks)


def own(value: object, kind: type[_Kind], argument: str) -> _Kind:
    """Check that a belief or a look has the class that an observer makes.

    Args:
        value: the belief or the look.
        kind: its class.
        argument: name of the argument, for the message.

    Returns:
        The value.

    Raises:
        InputError: it is of another kind.
    """
    if not isinstance(value, kind):
        raise InputError(
            f"{argument}: expected {kind.__name__}, got {type(value).__name__}; use the belief and the looks of one "
            "observer"
        )
    return value


def faded(belief: DirichletBelief, prior: float, keep: float) -> DirichletBelief:
    """Discount past looks in a belief: its parameters, and the distances of the closest looks.

    Args:
        belief: the belief.
        prior: β₀, as for `faded_parameters`.
        keep: k, the share of the evidence to keep; 1 changes nothing.

    Returns:
        The faded belief.
    """
    if keep == 1:
        return belief
    return replace(belief, beta=faded_parameters(belief.beta, prior, keep), closest=belief.closest + farther(keep))


def faded_parameters(beta: Tensor, prior: float, keep: float) -> Tensor:
    r"""Move Dirichlet parameters towards the prior, :math:`\beta_0 + k (\beta - \beta_0)`.

    Args:
        beta: the parameters, of any shape.
        prior: β₀, the parameter of every class before the first look.
        keep: k, the share of the evidence to keep.

    Returns:
        The new parameters.
    """
    return prior + keep * (beta - prior)


def farther(keep: float) -> float:
    """Compute how much distance to add to the closest look when a share of its evidence is left.

    Args:
        keep: the share.

    Returns:
        The increase of its distance, in longer sides of the image: 1/6 for each factor e.
    """
    # Evidence that has faded to nothing is very far away, not infinitely: a distance of infinity is no look at all.
    return -math.log(max(keep, sys.float_info.min)) * _REACH

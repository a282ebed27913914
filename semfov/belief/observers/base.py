"""What an observer is: it turns looks into a belief."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, Self, TypeVar

from torch import Tensor, nn

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.belief.target_evidence import Thresholds
from semfov.detection.detections import Detections
from semfov.errors import InputError

Kind = TypeVar("Kind")


class Look(ABC):
    """Base of what a batch of looks says about the cells, as an observer weighs it."""

    @abstractmethod
    def __getitem__(self, index: Tensor | slice) -> Self:
        """Some of the looks."""

    @classmethod
    @abstractmethod
    def join(cls, looks: Sequence[Self]) -> Self:
        """All looks of several batches."""


class Observer(nn.Module, ABC):
    """Base of all observers: what looks say, and what is believed after them.

    A subclass implements `start`, `weigh` and `update`. What `weigh` returns is read by its own `update` alone, so that
    looks can be weighed once and used by many episodes.

    Attributes:
        by_target: whether what a look says depends on the target that is searched for.
    """

    by_target: ClassVar[bool] = False

    @property
    def thresholds(self) -> Thresholds | None:
        """Probabilities at which a search decides; None where the belief is none to decide by."""
        return None

    @abstractmethod
    def start(self, batch: int, grid: Grid, like: Tensor) -> Belief:
        """The belief of `batch` episodes before the first look; dtype and device as `like`."""

    @abstractmethod
    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> Look:
        """What looks say.

        Args:
            detections: what was seen, boxes in pixels of the grid's image, a batch of B looks.
            fixation: `(B, 2)`, where each look was fixated.
            grid: the cells.
            target: class 1..K that is searched for; an observer that is not `by_target` has no use for it.
        """

    @abstractmethod
    def update(self, belief: Belief, look: Look) -> Belief:
        """The belief after one more look in each episode."""

    def forward(
        self, belief: Belief, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None
    ) -> Belief:
        """`update` by what `weigh` makes of the looks."""
        return self.update(belief, self.weigh(detections, fixation, grid, target))


class Gatherer(Observer):
    """Base of the observers that weigh what all looks say by networks.

    Args:
        together: compute all episodes of a batch at once: faster, but how figures are rounded depends on the batch.
    """

    def __init__(self, together: bool) -> None:
        super().__init__()
        self.together = together

    def each(self, function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
        """`function` of the rows of tensors `(B, ...)`, each alone (`one_by_one`) or all at once."""
        return function(*rows) if self.together else one_by_one(function, *rows)


def own(value: object, kind: type[Kind], argument: str) -> Kind:
    """The value, which must be of the observer's own kind.

    Raises:
        InputError: it comes from another observer.
    """
    if not isinstance(value, kind):
        raise InputError(f"{argument}: expected {kind.__name__}, got {type(value).__name__}")
    return value

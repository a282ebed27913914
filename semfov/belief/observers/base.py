"""What an observer is: it turns looks into a belief."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Self, TypeVar

from torch import Tensor, nn

from semfov.belief.belief import Belief
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

    def fade(self, belief: Belief, look: Look, keep: float, visited: Tensor) -> Belief:
        r"""The belief by the time of the next look at a scene that changes: what was gathered counts less.

        .. math:: e \leftarrow e_0 + k \, (e - e_0)

        with the evidence :math:`e` of all looks so far, what would be known without any, :math:`e_0`, and `keep`, k.
        Subclasses say what that is of their own. Figures that are read from the evidence are those of before, until
        `update` reads them anew.

        Args:
            belief: after the looks so far.
            look: the next one, which is not taken in yet.
            keep: share that is left, in (0, 1].
            visited: `(B, X·Y)` boolean, cells that still count as fixated.
        """
        raise InputError(f"observer: expected one whose belief can fade, got {type(self).__name__}")

    def forward(
        self, belief: Belief, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None
    ) -> Belief:
        """`update` by what `weigh` makes of the looks."""
        return self.update(belief, self.weigh(detections, fixation, grid, target))


def own(value: object, kind: type[Kind], argument: str) -> Kind:
    """The value, which must be of the observer's own kind.

    Raises:
        InputError: it comes from another observer.
    """
    if not isinstance(value, kind):
        raise InputError(f"{argument}: expected {kind.__name__}, got {type(value).__name__}")
    return value

"""The base of what looks at a stream frame by frame."""

from abc import ABC, abstractmethod
from typing import get_args

from semfov.data.inputs import Color, ImageLike
from semfov.episode import Forgetting
from semfov.errors import check, lookup
from semfov.paths import Moment


class FramePerception(ABC):
    """Looks at the frames of a stream with one pass of the detector each, and forgets between frames.

    Args:
        classes: names of the classes, background first.
        target: class 1..K that is searched for; None searches for none.
        targets: classes 1..K whose objects are all to be found; none: of all classes.
        rate: rate at which evidence fades, per frame; 0 forgets nothing.
        color: order of the channels of frames that are arrays or tensors.

    Example::

        live: FramePerception = agent.live("cup")
        print(live.describe(), live.step(frame).describe())
    """

    def __init__(
        self,
        classes: tuple[str, ...],
        target: int | None,
        targets: tuple[int, ...],
        rate: float,
        color: Color,
    ) -> None:
        self.classes, self.searches = classes, target is not None
        self.target = targets[0] if len(targets) == 1 else target
        self.targets = targets if len(targets) > 1 else ()
        self.forgetting = Forgetting(rate)
        self.color: Color = lookup(color, get_args(Color), "order of channels")
        self._size: tuple[int, int] | None = None

    @abstractmethod
    def step(self, frame: ImageLike) -> Moment:
        """Look at the next frame.

        Args:
            frame: a picture of any common kind (`semfov.as_image`), of the same size as the first frame.

        Returns:
            What is known at this frame.

        Raises:
            InputError: it is no picture, or has another size.
            DataError: the file of the frame cannot be read.
        """

    def describe(self) -> str:
        """What is done in a few words."""
        numbers = self.targets or (() if self.target is None else (self.target,))
        names = ", ".join(f"“{self.classes[number]}”" for number in numbers)
        if not numbers:
            return "exploring"
        return f"searching for {names}" if self.searches else f"finding all {names}"

    def check_size(self, size: tuple[int, int]) -> None:
        """Raise `InputError` unless a frame has the size of the first one.

        Args:
            size: `(width, height)` of the frame.
        """
        first = self._size = self._size or size
        expected = f"{first[0]} × {first[1]} pixels, the size of the first frame"
        check(size == first, "frame", expected, f"{size[0]} × {size[1]}")

"""The frame rate of a stream, without its first frames."""

from collections import deque
from collections.abc import Callable
from time import perf_counter

from semfov.errors import check_whole

WARM_UP = 3
"""Number of first frames of a stream that take longer than the others, because the detector gets ready."""


class FrameRate:
    """Counts the frames per second of a stream, without its first frames, in which the detector gets ready.

    Args:
        warm_up: number of first frames that do not count.
        recent: number of frames over which the present rate is taken.
        clock: gives the time in seconds.

    Attributes:
        frames: number of frames so far, the first ones included.

    >>> rate = FrameRate(warm_up=1, clock=iter([2.5, 2.6, 2.8]).__next__)
    >>> for _ in range(3):
    ...     rate.add()
    ...     print(rate)
    warming up
    10.0 frames/s
    6.7 frames/s
    >>> rate.summary()
    '3 frames, 6.7 per second after the first'
    """

    def __init__(self, warm_up: int = WARM_UP, *, recent: int = 20, clock: Callable[[], float] = perf_counter) -> None:
        check_whole(warm_up, "warm_up", 1, 1_000_000)
        check_whole(recent, "recent", 1, 1_000_000)
        self.warm_up, self.frames, self._clock = warm_up, 0, clock
        self._warm = 0.0
        self._ends: deque[float] = deque(maxlen=recent + 1)

    def add(self) -> None:
        """Count a frame that was looked at."""
        now = self._clock()
        self.frames += 1
        if self.frames >= self.warm_up:
            self._warm = now if self.frames == self.warm_up else self._warm
            self._ends.append(now)

    @property
    def now(self) -> float | None:
        """Frames per second of late; None before the first frame that counts."""
        return _rate(len(self._ends) - 1, self._ends[-1] - self._ends[0]) if self._ends else None

    @property
    def mean(self) -> float | None:
        """Frames per second of all frames that count; None before the first."""
        return _rate(self.frames - self.warm_up, self._ends[-1] - self._warm) if self._ends else None

    def __str__(self) -> str:
        """The present rate in words."""
        return "warming up" if self.now is None else f"{self.now:.1f} frames/s"

    def summary(self) -> str:
        """Describe the whole stream in words, and say which frames do not count."""
        frames = f"{self.frames} frame{'' if self.frames == 1 else 's'}"
        if self.mean is None:
            return f"{frames}, all of them while the detector got ready"
        first = "the first" if self.warm_up == 1 else f"the first {self.warm_up}"
        return f"{frames}, {self.mean:.1f} per second after {first}"


def _rate(frames: int, seconds: float) -> float | None:
    return frames / seconds if frames > 0 and seconds > 0 else None

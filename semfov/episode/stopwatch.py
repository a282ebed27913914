"""Time of the stages of a cycle."""

import time

STAGES = ("foveate", "detect", "weigh", "update belief", "choose")  # names of the stages of a cycle, in order


class Stopwatch:
    """Measures the seconds of stages, beside those that were measured before."""

    def __init__(self, seconds: dict[str, float] | None = None) -> None:
        self.seconds = dict(seconds or {})
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now

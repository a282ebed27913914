"""Times of programs that do the same work, side by side."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

Run = Callable[[], object]

Clock = Callable[[], float]
"""Seconds: `time.perf_counter`, or `time.process_time` for programs of one thread, which other work disturbs less."""


def clock_for(threads: int) -> tuple[Clock, str]:
    """The clock for programs of so many threads, and what it shows."""
    return (time.process_time, "of the processor") if threads == 1 else (time.perf_counter, "of the clock")


@dataclass(frozen=True)
class Comparison:
    """semfov beside other programs for the same work.

    Attributes:
        name: of the work.
        ours: semfov's program.
        peers: the others by name.
        share: part of the work that a peer does where the whole would take too long; its time is divided by this.
        agree: raises where results differ.
    """

    name: str
    ours: Run
    peers: Mapping[str, Run]
    share: Mapping[str, float] = field(default_factory=dict)
    agree: Run = lambda: None


@dataclass(frozen=True)
class Spread:
    """Median and quartiles."""

    low: float
    middle: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> "Spread":
        """Of at least two values."""
        return cls(*statistics.quantiles(values, n=4, method="inclusive"))


@dataclass(frozen=True)
class Measured:
    """What came of a comparison.

    Attributes:
        name: of the work.
        milliseconds: of every program, semfov first.
        ratios: for each peer, its time over semfov's in the same repetition.
    """

    name: str
    milliseconds: dict[str, Spread]
    ratios: dict[str, Spread]


def interleaved(
    runs: Mapping[str, Run], seconds: float, clock: Clock = time.perf_counter, least: int = 5, times: int = 1
) -> dict[str, list[float]]:
    """Milliseconds of every run in every repetition, for about so many seconds; the first, warm-up, is not counted.

    A repetition runs all of them one after another, starting with another each time: what else the machine does falls
    on all alike. A run that takes microseconds is slower after another one than after itself: with `times`, each turn
    is so many runs, and their mean counts.
    """
    found: dict[str, list[float]] = {name: [] for name in runs}
    names, began, repetition = list(runs), time.perf_counter(), 0
    while repetition <= least or time.perf_counter() - began < seconds:
        first = repetition % len(names)
        for name in names[first:] + names[:first]:
            start = clock()
            for _ in range(times):
                runs[name]()
            if repetition:
                found[name].append(1e3 * (clock() - start) / times)
        repetition += 1
    return found


def measure(comparison: Comparison, seconds: float, clock: Clock, times: int = 1) -> Measured:
    """Check that the programs agree, and time them (`interleaved`)."""
    comparison.agree()
    found = interleaved({"semfov": comparison.ours, **comparison.peers}, seconds, clock, times=times)
    for name, share in comparison.share.items():
        found[name] = [value / share for value in found[name]]
    ours = found["semfov"]
    ratios = {
        name: Spread.of([theirs / mine for theirs, mine in zip(found[name], ours, strict=True)])
        for name in comparison.peers
    }
    return Measured(comparison.name, {name: Spread.of(values) for name, values in found.items()}, ratios)

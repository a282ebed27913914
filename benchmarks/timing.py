"""Times programs that do the same work, in turn."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

Run = Callable[[], object]

Clock = Callable[[], float]
"""Gives seconds: `time.perf_counter`, or, for one thread, `time.process_time`, which other work disturbs less."""


def clock_for(threads: int) -> tuple[Clock, str]:
    """Make the clock for programs with this number of threads, and a description of its times."""
    return (time.process_time, "of the processor") if threads == 1 else (time.perf_counter, "of the clock")


@dataclass(frozen=True)
class Comparison:
    """Comparison of semfov with other programs (peers) for the same work.

    Attributes:
        name: name of the work.
        ours: semfov's program.
        peers: the other programs by name.
        share: share of the work that a peer does if the whole work would take too long; its time is divided by this.
        agree: raises an error if the results of the programs differ.
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
        """Median and quartiles of at least two values."""
        return cls(*statistics.quantiles(values, n=4, method="inclusive"))


@dataclass(frozen=True)
class Measured:
    """Result of a comparison.

    Attributes:
        name: name of the work.
        milliseconds: times of all programs, semfov first.
        ratios: for each peer, its time divided by semfov's in the same repetition.
    """

    name: str
    milliseconds: dict[str, Spread]
    ratios: dict[str, Spread]


def interleaved(
    runs: Mapping[str, Run],
    seconds: float,
    clock: Clock = time.perf_counter,
    least: int = 5,
    times: int = 1,
) -> dict[str, list[float]]:
    """Time programs in turn; the first repetition is a warm-up and does not count.

    A repetition runs all programs one after another, each repetition beginning with another one, so that other work on
    the machine affects all alike. A program that takes microseconds is slower after another program than after itself.
    It can be run several times per turn, and the mean of these runs counts.

    Args:
        runs: the programs by name.
        seconds: approximate duration of the whole measurement.
        clock: the clock.
        least: smallest number of repetitions.
        times: number of runs per turn.

    Returns:
        Milliseconds of every program in every repetition.
    """
    (durations,) = interleaved_by((clock,), runs, seconds, least, times)
    return durations


def interleaved_by(
    clocks: Sequence[Clock], runs: Mapping[str, Run], seconds: float, least: int = 5, times: int = 1
) -> list[dict[str, list[float]]]:
    """Time programs in turn (`interleaved`) by several clocks, which all see the same repetitions.

    Args:
        clocks: the clocks.
        runs: the programs by name.
        seconds: approximate duration of the whole measurement.
        least: smallest number of repetitions.
        times: number of runs per turn.

    Returns:
        For each clock, milliseconds of every program in every repetition.
    """
    durations: list[dict[str, list[float]]] = [{name: [] for name in runs} for _ in clocks]
    names, began, repetition = list(runs), time.perf_counter(), 0
    while repetition <= least or time.perf_counter() - began < seconds:
        first = repetition % len(names)
        for name in names[first:] + names[:first]:
            starts = [clock() for clock in clocks]
            for _ in range(times):
                runs[name]()
            ends = [clock() for clock in clocks]
            if repetition:
                for of_clock, start, end in zip(durations, starts, ends, strict=True):
                    of_clock[name].append(1e3 * (end - start) / times)
        repetition += 1
    return durations


def measure(comparison: Comparison, seconds: float, clock: Clock, times: int = 1) -> Measured:
    """Check that the programs of a comparison agree, and time them (`interleaved`)."""
    comparison.agree()
    durations = interleaved({"semfov": comparison.ours, **comparison.peers}, seconds, clock, times=times)
    for name, share in comparison.share.items():
        durations[name] = [value / share for value in durations[name]]
    ours = durations["semfov"]
    ratios = {
        name: Spread.of([theirs / mine for theirs, mine in zip(durations[name], ours, strict=True)])
        for name in comparison.peers
    }
    return Measured(comparison.name, {name: Spread.of(values) for name, values in durations.items()}, ratios)

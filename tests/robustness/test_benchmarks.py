"""What is timed side by side computes the same; and the figures come out of times as they should."""

import time

import pytest
import torch

from benchmarks.__main__ import COMPARISONS, comparison_rows
from benchmarks.limits import paths
from benchmarks.timing import Comparison, Spread, interleaved, measure

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("number", range(len(COMPARISONS)))
def test_programs_agree(number):
    with torch.inference_mode():
        comparison = COMPARISONS[number]()
        comparison.agree()
    assert comparison.peers
    assert set(comparison.share) <= set(comparison.peers)


def test_ratios_are_of_whole_work():
    """A peer that needs twice the time for a quarter of the work is eight times as slow."""
    clock = iter(range(10**6))
    seconds = {"ours": 3, "peer": 6}

    def spend(name):
        for _ in range(seconds[name] - 1):
            next(clock)

    comparison = Comparison("work", lambda: spend("ours"), {"peer": lambda: spend("peer")}, {"peer": 1 / 4})
    measured = measure(comparison, 0.0, lambda: float(next(clock)))
    assert measured.ratios["peer"] == Spread(8.0, 8.0, 8.0)
    assert comparison_rows(measured) == [["work", "peer", "3,000", "24,000", "8 (8 to 8)"]]


def test_runs_take_turns_at_being_first():
    order: list[str] = []
    interleaved({name: lambda name=name: order.append(name) for name in "abc"}, 0.0, time.perf_counter, least=3)
    rounds = ["".join(order[i : i + 3]) for i in range(0, len(order), 3)]
    assert rounds == ["abc", "bca", "cab", "abc"]


def test_bytes_of_the_sensor_are_those_of_its_tensors():
    path = paths()["foveation, pyramid included"]
    assert path.bytes == 2 * 3 * 480 * 640 * 4
    assert path.run().numel() * 4 * 2 == path.bytes

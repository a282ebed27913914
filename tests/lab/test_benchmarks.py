"""Benchmarks: programs that are compared give the same results, and figures are computed correctly from times."""

import json
import platform
import time

import pytest
import torch

from benchmarks import decisions
from benchmarks.__main__ import COMPARISONS
from benchmarks.tables import comparison_rows
from benchmarks.timing import Comparison, Spread, interleaved, measure

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("number", range(len(COMPARISONS)))
def test_compared_programs_give_the_same_results(number):
    with torch.inference_mode():
        comparison = COMPARISONS[number]()
        comparison.agree()
    assert comparison.peers
    assert set(comparison.share) <= set(comparison.peers)


def test_ratios_take_the_share_of_the_work_into_account():
    """A peer that needs twice the time for a quarter of the work is eight times slower."""
    clock = iter(range(10**6))
    seconds = {"ours": 3, "peer": 6}

    def spend(name):
        for _ in range(seconds[name] - 1):
            next(clock)

    comparison = Comparison("work", lambda: spend("ours"), {"peer": lambda: spend("peer")}, {"peer": 1 / 4})
    measured = measure(comparison, 0.0, lambda: float(next(clock)))
    assert measured.ratios["peer"] == Spread(8.0, 8.0, 8.0)
    assert comparison_rows(measured) == [["work", "peer", "3,000", "24,000", "8 (8 to 8)"]]


def test_runs_rotate_and_are_averaged_in_a_turn():
    order: list[str] = []
    interleaved({name: lambda name=name: order.append(name) for name in "abc"}, 0.0, time.perf_counter, least=3)
    rounds = ["".join(order[i : i + 3]) for i in range(0, len(order), 3)]
    assert rounds == ["abc", "bca", "cab", "abc"]
    clock = iter(range(10**6))
    found = interleaved({"a": lambda: next(clock)}, 0.0, lambda: float(next(clock)), least=1, times=4)
    assert found == {"a": [1e3 * 5 / 4]}


def test_decisions_have_a_row_for_every_published_cost(tmp_path, monkeypatch):
    arguments = ["decisions", "--threads", "1", "--seconds", "0", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)
    decisions.main()
    text, figures = (tmp_path / "decisions.md").read_text(), json.loads((tmp_path / "decisions.json").read_text())
    for costs in decisions.PUBLISHED.values():
        for name in costs:
            assert f"| {name} |" in text
            times = figures["milliseconds"][name]
            assert 0 < times["low"] <= times["middle"] <= times["high"]
    assert set(figures["peers"]["ratios"]) == {"loop over fixations and cells", "all pairs at once"}
    assert figures["published_milliseconds"]["exploration"]["KL divergence, raw"] == 9851
    assert platform.node() not in json.dumps(figures["machine"]).split('"')

"""A few cases of every fuzzing target, and mutations that are set aside are changes of the present code."""

import logging

import pytest

from benchmarks.fuzz import TARGETS
from benchmarks.fuzz.runner import run
from benchmarks.mutation import listed, outdated

CASES = 25


@pytest.mark.parametrize("name", TARGETS)
def test_bad_input_gives_a_typed_error_or_the_documented_result(name, caplog):
    caplog.set_level(logging.ERROR, logger="semfov")
    outcomes = run(TARGETS[name], CASES)
    assert sum(outcomes.values()) >= CASES / 2
    # Both results and errors must occur.
    assert set(outcomes) > {"result"}


def test_every_change_that_is_set_aside_is_one_of_the_present_code():
    assert listed()
    assert outdated(listed()) == []


@pytest.mark.parametrize(
    ("function", "change"),
    [
        ("semfov.belief.fusion.gone", "return a"),
        ("semfov.gone.fuse", "return a"),
        ("semfov.belief.fusion.sum", "return beta - likelihood / likelihood.total(-1, keepdim=True)"),
        ("semfov.belief.fusion.sum", "return beta + likelihood / likelihood.sum(-1, keepdim=True)"),
        ("semfov.belief.fusion.fuse_scaled", "episodes = max(0, _BLOCK // max(1, beta[:1].numel()))"),
        ("semfov.fuse", "soft = None"),
    ],
    ids=["no function", "no module", "no such line", "no change", "decorated", "another module"],
)
def test_a_change_that_cannot_occur_is_outdated(function, change):
    assert outdated({function: [change]}) == [f"{function}: {change}"]

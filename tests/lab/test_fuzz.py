"""A few cases of every fuzzing target; `python -m benchmarks.fuzz` runs thousands."""

import logging

import pytest

from benchmarks.fuzz import TARGETS
from benchmarks.fuzz.runner import run

CASES = 25


@pytest.mark.parametrize("name", TARGETS)
def test_bad_input_gives_a_typed_error_or_the_documented_result(name, caplog):
    caplog.set_level(logging.ERROR, logger="semfov")
    outcomes = run(TARGETS[name], CASES)
    assert sum(outcomes.values()) >= CASES / 2
    # Both results and errors must occur.
    assert set(outcomes) > {"result"}

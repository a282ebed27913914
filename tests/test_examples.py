"""The examples run, and do what they say."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.weights, pytest.mark.slow]


def test_finetuning_raises_the_chance_of_a_hit():
    call = [sys.executable, "-m", "examples.finetune_observation", "--scenes", "2", "--starts", "4", "--steps", "12"]
    root = Path(__file__).parents[1]
    output = subprocess.run(call, cwd=root, check=True, capture_output=True, text=True).stdout
    steps = [float(value) for value in re.findall(r"step .*fixation ([\d.]+) %", output)]
    assert len(steps) == 2
    assert steps[1] > steps[0]
    assert "after training" in output

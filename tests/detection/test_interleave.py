"""The benchmark of alternating sensor and detector runs, and its shares are between 0 and 100 %."""

import re

import numpy as np
import pytest

from benchmarks.interleave import main


@pytest.mark.lab
@pytest.mark.slow
@pytest.mark.parametrize("options", [["--threads", "1", "2"], ["--processor-time"]])
def test_benchmark_prints_its_tables(make_onnx, monkeypatch, capsys, options):
    model = make_onnx(
        {"output": np.random.default_rng(0).random((1, 84, 85)).astype(np.float32) - 0.5 * (np.arange(85) < 4)}
    )
    arguments = ["interleave", "--model", str(model), "--repetitions", "2", "--fixations", "2", *options]
    monkeypatch.setattr("sys.argv", arguments)
    main()
    lines = capsys.readouterr().out.splitlines()
    threads = 2 if "--threads" in options else 1
    turns = [line for line in lines if re.match(r"\| \d \| (on|off) ", line)]
    assert len(turns) == (3 if threads == 2 else 1)  # with one thread no thread has to wait for another
    parts = [line for line in lines if re.match(r"\| \d \| (search|exploration)", line)]
    assert len(parts) == 3 * threads
    for line in parts:
        sensor, detector, belief, policy = (float(cell) for cell in line.split("|")[3:7])
        assert min(sensor, detector, belief, policy) > 0
        low, high = (float(number) for number in re.search(r"\(([-.\d]+) to ([-.\d]+)\)", line).groups())
        assert 0 < low <= high < 100

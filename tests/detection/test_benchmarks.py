"""The benchmark of alternating sensor and detector runs, and COCO figures against independent implementations."""

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.detector_ap import SELECTIONS, average_precision
from benchmarks.interleave import main
from semfov import Detector, load_detector


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


pytestmark = [pytest.mark.long, pytest.mark.shared]


def measured(detector: Detector, shared: Path) -> list[tuple[float, float]]:
    """AP and AP50, first with per-class and then with class-agnostic suppression."""
    coco = shared / "coco"
    annotations = coco / "annotations/instances_eval300.json"
    return average_precision(detector, coco / "eval300", annotations, list(SELECTIONS.values()))


@pytest.mark.weights
def test_yolov3_tiny(shared, tiny_weights):
    scores = measured(load_detector("yolov3-tiny", weights=tiny_weights, stride=None), shared)
    for actual, expected in zip(scores, [(0.143, 0.308), (0.138, 0.298)], strict=True):
        assert actual == pytest.approx(expected, abs=0.005)


def test_yolox_nano_and_picodet(shared):
    nano = measured(load_detector(shared / "weights" / "yolox_nano_416.onnx"), shared)
    for actual, expected in zip(nano, [(0.219, 0.361), (0.211, 0.347)], strict=True):
        assert actual == pytest.approx(expected, abs=0.005)
    picodet = measured(load_detector(shared / "weights" / "picodet_s_416_coco.onnx"), shared)
    for worse, better in zip(nano, picodet, strict=True):
        assert better[0] > worse[0]
        assert better[1] > worse[1]

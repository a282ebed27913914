"""COCO figures of detectors on the development photographs match those of independent implementations."""

from pathlib import Path

import pytest

from benchmarks.detector_ap import SELECTIONS, average_precision
from semfov import Detector, load_detector

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

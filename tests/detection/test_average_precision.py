"""The detector against an independent implementation's COCO figures on the development photographs."""

import pytest

from benchmarks.detector_ap import SELECTIONS, average_precision
from semfov.detection.load import load_detector


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.weights
def test_yolov3_tiny(shared, tiny_weights):
    detector = load_detector("yolov3-tiny", weights=tiny_weights, stride=None)
    coco = shared / "coco"
    annotations = coco / "annotations/instances_eval300.json"
    scores = average_precision(detector, coco / "eval300", annotations, list(SELECTIONS.values()))
    for actual, expected in zip(scores, [(0.143, 0.308), (0.138, 0.298)], strict=True):
        assert actual == pytest.approx(expected, abs=0.005)

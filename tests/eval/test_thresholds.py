"""Looks at several score thresholds from one pass of the detector: the same as looks with each threshold alone."""

from dataclasses import replace

import pytest
import torch

from eval.comparison.thresholds import ThresholdLooksConfig, _ThresholdEyes, look_at_thresholds
from semfov import Eye, Foveation
from semfov.detection import Candidates, Detector, Selection
from semfov.detection.selection import select
from semfov.runs.config import BeliefConfig, DataConfig, DetectorConfig, SensorConfig
from semfov.runs.looking import Looking
from semfov.runs.looks import tight

THRESHOLDS = (0.02, 0.25, 0.5)


class Crowd(Detector):
    """Proposes sixty overlapping boxes, which depend on the picture; counts its passes."""

    passes = 0

    def propose(self, canvas):
        self.passes += 1
        generator = torch.Generator().manual_seed(int(1000 * canvas.mean()))
        corner, sides = torch.rand(2, 1, 60, 2, generator=generator) * 30
        classes = torch.rand(1, 60, 3, generator=generator)
        return Candidates(torch.cat([corner, corner + sides], -1), classes, torch.rand(1, 60, generator=generator))


def crowd(threshold):
    return Crowd("crowd", ("cat", "cup", "dog"), (64, 64), selection=Selection(threshold))


def assert_same(one, other):
    for name in ("boxes", "scores", "mask"):
        assert torch.equal(getattr(one, name), getattr(other, name))


def test_one_pass_gives_the_looks_of_every_threshold():
    sensor, image, points = Foveation(20.0), torch.rand(1, 3, 48, 64), torch.tensor([[5.0, 9.0], [40.0, 30.0]])
    eyes = _ThresholdEyes(Eye(sensor, crowd(0.9)), THRESHOLDS)
    view = eyes.open(image)
    for point in points:
        looks = eyes.look(view, point[None])
        for threshold, seen, settings in zip(THRESHOLDS, looks, eyes.settings, strict=True):
            alone = Eye(sensor, crowd(threshold))
            assert settings == alone.settings()
            assert_same(seen, tight(alone.look(alone.open(image), point[None])))
        assert looks[0].count > looks[1].count > looks[2].count > 0
    assert eyes._eye.detector.passes == 2


@pytest.mark.parametrize("limit", [100, 15])
def test_what_passes_a_higher_threshold_is_part_of_what_passes_a_lower_one(dtype, limit):
    """Only more confident boxes suppress a box, so those below a threshold change nothing above it."""
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        corner, sides = torch.rand(2, 1, 60, 2, generator=generator, dtype=dtype) * 30
        candidates = Candidates(
            torch.cat([corner, corner + sides], -1),
            torch.rand(1, 60, 3, generator=generator, dtype=dtype),
            torch.rand(1, 60, generator=generator, dtype=dtype),
        )
        low, high = (
            select(candidates, None, replace(Selection(limit=limit), threshold=threshold), "residual")
            for threshold in (0.02, 0.3)
        )
        place = (low.boxes[0][:, None] == candidates.boxes[0]).all(-1).float().argmax(-1)
        kept = candidates.confidence[0, place] >= 0.3
        assert kept.any()
        assert torch.equal(low.boxes[0, kept], high.boxes[0])
        assert torch.equal(low.scores[0, kept], high.scores[0])


def test_a_run_finds_the_looks_of_its_threshold_stored(tmp_path):
    config = ThresholdLooksConfig(
        data=DataConfig(limit=1),
        sensor=SensorConfig("published"),
        belief=BeliefConfig(columns=3, rows=2),
        cache=tmp_path,
        out=tmp_path,
        workers=1,
        thresholds=THRESHOLDS,
    )
    look_at_thresholds(config)
    for threshold in THRESHOLDS:
        own = replace(config, detector=DetectorConfig(threshold=threshold))
        stored, anew = Looking(own), Looking(replace(own, store=False))
        assert stored.store.load(stored.digest(0)).keys() == set(range(6))
        assert_same(stored.detections(0), anew.detections(0))

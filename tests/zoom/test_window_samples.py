"""Looks by magnification: labelled windows, and misses in them."""

import math

import pytest
import torch

from semfov.data.mosaics import Mosaics
from semfov.fit.observation import count_misses
from semfov.observation.matching import box_iou
from semfov.runs.config import DataConfig
from semfov.runs.setup import split_photographs
from semfov.zoom.lattice import Lattice
from train.fit_fom import FitFomConfig
from train.mosaic_samples import MosaicSampler, _choose_windows

pytestmark = pytest.mark.lab
LATTICE = Lattice.over((1024, 768), (128, 128))


def test_windows_are_of_all_magnifications():
    windows = _choose_windows(LATTICE, 5, 0, "scene")
    assert windows[0].tolist() == [0, 0, 0]
    assert torch.bincount(windows[:, 0]).tolist() == [1, *[5] * (LATTICE.levels - 1)]
    actions = set(map(tuple, LATTICE.actions.tolist()))
    assert all(tuple(window) in actions for window in windows.tolist())
    assert torch.equal(windows, _choose_windows(LATTICE, 5, 0, "scene"))
    assert not torch.equal(windows, _choose_windows(LATTICE, 5, 1, "scene"))
    assert LATTICE.octaves.tolist() == pytest.approx([-math.log2(m) for m in LATTICE.magnifications])
    assert Lattice.over((100, 100), (128, 128), finest=8.0).octaves.min() == 0


@pytest.fixture
def sampler(detector, monkeypatch, tmp_path):
    detector.classes = ("person", "cat", "cup")
    monkeypatch.setattr("semfov.runs.setup.load_detector", lambda name, **options: detector)
    monkeypatch.setattr("train.mosaic_samples.TILE", (160, 120))
    data = DataConfig(limit=3, min_instances=0, max_target_area=None)
    config = FitFomConfig(data=data, fixations=2, shard=1, mosaics=2, holdout=2)
    return MosaicSampler(config, tmp_path)


def test_every_nth_mosaic_is_made_of_held_out_photographs(sampler):
    config, classes = sampler.config, sampler.eye.detector.classes
    training, held = split_photographs(config.data, classes, config.holdout)
    assert len(sampler.scenes) == 2
    for index, photographs in enumerate((held, training)):
        own = Mosaics(photographs, 8, 6, tile=(160, 120), count=2, seed=config.seed)
        assert sampler.scenes.digest(index) == own.digest(index)
        assert torch.equal(sampler.scenes.annotation(index).boxes, own.annotation(index).boxes)


@pytest.mark.slow
def test_samples_are_detections_with_octaves(sampler):
    samples = sampler.sample(0)
    x, y, magnification = samples.fixations[samples.look].unbind(-1)
    torch.testing.assert_close(samples.distance, -magnification.log2().clamp(max=0))
    reach = 64 / magnification
    middle = (samples.boxes[:, :2] + samples.boxes[:, 2:]) / 2
    assert ((middle - torch.stack([x, y], -1)).abs() <= reach[:, None] + 1).all()
    annotation = sampler.scenes.annotation(0)
    for box, label in zip(samples.boxes, samples.labels, strict=True):
        overlaps = box_iou(box[None], annotation.boxes)[0] >= 0.5
        assert int(label) in {0, *annotation.labels[overlaps].tolist()}
    sampler.save(0, samples)
    assert torch.equal(sampler.load(0).boxes, samples.boxes)


@pytest.mark.slow
def test_misses_are_counted_in_the_cells_that_a_window_shows(sampler):
    samples, edges = sampler.sample(1), torch.tensor([1.5, 2.5])
    counts = count_misses(sampler.scenes, samples, {1}, edges, sampler.cells)
    size = sampler.scenes.annotation(1).size
    cells = torch.zeros(3, dtype=torch.long)
    for x, y, magnification in samples.fixations.tolist():
        lattice = Lattice.over(size, (128, 128))
        wide, high = size[0] / lattice.columns, size[1] / lattice.rows
        inside = sum(
            abs((column + 0.5) * wide - 0.5 - x) <= 64 / magnification
            and abs((row + 0.5) * high - 0.5 - y) <= 64 / magnification
            for row in range(lattice.rows)
            for column in range(lattice.columns)
        )
        cells[sum(-math.log2(magnification) > edge for edge in edges.tolist())] += inside
    # A cell with objects of two classes counts twice.
    assert (counts.total.sum(0) >= cells).all()
    assert counts.total[0].sum() < cells.sum()
    assert (counts.missed <= counts.total).all()
    assert len(samples.fixations) == 1 + 2 * (Lattice.over(size, (128, 128)).levels - 1)

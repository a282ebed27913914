"""Suppression of near-duplicate boxes by comparing neighbours, against torchvision, which compares all boxes."""

import numpy as np
import pytest
import torch
from torchvision.ops import nms

from semfov.detection.near_duplicates import distinct, neighbours, survivors


def crowd(count, seed, extent=400.0):
    """Boxes of very different sizes around a few places, also outside the image, so that many nearly coincide."""
    generator = np.random.default_rng(seed)
    places = generator.uniform(-50, extent, (max(count // 6, 1), 2))
    sizes = np.exp(generator.uniform(0, 6, (len(places), 2)))
    chosen = generator.integers(len(places), size=count)
    shift = generator.normal(0, 0.01, (count, 4)) * sizes[chosen][:, [0, 1, 0, 1]]
    corner = places[chosen]
    return (np.concatenate([corner, corner + sizes[chosen]], 1) + shift).astype(np.float32)


@pytest.mark.parametrize("iou", [0.9, 0.95, 0.99, 1.0])
@pytest.mark.parametrize("count", [1, 300])
def test_kept_boxes_equal_those_of_torchvision(count, iou):
    dropped = 0
    for seed in range(10):
        boxes = crowd(count, seed)
        expected = nms(torch.from_numpy(boxes), torch.arange(count, 0, -1.0), iou)
        assert distinct(boxes, iou).tolist() == expected.tolist()
        dropped += count - len(expected)
    assert (dropped > 0) == (count == 300 and iou < 1)


def test_without_boxes_no_boxes_are_kept():
    assert distinct(np.zeros((0, 4), np.float32), 0.95).tolist() == []


def test_neighbours_are_all_pairs_of_intersecting_intervals():
    generator = np.random.default_rng(0)
    start = np.sort(generator.uniform(0, 10, 40))
    end = start + generator.exponential(1.0, 40)
    expected = {(i, j) for i in range(40) for j in range(i + 1, 40) if start[j] <= end[i]}
    found = list(zip(*(index.tolist() for index in neighbours(start, end)), strict=True))
    assert len(found) == len(set(found))
    assert set(found) == expected


@pytest.mark.parametrize("count", [1, 2, 12, 60])
def test_survivors_are_those_of_removing_one_box_after_the_other(count):
    lengths = set()
    for seed in range(20):
        generator = np.random.default_rng(seed)
        pairs = generator.integers(count, size=(2 * count, 2))
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        better, worse = pairs.min(1), pairs.max(1)
        stays: list[int] = []
        for box in range(count):
            if not any(one in stays and other == box for one, other in zip(better, worse, strict=True)):
                stays.append(box)
        assert survivors(count, better, worse).tolist() == stays
        lengths.add(len(stays))
    assert (len(lengths) > 1) == (count > 1)

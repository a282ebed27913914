"""Neighbours along an axis, and suppression by pairs of boxes, against loops over all pairs."""

import numpy as np
import pytest

from semfov.detection.objects import neighbours, survivors


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

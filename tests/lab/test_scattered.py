"""Pictures of scattered objects and photographs: layout by seed, and boxes that fit the pixels."""

import pytest
import torch

from tests.refusals import refused
from tests.small import RedBoxes
from train.scattered import Scattered


def make(**changes):
    return Scattered(
        RedBoxes(), **({"size": (640, 360), "sides": (24, 40), "most": 12, "count": 4, "seed": 2} | changes)
    )


def test_a_picture_depends_only_on_seed_and_index():
    assert torch.equal(make()[1].image, make(count=9)[1].image)
    assert make().digest(1) == make(count=9).digest(1) != make().digest(0)
    assert make().fingerprint != make(count=9).fingerprint
    assert not torch.equal(make()[1].image, make(seed=3)[1].image)


@pytest.mark.parametrize("whole", [False, True])
def test_boxes_frame_the_red_pixels_and_nothing_else_is_red(whole):
    pictures = make(whole=whole, sides=(90, 140) if whole else (24, 40))
    found = 0
    for index in range(len(pictures)):
        scene = pictures[index]
        red, framed = scene.image[0] - scene.image[1] > 0.4, torch.zeros(360, 640).bool()
        for x1, y1, x2, y2 in scene.boxes.tolist():
            inner = red[round(y1) + 2 : round(y2) - 2, round(x1) + 2 : round(x2) - 2]
            assert inner.all()
            framed[max(round(y1) - 1, 0) : round(y2) + 1, max(round(x1) - 1, 0) : round(x2) + 1] = True
            found += 1
        assert not (red & ~framed).any()
    assert found > 8


def test_single_objects_stand_alone_in_their_photographs_and_apart_in_the_picture():
    pictures = make()
    assert set(pictures.alone) == {1}
    for index in range(len(pictures)):
        cutouts, told = pictures.cutouts(index), pictures.annotation(index)
        assert len(cutouts) == len(told.boxes) <= 12
        assert (told.labels == 1).all()
        assert pictures.targets(index) == ([1] if len(cutouts) else [])
        sides = (told.boxes[:, 2:] - told.boxes[:, :2]).amax(-1)
        # The margin is part of what is made as large as `sides`, give or take three tenths.
        assert bool(((sides > 0.7 * 24 / 1.4) & (sides < 1.3 * 40)).all())
        covered = torch.zeros(360, 640)
        for cutout in cutouts:
            x1, y1, x2, y2 = cutout.place
            assert 0 <= x1 < x2 <= 640
            assert 0 <= y1 < y2 <= 360
            covered[y1:y2, x1:x2] += 1
        assert covered.max() <= 1


def test_whole_photographs_keep_all_their_objects():
    pictures = make(whole=True, sides=(60, 90), most=3)
    for index in range(len(pictures)):
        cutouts, told = pictures.cutouts(index), pictures.annotation(index)
        assert len(told.boxes) == 3 * len(cutouts)
        assert len({cutout.scene for cutout in cutouts}) == len(cutouts)
        assert {cutout.part for cutout in cutouts} <= {(0, 0, 200, 150)}
    for wrong in ({"size": (8, 8)}, {"sides": (40, 24)}, {"most": 0}, {"count": 0}):
        refused(next(iter(wrong)), make, **wrong)

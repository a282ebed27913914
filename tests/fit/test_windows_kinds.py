"""Kinds of large pictures to fit on."""

import pytest
import torch

from semfov.fit.windows_evidence import ZoomExample
from semfov.zoom.lattice import Lattice
from tests.small import RedBoxes
from train.zoom_pictures import PICTURE_KINDS, _compose_pictures

SCENES = RedBoxes()
SIZES = {
    "few": (144, 108), "many": (288, 216), "one class": (192, 108), "photographs": (384, 216), "objects": (384, 216)
}  # fmt: skip


@pytest.mark.parametrize("kind", PICTURE_KINDS)
def test_pictures_of_a_kind_have_its_size_and_objects_and_depend_on_the_seed(kind):
    pictures = _compose_pictures(kind, SCENES, 3, 0, tile=48)
    assert len(pictures) == 3
    for index in range(3):
        assert pictures.annotation(index).size == SIZES[kind]
    assert sum(len(pictures.annotation(index).boxes) for index in range(3)) > 0
    assert pictures[0].size == SIZES[kind]
    assert _compose_pictures(kind, SCENES, 3, 1, tile=48).digest(0) != pictures.digest(0)
    assert _compose_pictures(kind, SCENES, 4, 0, tile=48).digest(0) == pictures.digest(0)


@pytest.mark.parametrize(("kind", "photographs"), [("few", 9), ("objects", 0)])
def test_windows_hold_one_for_each_photograph_of_a_mosaic(kind, photographs):
    pictures = _compose_pictures(kind, SCENES, 1, 0, tile=48)
    lattice = Lattice.over(SIZES[kind], (32, 32))
    assert sum(window.within is not None for window in ZoomExample.windows(pictures, 0, lattice)) == photographs


def test_objects_of_the_smallest_kinds_have_four_pixels_in_an_overview():
    """Of 416 px, in pictures of the default size."""
    pictures = _compose_pictures("objects", SCENES, 12, 0)
    told = [pictures.annotation(index).boxes for index in range(12)]
    sides = torch.cat([(boxes[:, 2:] - boxes[:, :2]).amax(-1) for boxes in told])
    assert 2 < float(sides.quantile(0.1)) * 416 / 3840 < 8

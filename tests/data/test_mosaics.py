"""Mosaics: layout by seed, and boxes that fit the pixels."""

import pytest
import torch

from semfov.data import Annotation, EmbeddedScenes
from semfov.data.mosaics import Mosaics

SCENES = EmbeddedScenes(("person", "cat", "cup"), count=5, seed=3)


def make(**changes):
    return Mosaics(SCENES, **({"columns": 2, "rows": 2, "tile": (320, 256), "count": 3, "seed": 1} | changes))


@pytest.mark.slow
def test_a_mosaic_depends_only_on_seed_and_index():
    assert torch.equal(make()[1].image, make(count=9)[1].image)
    assert make().fingerprint != make(seed=2).fingerprint
    assert [tile.scene for tile in make().tiles(0)] != [tile.scene for tile in make(seed=2).tiles(0)]
    assert make().digest(0) == make().digest(0) != make().digest(1)


def test_no_photograph_is_repeated_if_there_are_enough():
    for index in range(3):
        numbers = [tile.scene for tile in make().tiles(index)]
        assert len(set(numbers)) == 4
    assert sorted(tile.scene for tile in make(columns=5, rows=2).tiles(0)) == sorted([*range(5)] * 2)


def test_boxes_move_with_the_pixels_of_their_tile():
    mosaics = make(tile=(640, 500))
    scene = mosaics[0]
    assert scene.size == (1280, 1000)
    start = 0
    for tile in mosaics.tiles(0):
        x1, y1, x2, y2 = tile.box
        part = SCENES[tile.scene]
        assert (x2 - x1, y2 - y1) == part.size
        assert torch.equal(scene.image[:, y1:y2, x1:x2], part.image)
        stop = start + len(part.boxes)
        torch.testing.assert_close(scene.boxes[start:stop] - torch.tensor([x1, y1] * 2), part.boxes, rtol=0, atol=1e-3)
        assert torch.equal(scene.labels[start:stop], part.labels)
        start = stop
    assert start == len(scene.boxes)


def test_boxes_are_scaled_with_their_photographs():
    mosaics = make()
    annotation = mosaics.annotation(0)
    limit = torch.tensor([640.0, 512, 640, 512])
    assert (annotation.boxes >= 0).all()
    assert (annotation.boxes <= limit).all()
    tile = mosaics.tiles(0)[0]
    count = len(SCENES.annotation(tile.scene).boxes)
    corner = torch.tensor([*tile.box[:2], *tile.box[:2]])
    torch.testing.assert_close(annotation.boxes[:count], SCENES.annotation(tile.scene).boxes / 2 + corner)


class OneEach:
    """Photographs of 40 × 30 px, each of which shows one of three classes; one shows a fourth."""

    classes = ("a", "b", "c", "d")
    ids = tuple(range(13))
    fingerprint = "one each"

    def __len__(self):
        return len(self.ids)

    def annotation(self, index):
        label = torch.tensor([index % 3 + 1 if index < 12 else 4])
        return Annotation(torch.tensor([[5.0, 5, 20, 20]]), label, torch.tensor([False]), (40, 30))


def test_photographs_of_a_mosaic_can_share_a_class():
    shown = []
    for index in range(12):
        mosaics = Mosaics(OneEach(), 3, 2, tile=(40, 30), count=12, alike=True)
        labels = mosaics.annotation(index).labels
        assert len(labels) == 6
        assert len(set(labels.tolist())) == 1
        shown.append(int(labels[0]))
    # A single photograph of the fourth class is fewer than a quarter of the slots.
    assert set(shown) == {1, 2, 3}
    assert Mosaics(OneEach(), 3, 2, alike=True).fingerprint != Mosaics(OneEach(), 3, 2).fingerprint
    assert len(set(Mosaics(OneEach(), 3, 2, tile=(40, 30)).annotation(0).labels.tolist())) > 1

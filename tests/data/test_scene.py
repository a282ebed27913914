"""Scenes, those of a set that hold most objects, mosaics of them, and photographs without annotations."""

import hashlib

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from semfov.data import Annotation, EmbeddedScenes, Scene, box_coverage, legal_targets
from semfov.data.mosaics import Mosaics
from semfov.data.pictures import Pictures
from semfov.fit.windows import crowded
from tests.refusals import refused, unusable


@st.composite
def integer_boxes(draw):
    width, height = draw(st.integers(1, 30)), draw(st.integers(1, 30))
    boxes = []
    for _ in range(draw(st.integers(0, 8))):
        x1, y1 = draw(st.integers(0, width - 1)), draw(st.integers(0, height - 1))
        boxes.append((x1, y1, draw(st.integers(x1 + 1, width)), draw(st.integers(y1 + 1, height))))
    return np.array(boxes, dtype=np.int64).reshape(-1, 4), (width, height)


@given(integer_boxes())
def test_coverage_equals_counts_on_a_pixel_grid(case):
    boxes, (width, height) = case
    grid = np.zeros((height, width), dtype=int)
    for x1, y1, x2, y2 in boxes:
        grid[y1:y2, x1:x2] += 1
    tensor = torch.tensor(boxes, dtype=torch.float32)
    assert box_coverage(tensor, (width, height), "sum") == grid.sum() / grid.size
    assert box_coverage(tensor, (width, height), "union") == pytest.approx((grid > 0).mean(), abs=1e-12)


def test_a_target_that_covers_exactly_the_limit_is_legal_and_a_size_is_width_and_height():
    boxes = torch.tensor(
        [[0.0, 0.0, 128.0, 480.0], [0.0, 0.0, 129.0, 480.0]]
    )  # exactly 20 % of 640 x 480, and slightly more
    scene = Annotation(boxes, torch.tensor([2, 5]), torch.zeros(2, dtype=torch.bool), (640, 480))
    assert legal_targets(scene, 0.2) == [2]
    assert legal_targets(scene, None) == [2, 5]
    assert Scene(1, "a", torch.zeros(3, 4, 6), torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64)).size == (6, 4)


def test_no_scene_that_is_left_out_holds_more_objects_than_one_that_is_kept():
    scenes = EmbeddedScenes(("person", "boat", "dog"), count=9, seed=3)
    most = crowded(scenes, 0.4)
    counts = {name: len(scenes.annotation(index).boxes) for index, name in enumerate(scenes.ids)}
    assert len(most) == len(most.ids) == 4  # 3.6 rounded up
    assert len(set(counts.values())) > 1
    left = [counts[name] for name in scenes.ids if name not in most.ids]
    assert min(counts[name] for name in most.ids) >= max(left)
    assert most.ids == sorted(most.ids)


def test_a_scene_is_that_of_the_set():
    scenes = EmbeddedScenes(("person", "boat", "dog"), count=6, seed=3)
    most = crowded(scenes, 0.5)
    for index, name in enumerate(most.ids):
        place = scenes.ids.index(name)
        assert torch.equal(most[index].image, scenes[place].image)
        assert torch.equal(most.annotation(index).boxes, scenes.annotation(place).boxes)
        assert most.targets(index) == scenes.targets(place)
        assert most.digest(index) == scenes.digest(place)
    assert most.classes == scenes.classes
    assert len({most.fingerprint, scenes.fingerprint, crowded(scenes, 0.3).fingerprint}) == 3


def test_coverages_and_shares_out_of_range_are_refused():
    refused("coverage", box_coverage, torch.zeros(1, 4), (4, 4), "mean")
    refused("boxes", box_coverage, torch.zeros(4, 3), (4, 4))
    for share in [0.0, -0.1, 1.5, float("nan")]:
        refused("share: expected above 0", crowded, EmbeddedScenes(("person",), count=2), share)


SCENES = EmbeddedScenes(("person", "truck", "boat"), count=5, seed=3)


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
    whole = EmbeddedScenes(("person", "truck", "boat"), count=1)  # a photograph that fits the tiles as it is
    mosaics = Mosaics(whole, 2, 2, tile=(640, 520), count=1)
    scene = mosaics[0]
    assert scene.size == (1280, 1040)
    start = 0
    for tile in mosaics.tiles(0):
        x1, y1, x2, y2 = tile.box
        part = whole[tile.scene]
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
    own = SCENES.annotation(tile.scene)
    x1, y1, x2, y2 = tile.box
    scale = torch.tensor([(x2 - x1) / own.size[0], (y2 - y1) / own.size[1]] * 2)
    assert float(scale.min()) == pytest.approx(float(scale.max()), rel=0.01)
    expected = own.boxes * scale + torch.tensor([x1, y1] * 2)
    torch.testing.assert_close(annotation.boxes[: len(own.boxes)], expected, atol=1e-3, rtol=0)


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


@pytest.fixture
def folder(tmp_path):
    for number, name in enumerate(("b.png", "a.png")):
        Image.new("RGB", (8 + number, 6), (255 * number, 0, 0)).save(tmp_path / name)
    return tmp_path


def test_pictures_are_sorted_by_name_lie_in_the_folder_and_have_digests_of_their_content(folder):
    pictures = Pictures(folder, ["b.png", "a.png", "b.png"], ("person", "cup"))
    assert pictures.ids == ["a.png", "b.png"]
    assert [pictures[index].image.shape for index in range(2)] == [(3, 6, 9), (3, 6, 8)]
    assert pictures[0].image[0].eq(1).all()
    assert pictures.annotation(0).size == (9, 6)
    assert torch.equal(pictures.annotation(0).boxes, torch.zeros(0, 4))
    assert pictures.targets(0) == []
    for name in ["missing.png", "../a.png"]:
        unusable(r"missing\.png|leads out", Pictures, folder, ["a.png", name], ("person",))
    pictures = Pictures(folder, ["a.png", "b.png"], ("person",))
    assert pictures.digest(0) == hashlib.sha256((folder / "a.png").read_bytes()).hexdigest()
    before = pictures.fingerprint
    assert before == Pictures(folder, ["b.png", "a.png"], ("person",)).fingerprint
    (folder / "b.png").write_bytes((folder / "a.png").read_bytes())
    assert pictures.fingerprint != before

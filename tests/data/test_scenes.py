"""The embedded photographs, the scenes that are made of them, and the sheet of all."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from semfov.data import CocoScenes, EmbeddedScenes, example
from semfov.data.examples import EXAMPLES, example_scene, example_with
from semfov.data.scene import Annotation
from semfov.data.scenes import CLASSES, FOLDER, PHOTOGRAPHS, _Part, _Photograph
from tests.refusals import refused

COUNT = 20
RECORD = json.loads((FOLDER / "photographs.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def scenes():
    return EmbeddedScenes(CLASSES, count=COUNT)


def test_every_photograph_has_a_source_and_no_known_copyright_restrictions():
    (licence,) = RECORD["licenses"]
    assert licence["name"] == "No known copyright restrictions"
    assert sorted(path.name for path in FOLDER.glob("*.jpg")) == sorted(each["file_name"] for each in RECORD["images"])
    told = (FOLDER / "README.md").read_text(encoding="utf-8")
    for each in RECORD["images"]:
        assert each["license"] == licence["id"]
        assert "staticflickr.com" in each["flickr_url"]
        assert each["flickr_url"] in told
    assert "CC BY 4.0" in told
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) <= 600_000


def test_the_first_scenes_are_the_photographs_as_a_data_set_in_cocos_format_reads_them(scenes):
    coco = CocoScenes(FOLDER, FOLDER / "photographs.json", CLASSES, min_instances=1, max_target_area=None)
    files = {scene.name: (scene, coco.annotation(index)) for index, scene in enumerate(map(coco.__getitem__, range(5)))}
    for index, photograph in enumerate(PHOTOGRAPHS):
        scene, annotation = scenes[index], scenes.annotation(index)
        other, told = files[f"{photograph.name}.jpg"]
        assert scene.name == photograph.name
        assert torch.equal(scene.image, other.image)
        assert annotation.size == told.size == scene.size
        assert torch.equal(scene.boxes, annotation.boxes)
        order, others = (np.lexsort(boxes.numpy().round(1).T) for boxes in (annotation.boxes, told.boxes))
        torch.testing.assert_close(annotation.boxes[order], told.boxes[others], atol=0.011, rtol=0)
        assert torch.equal(annotation.labels[order], told.labels[others])
        assert torch.equal(annotation.crowd[order], told.crowd[others])


def test_boxes_lie_in_their_scene_and_there_is_something_to_search_for(scenes):
    for index in range(COUNT):
        annotation = scenes.annotation(index)
        width, height = annotation.size
        x1, y1, x2, y2 = annotation.boxes.unbind(-1)
        assert bool(((x1 >= 0) & (x1 < x2) & (x2 <= width)).all())
        assert bool(((y1 >= 0) & (y1 < y2) & (y2 <= height)).all())
        assert scenes.targets(index)
        whole = PHOTOGRAPHS[index % len(PHOTOGRAPHS)].objects.size
        assert all(0.59 <= part / side <= 1 for part, side in zip(annotation.size, whole, strict=True))


@given(st.data(), st.booleans())
def test_boxes_of_a_part_follow_the_pixels(data, mirrored):
    """A picture that is white only in its boxes is white in the part only in the boxes of the part."""
    boxes = torch.tensor([[3.0, 4.0, 9.0, 12.0], [20.0, 2.0, 31.0, 8.0]])
    pixels = np.zeros((30, 40), np.uint8)
    for x1, y1, x2, y2 in boxes.int().tolist():
        pixels[y1:y2, x1:x2] = 255
    left, top = data.draw(st.integers(0, 12)), data.draw(st.integers(0, 8))
    right, bottom = data.draw(st.integers(left + 15, 40)), data.draw(st.integers(top + 10, 30))
    objects = Annotation(boxes, torch.tensor([1, 2]), torch.tensor([False, False]), (40, 30))
    part = _Part(_Photograph("white", objects), (left, top, right, bottom), mirrored).objects()
    shown = Image.fromarray(pixels).crop((left, top, right, bottom))
    shown = np.asarray(shown)[:, ::-1] if mirrored else np.asarray(shown)
    drawn = np.zeros_like(shown)
    for x1, y1, x2, y2 in part.boxes.int().tolist():
        drawn[y1:y2, x1:x2] = 255
    seen = [
        pixels[max(top, y1) : min(bottom, y2), max(left, x1) : min(right, x2)].size / ((x2 - x1) * (y2 - y1))
        for x1, y1, x2, y2 in boxes.int().tolist()
    ]
    assert part.labels.tolist() == [label for label, share in zip((1, 2), seen, strict=True) if share >= 0.5]
    assert bool((drawn <= shown).all())
    if all(share >= 0.5 or share == 0 for share in seen):
        assert np.array_equal(drawn, shown)


def test_images_are_the_pixels_of_their_parts(scenes):
    for index in (5, 9, 12):
        part = scenes.part(index)
        shown = Image.open(part.photograph.path).convert("RGB").crop(part.box)
        shown = np.asarray(shown)[:, ::-1] if part.mirrored else np.asarray(shown)
        image = scenes[index].image
        assert np.array_equal((image * 255).round().byte().permute(1, 2, 0).numpy(), shown)
        image.zero_()  # it is a copy
        assert scenes[index].image.any()


@pytest.mark.slow
def test_a_seed_gives_the_same_scenes_in_another_process(fresh, scenes):
    program = (
        "from semfov.data import EmbeddedScenes\n"
        f"s = EmbeddedScenes({CLASSES!r}, count={COUNT})\n"
        "print(s.fingerprint, s.digest(5), s.digest(1), s.part(7).box)"
    )
    assert fresh(program) == f"{scenes.fingerprint} {scenes.digest(5)} {scenes.digest(1)} {scenes.part(7).box}\n"


def test_digests_are_of_the_parts_whatever_the_number_of_scenes(scenes):
    few = EmbeddedScenes(CLASSES, count=2)
    assert [few.digest(0), few.digest(1)] == [scenes.digest(0), scenes.digest(1)]
    assert few.fingerprint != scenes.fingerprint
    other = EmbeddedScenes(CLASSES, count=2, seed=1)
    assert len({each.digest(index) for each in (few, other) for index in range(2)}) == 4
    assert len({scenes.digest(index) for index in range(COUNT)}) == COUNT


def test_objects_of_classes_unknown_to_the_detector_have_no_box():
    scenes = EmbeddedScenes(("zebra", "aeroplane", "dog"), count=5)
    assert [scenes.annotation(index).labels.tolist() for index in range(5)] == [[3], [], [], [2], [3]]
    refused("classes: expected at least one of airplane, boat, car, dog", EmbeddedScenes, ("zebra",))


def test_bad_arguments(scenes):
    refused("count", EmbeddedScenes, CLASSES, count=0)
    refused("seed", EmbeddedScenes, CLASSES, seed=-1)
    refused("unknown example 'beech'; did you mean 'beach'", example, "beech")
    with pytest.raises(IndexError):
        EmbeddedScenes(CLASSES, count=2)[2]


def test_the_sheet_shows_every_photograph_with_its_objects():
    sheet = example_scene("sheet", CLASSES)
    assert torch.equal(sheet.image, example("sheet"))
    width, height = sheet.size
    assert min(width, height) > 2 * 416
    assert len(sheet.boxes) == sum(int((~each.objects.crowd).sum()) for each in PHOTOGRAPHS)
    # The patch in each box is that of the object's photograph.
    left = {(label, *box) for box, label in zip(sheet.boxes.tolist(), sheet.labels.tolist(), strict=True)}
    for photograph in PHOTOGRAPHS:
        image = example(photograph.name)
        objects, single = photograph.objects, ~photograph.objects.crowd
        for box, label in zip(objects.boxes[single].tolist(), objects.labels[single].tolist(), strict=True):
            x1, y1, x2, y2 = map(int, box)
            there = [
                each
                for each in left
                if each[0] == label
                and np.allclose([each[3] - each[1], each[4] - each[2]], [box[2] - box[0], box[3] - box[1]], atol=1e-3)
                and torch.equal(
                    sheet.image[:, int(each[2]) : int(each[2]) + y2 - y1, int(each[1]) : int(each[1]) + x2 - x1],
                    image[:, y1:y2, x1:x2],
                )
            ]
            assert there
            left.remove(there[0])
    assert not left


def test_an_example_is_chosen_by_its_class():
    assert [example_with(name, ("person", "lorry", *CLASSES)) for name in (None, "dog", "horse", "aeroplane")] == [
        "beach", "beach", "farm", "aeroplane",
    ]  # fmt: skip
    assert set(EXAMPLES) == {*(each.name for each in PHOTOGRAPHS), "sheet"}
    said = r"come with semfov \(dog, person\), got 'cup'; give a photograph"
    refused(said, example_with, "cup", ("person", "cup", "dog"))

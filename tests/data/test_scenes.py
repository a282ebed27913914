import hashlib

import numpy as np
import pytest
import torch
from PIL import Image

from semfov.data import EmbeddedScenes
from semfov.data import scenes as module
from semfov.data.scenes import _DISTRACTORS, _PHOTOGRAPHED_OBJECTS, _TEXTURES
from tests.refusals import refused, unusable

CLASSES = ("person", "motorbike", "cat", "cup")
COUNT = 40


@pytest.fixture(scope="module", autouse=True)
def composed():
    """Compose scenes anew each time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EmbeddedScenes, "_pixels", EmbeddedScenes._pixels.__wrapped__)
        yield


@pytest.fixture(scope="module")
def scenes():
    return EmbeddedScenes(CLASSES, count=COUNT)


def test_shapes(scenes):
    assert len(scenes) == COUNT
    assert scenes.ids == list(range(COUNT))
    scene = scenes[3]
    assert scene.image.shape == (3, 480, 640)
    assert scene.image.dtype == torch.float32
    assert scene.image.min() >= 0
    assert scene.image.max() <= 1
    assert scene.size == (640, 480)
    assert scene.name == "search array 3, seed 0"
    assert [s.id for s in EmbeddedScenes(CLASSES, count=2)] == [0, 1]


def test_patches_do_not_overlap_and_lie_inside_the_scene(scenes):
    for index in range(COUNT):
        taken = np.zeros((480, 640), dtype=int)
        items = scenes.items(index)
        assert len(items) == 10
        for item in items:
            x1, y1, x2, y2 = item.patch
            assert 0 <= x1 < x2 <= 640
            assert 0 <= y1 < y2 <= 480
            taken[y1:y2, x1:x2] += 1
        assert taken.max() == 1


def test_boxes_lie_in_their_patches_labels_name_their_objects_and_all_are_legal_targets(scenes):
    for index in range(COUNT):
        annotation = scenes.annotation(index)
        objects = [item for item in scenes.items(index) if item.photograph.label]
        assert len(objects) == len(annotation.boxes) == 5
        for item, box, label in zip(objects, annotation.boxes.tolist(), annotation.labels.tolist(), strict=True):
            assert CLASSES[label - 1].replace("motorbike", "motorcycle") == item.photograph.label
            x1, y1, x2, y2 = item.patch
            assert x1 <= box[0] < box[2] <= x2
            assert y1 <= box[1] < box[3] <= y2
            assert (box[2] - box[0]) * (box[3] - box[1]) >= 0.4 * (x2 - x1) * (y2 - y1)
    for index in range(COUNT):
        annotation = scenes.annotation(index)
        assert scenes.targets(index) == sorted(set(annotation.labels.tolist()))
        for label in scenes.targets(index):
            x1, y1, x2, y2 = annotation.boxes[annotation.labels == label].unbind(-1)
            assert ((x2 - x1) * (y2 - y1)).sum() <= 0.2 * 640 * 480


def test_mirrored_boxes_follow_the_pixels():
    """Checked on a photograph that is white only inside the box of its object."""
    photograph = module._Photograph("test", "skimage", "test.png", (10, 20, 110, 80), "cat", (30, 25, 60, 75))
    pixels = np.zeros((100, 120), np.uint8)
    pixels[25:75, 30:60] = 255
    patch = Image.fromarray(pixels).crop(photograph.crop).resize((50, 30), Image.Resampling.BOX)
    for mirrored in (False, True):
        shown = np.asarray(patch)[:, ::-1] if mirrored else np.asarray(patch)
        rows, columns = np.nonzero(shown > 127)
        box = module._Item(photograph, (200, 100, 250, 130), mirrored).box()
        seen = (columns.min() + 200, rows.min() + 100, columns.max() + 201, rows.max() + 101)
        assert np.abs(np.subtract(box, seen)).max() <= 0.5


def test_patches_show_their_photographs(scenes):
    scene, items = scenes[0], scenes.items(0)
    for item in items:
        x1, y1, x2, y2 = item.patch
        path = module._path(item.photograph.package, item.photograph.file)
        source = Image.open(path).convert("RGB").crop(item.photograph.crop)
        expected = np.asarray(source.resize((x2 - x1, y2 - y1), Image.Resampling.BICUBIC)).astype(float)
        expected = expected[:, ::-1] if item.mirrored else expected
        shown = scene.image[:, y1:y2, x1:x2].permute(1, 2, 0).numpy() * 255
        assert abs(shown - expected).mean() < 6


def test_boxes_lie_in_their_crops():
    for photograph in _PHOTOGRAPHED_OBJECTS + _DISTRACTORS:
        left, top, right, bottom = photograph.crop
        with Image.open(module._path(photograph.package, photograph.file)) as image:
            assert 0 <= left < right <= image.width
            assert 0 <= top < bottom <= image.height
        if photograph.label:
            x1, y1, x2, y2 = photograph.box
            assert left <= x1 < x2 <= right
            assert top <= y1 < y2 <= bottom


def test_photographs_are_files_of_the_installed_packages():
    from importlib.metadata import files

    carried = {str(f) for name in ("scikit-image", "matplotlib") for f in files(name)}
    for photograph in _PHOTOGRAPHED_OBJECTS + _DISTRACTORS:
        assert f"{photograph.package}/{module._FOLDERS[photograph.package]}/{photograph.file}" in carried
    assert all(f"skimage/data/{texture}" in carried for texture in _TEXTURES)


@pytest.mark.slow
def test_a_seed_gives_bit_identical_scenes_in_another_process(fresh, scenes):
    program = (
        "from semfov.data import EmbeddedScenes\n"
        f"s = EmbeddedScenes({CLASSES!r}, count={COUNT})\n"
        "print(s.fingerprint, s.digest(5), s.digest(1))"
    )
    assert fresh(program).split() == [scenes.fingerprint, scenes.digest(5), scenes.digest(1)]
    assert torch.equal(scenes[5].image, scenes[5].image)


def test_digests_are_of_the_pixels_whatever_the_number_of_scenes(scenes):
    pixels = (scenes[2].image * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
    assert scenes.digest(2) == hashlib.sha256(pixels.tobytes()).hexdigest()
    few = EmbeddedScenes(CLASSES, count=2)
    assert few.digest(1) == scenes.digest(1)
    assert few.fingerprint != scenes.fingerprint
    other = EmbeddedScenes(CLASSES, count=2, seed=1)
    assert len({few.digest(0), few.digest(1), other.digest(0), other.digest(1)}) == 4


def test_objects_of_classes_unknown_to_the_detector_have_no_box():
    scenes = EmbeddedScenes(("dog", "cat"), count=6)
    for index in range(6):
        assert set(scenes.annotation(index).labels.tolist()) <= {2}
    assert any(scenes.targets(index) == [2] for index in range(6))
    refused("classes: expected at least one of cat, cup, motorcycle, person", EmbeddedScenes, ("zebra",))


def test_bad_arguments_and_missing_files(monkeypatch):
    refused("count", EmbeddedScenes, CLASSES, count=0)
    refused("seed", EmbeddedScenes, CLASSES, seed=-1)
    with pytest.raises(IndexError):
        EmbeddedScenes(CLASSES, count=2)[2]
    monkeypatch.setitem(module._FOLDERS, "skimage", "elsewhere")
    unusable(r"expected the photograph .* pip install", EmbeddedScenes, CLASSES)
    monkeypatch.setattr(module, "find_spec", lambda _: None)
    unusable(r"expected the package .*, got none, as it is not installed; pip install", EmbeddedScenes, CLASSES)

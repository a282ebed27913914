"""Annotation files in COCO's format: errors name the entry and the field, and what is right becomes scenes."""

import copy
import hashlib
import json
import logging
import pickle
import re
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from PIL.PngImagePlugin import PngImageFile

from semfov import CocoScenes, DataError, read_image
from semfov.data.annotations import read_annotations, warn_of_form
from semfov.data.coco import _Packed
from tests.refusals import refused, unusable

CLASSES = ("cat", "person", "tvmonitor")  # in another order than in the file, and with the spelling of Darknet
BOXES = [
    (20, "cat", (0, 0, 10, 10)),
    (10, "person", (1, 2, 3, 4)),
    (10, "tv", (5, 6, 20, 20)),
    (10, "cat", (30.5, 20.25, 4, 4)),
]
ALL = {"min_instances": 0, "max_target_area": None}


def test_index_and_digest(make_coco, capsys):
    path = make_coco(BOXES)
    file = read_annotations(path)
    assert file.digest == hashlib.sha256(path.read_bytes()).hexdigest()
    assert sorted(file.images) == [10, 20, 30]
    assert [each["bbox"] for each in file.objects[10]] == [
        [1, 2, 3, 4],
        [5, 6, 20, 20],
        [30.5, 20.25, 4, 4],
    ]
    assert capsys.readouterr().out == ""


def test_ids_may_be_strings(make_coco, coco_dict):
    data = coco_dict(BOXES)
    for image in data["images"]:
        image["id"] = str(image["id"])
    for annotation in data["annotations"]:
        annotation["image_id"] = str(annotation["image_id"])
    file = read_annotations(make_coco(data=data))
    assert sorted(file.images) == ["10", "20", "30"]


def test_what_nothing_depends_on_is_not_needed(make_coco, coco_dict):
    """Ids of objects, areas, `iscrowd` and sizes of images; whole numbers may be written as 7.0, names as in LVIS."""
    data = coco_dict(BOXES)
    whole = read_annotations(make_coco(data=data))
    for entry in data["annotations"]:
        entry |= {"area": None, "iscrowd": None, "image_id": float(entry["image_id"])}
        del entry["id"]
    for image in data["images"]:
        image |= {"id": float(image["id"]), "coco_url": f"http://localhost/val/{image['file_name']}", "width": None}
        del image["file_name"], image["height"]
    file = read_annotations(make_coco(data=data))
    assert file.objects == whole.objects
    assert {type(each) for each in file.objects} == {int}
    assert [each["file_name"] for each in file.images.values()] == ["30.png", "10.png", "20.png"]
    assert [file.size(10), whole.size(10)] == [None, (40, 30)]


def test_scenes_need_the_sizes_of_images(photographs, make_coco, coco_dict):
    data = coco_dict(BOXES)
    del data["images"][1]["width"]
    unusable("expected width and height of image 10", CocoScenes, photographs, make_coco(data=data), CLASSES, **ALL)


MISSING = object()
FAULTS = [
    (("images",), MISSING, "expected images to be a list, got nothing"),
    (("annotations",), MISSING, "expected annotations to be a list, got nothing"),
    (("categories",), MISSING, "expected categories to be a list, got nothing"),
    (("images",), {}, "expected images to be a list, got {}"),
    (("images", 1), 5, r"images\[1\]: expected an object, got 5"),
    (
        ("images", 1, "id"),
        MISSING,
        r"images\[1\]: expected id to be an integer or a string .*, got nothing",
    ),
    (("images", 1, "id"), True, "expected id to be an integer or a string without control characters, got True"),
    (("images", 1, "id"), 1.5, "expected id to be an integer or a string without control characters, got 1.5"),
    (("images", 1, "id"), 30, r"images\[1\]: expected unique ids, got id 30 more than once"),
    (("images", 2, "id"), "twenty", "expected ids of one kind"),
    (
        ("images", 0, "file_name"),
        MISSING,
        r"images\[0\]: expected file_name to be a string .*, got nothing",
    ),
    (("images", 0, "file_name"), "", "expected file_name to be a string without control characters, got ''"),
    (("images", 0, "width"), 0, "expected width to be a whole number of pixels, got 0"),
    (("images", 0, "height"), "30.5", "expected height to be a whole number of pixels, got '30.5'"),
    (("images", 0, "width"), 1e308, "expected width to be a whole number of pixels, got 1e\\+308"),
    (("images", 0, "height"), 30.5, "expected height to be a whole number of pixels, got 30.5"),
    (
        ("categories", 0, "name"),
        None,
        r"categories\[0\]: expected name to be a string .*, got None",
    ),
    (("categories", 1, "id"), 3, r"categories\[1\]: expected unique ids, got id 3 more than once"),
    (("categories", 1, "id"), "three", "categories: expected ids of one kind"),
    (("images", 0, "neg_category_ids"), [3, None], "expected neg_category_ids to be a list of ids of categories"),
    (("annotations", 0, "image_id"), 99, "expected image_id to be the id of one of the images, got 99"),
    (("annotations", 0, "image_id"), [10], r"expected image_id to be the id of one of the images, got \[10\]"),
    (("annotations", 0, "category_id"), MISSING, "expected category_id to be the id of one of the categories"),
    (("annotations", 0, "bbox"), MISSING, r"annotations\[0\]: expected bbox .* got nothing"),
    (("annotations", 0, "bbox"), [1, 2, 3], "expected bbox"),
    (("annotations", 0, "bbox"), [1, 2, 3, float("nan")], "expected bbox .* finite"),
    (("annotations", 0, "bbox"), [1, 2, 3, 10**400], "expected bbox .* finite"),
    (("annotations", 0, "bbox"), [1, 2, -3, 4], "expected bbox .* size of at least 0"),
    (("annotations", 0, "bbox"), [1, 2, "3 px", 4], "expected bbox .* got .*'3 px'"),
    (("annotations", 0, "iscrowd"), 2, "expected iscrowd to be 0 or 1, got 2"),
]


@pytest.mark.parametrize(("where", "value", "message"), FAULTS)
def test_errors_name_the_entry_and_the_field(make_coco, coco_dict, where, value, message):
    data = copy.deepcopy(coco_dict(BOXES))
    entry = data
    for key in where[:-1]:
        entry = entry[key]
    if value is MISSING:
        del entry[where[-1]]
    else:
        entry[where[-1]] = value
    unusable(rf"instances\.json: .*{message}.*; correct or replace the file", read_annotations, make_coco(data=data))


def test_what_is_no_file_of_annotations_is_refused(tmp_path, make_coco):
    unusable(r"no\.json: no such file; check the path", read_annotations, tmp_path / "no.json")
    unusable("expected a file, got a folder", read_annotations, tmp_path)
    for text in [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000, b"1" * 10_000]:
        (tmp_path / "a.json").write_bytes(text)
        unusable(r"a\.json: cannot be read as JSON", read_annotations, tmp_path / "a.json")
    for name, text, remedy in (
        ("labels.txt", "0 .5 .5 .1 .1", "labels of YOLO; supervision"),
        ("data.yaml", "names: [cup]", "labels of YOLO; supervision"),
        (
            "export.json",
            '[{"id": 1, "data": {"image": "a.jpg"}, "annotations": []}]',
            "tasks of Label Studio, whose menu",
        ),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(DataError, match=remedy):
            read_annotations(tmp_path / name)
    unusable("labels of YOLO", read_annotations, tmp_path)  # the folder of its labels
    unusable(r"nosuch\.txt: no such file", read_annotations, tmp_path / "nosuch.txt")
    whole = tmp_path / "a.txt"
    whole.write_bytes(make_coco().read_bytes())
    assert read_annotations(whole).images
    with pytest.raises(DataError, match=r"expected an object with images, annotations and categories, got \[\]"):
        read_annotations(make_coco(data=[]))


def test_long_and_deeply_nested_values_are_refused_in_a_short_message(make_coco, coco_dict, tmp_path):
    data = coco_dict(BOXES)
    data["images"][0]["width"] = "x" * 10_000
    with pytest.raises(DataError) as caught:
        read_annotations(make_coco(data=data))
    assert len(str(caught.value)) < 300
    data = coco_dict(BOXES)
    data["images"][0]["width"] = "HERE"
    text = json.dumps(data).replace('"HERE"', "[" * 900 + "]" * 900)
    (tmp_path / "deep.json").write_text(text)
    unusable(r"deep\.json", read_annotations, tmp_path / "deep.json")


@pytest.fixture
def scenes(photographs, make_coco):
    return CocoScenes(photographs, make_coco(BOXES), CLASSES, **ALL)


def test_boxes_labels_and_ids_with_and_without_pixels(scenes, photographs):
    assert scenes.ids == [10, 20, 30]
    assert len(scenes) == 3
    first = scenes[0]
    assert (first.id, first.name, first.size) == (10, "10.png", (40, 30))
    assert first.boxes.tolist() == [[1, 2, 4, 6], [5, 6, 25, 26], [30.5, 20.25, 34.5, 24.25]]
    assert first.labels.tolist() == [2, 3, 1]
    assert first.boxes.dtype == torch.float32
    assert first.labels.dtype == torch.int64
    assert torch.equal(first.image, read_image(photographs / "10.png"))
    assert scenes[2].boxes.shape == (0, 4)
    assert not scenes.repairs
    for index in range(3):
        annotation, scene = scenes.annotation(index), scenes[index]
        assert torch.equal(annotation.boxes, scene.boxes)
        assert torch.equal(annotation.labels, scene.labels)
        assert annotation.size == scene.size
    scenes.annotation(0).boxes.zero_()
    assert scenes.annotation(0).boxes.any()


def test_images_are_selected_by_number_of_boxes_and_area(photographs, make_coco):
    # 10: 8 boxes, one class has small boxes only; 20: 7 boxes; 30: 8 boxes, but its only class covers too much area
    boxes = [(10, "person", (i, 0, 2, 2)) for i in range(7)] + [(10, "tv", (0, 0, 40, 20))]
    boxes += [(20, "person", (i, 0, 2, 2)) for i in range(7)]
    boxes += [(30, "cat", (i, 0, 10, 10)) for i in range(8)]
    file = make_coco(boxes)
    scenes = CocoScenes(photographs, file, CLASSES)
    assert scenes.ids == [10]
    assert scenes.targets(0) == [2]
    assert CocoScenes(photographs, file, CLASSES, min_instances=7).ids == [10, 20]
    assert CocoScenes(photographs, file, CLASSES, max_target_area=None).ids == [10, 30]
    assert CocoScenes(photographs, file, CLASSES, max_target_area=0.2, coverage="union").ids == [10, 30]
    assert CocoScenes(photographs, file, CLASSES, min_instances=1, max_target_area=None, limit=2).ids == [10, 20]
    unusable(
        "images with at least 9 boxes .* got none among 3", CocoScenes, photographs, file, CLASSES, min_instances=9
    )


def test_repairs_are_counted_and_reported_once(photographs, make_coco, caplog):
    boxes = [
        (10, "cat", (-5, -5, 10, 10)),
        (10, "cat", (35, 25, 10, 10)),
        (10, "cat", (30, 20, 10.004, 10)),  # rounding of the official files
        (10, "cat", (3, 3, 0, 5)),
        (10, "cat", (50, 3, 5, 5)),
        (10, "person", (0, 0, 9, 9), {"iscrowd": 1}),
    ]
    with caplog.at_level(logging.WARNING):
        scenes = CocoScenes(photographs, make_coco(boxes), CLASSES, min_instances=1, crowd="drop")
    assert scenes.repairs == {
        "boxes without area in the image, dropped": 2,
        "boxes cut to the image": 2,
        "boxes of crowds, dropped": 1,
    }
    assert len(caplog.records) == 1
    assert "boxes cut to the image: 2" in caplog.text
    assert scenes.annotation(0).boxes.tolist() == [[0, 0, 5, 5], [35, 25, 40, 30], [30, 20, 40, 30]]
    assert CocoScenes(photographs, make_coco(boxes), CLASSES, min_instances=1).annotation(0).crowd.tolist() == [
        False,
        False,
        False,
        True,
    ]


def test_boxes_that_are_dropped_are_counted(photographs, make_coco):
    boxes = [(10, "person", (i, 0, 2, 2)) for i in range(4)] + [(10, "cat", (i, 9, 2, 2)) for i in range(4)]
    scenes = CocoScenes(photographs, make_coco(boxes), ("cat",))
    assert scenes.ids == [10]
    assert scenes.annotation(0).labels.tolist() == [1] * 4
    assert scenes.repairs == {"boxes of 'person', which the detector does not know, dropped": 4}
    scenes = CocoScenes(photographs, make_coco([(10, "cat", (30, 20, 1e-9, 5))]), CLASSES, **ALL)
    assert scenes.annotation(0).boxes.shape == (0, 4)
    assert scenes.repairs == {"boxes without area in the image, dropped": 1}


def test_a_missing_image_is_an_error_only_if_it_is_used(photographs, make_coco, coco_dict):
    data = coco_dict(BOXES)
    data["images"][0]["file_name"] = "gone.png"
    with pytest.raises(DataError, match=r"gone\.png: no such file \(1 of 3 are missing\); check data\.root"):
        CocoScenes(photographs, make_coco(data=data), CLASSES, **ALL)
    only = CocoScenes(photographs, make_coco(data=data), CLASSES, min_instances=1, max_target_area=None)
    data["images"][0]["file_name"] = "n" * 300  # longer than names of files may be
    unusable(r"nnn: no such file \(1 of 3", CocoScenes, photographs, make_coco(data=data), CLASSES, **ALL)
    assert only.ids == [10, 20]  # an image that is not used may be missing


@pytest.mark.parametrize("frame", ["upright", "stored"])
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_a_photograph_is_shown_upright_with_its_boxes(tmp_path, make_coco, coco_dict, orientation, frame, suffix):
    """Boxes lie on a white rectangle, whichever frame they were annotated in; Pillow turns the picture."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = np.zeros((30, 40, 3), np.uint8)
    stored[4:9, 22:37] = 255
    path = tmp_path / f"10.{suffix}"
    Image.fromarray(stored).save(path, exif=exif)
    with Image.open(path) as file:
        upright = np.asarray(ImageOps.exif_transpose(file))
    # The size tells stored pixels only where sides are swapped.
    annotated = stored if frame == "stored" and orientation >= 5 else upright
    data = coco_dict([(10, "cat", box_of_white(annotated))])
    data["images"] = [{"id": 10, "file_name": path.name, "width": annotated.shape[1], "height": annotated.shape[0]}]
    scenes = CocoScenes(tmp_path, make_coco(data=data), CLASSES, **ALL)
    scene = scenes[0]
    assert np.array_equal((scene.image * 255).round().byte().permute(1, 2, 0).numpy(), upright)
    left, top, width, height = box_of_white(upright)
    assert scene.boxes.tolist() == [[left, top, left + width, top + height]]
    annotation = scenes.annotation(0)
    assert torch.equal(annotation.boxes, scene.boxes)
    assert annotation.size == (upright.shape[1], upright.shape[0])


def box_of_white(pixels):
    """Left, top, width and height of what is white in a picture."""
    rows, columns, _ = pixels.nonzero()
    top, left = int(rows.min()), int(columns.min())
    return left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top


def test_the_size_of_a_square_does_not_tell_its_frame(tmp_path, make_coco, coco_dict):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (40, 40)).save(tmp_path / "10.png", exif=exif)
    data = coco_dict([(10, "cat", (2, 1, 7, 9))])
    data["images"] = [{"id": 10, "file_name": "10.png", "width": 40, "height": 40}]
    assert CocoScenes(tmp_path, make_coco(data=data), CLASSES, **ALL)[0].boxes.tolist() == [[2, 1, 9, 10]]


def test_annotations_of_a_png_are_read_without_its_pixels(tmp_path, make_coco, coco_dict, monkeypatch):
    decoded = []
    monkeypatch.setattr(PngImageFile, "load", lambda image: decoded.append(image))
    Image.new("RGB", (40, 30)).save(tmp_path / "10.png")
    data = coco_dict([(10, "cat", (2, 1, 7, 9))])
    data["images"] = [{"id": 10, "file_name": "10.png", "width": 40, "height": 30}]
    annotation = CocoScenes(tmp_path, make_coco(data=data), CLASSES, **ALL).annotation(0)
    assert (annotation.boxes.tolist(), annotation.size, decoded) == ([[2, 1, 9, 10]], (40, 30), [])


def test_annotations_of_another_detector_or_image_size_are_refused(photographs, make_coco, coco_dict):
    with pytest.raises(DataError, match=r"expected some of the detector's 2 classes .* got 'person', 'cat', 'tv'"):
        CocoScenes(photographs, make_coco(BOXES), ("zebra", "cup"))
    unusable("got none", CocoScenes, photographs, make_coco(categories=()), CLASSES)
    data = coco_dict(BOXES)
    data["images"][1]["width"] = 41
    scenes = CocoScenes(photographs, make_coco(data=data), CLASSES, **ALL)
    unusable(r"10\.png: expected 41 × 30 pixels as annotated, got 40 × 30", lambda: scenes[0])


def test_fingerprint_changes_with_annotations_and_settings(photographs, make_coco, coco_dict):
    scenes = CocoScenes(photographs, make_coco(BOXES), CLASSES, **ALL)
    prints = {scenes.fingerprint}
    assert CocoScenes(str(photographs), make_coco(BOXES), list(CLASSES), **ALL).fingerprint in prints
    prints.add(CocoScenes(photographs, make_coco(BOXES), CLASSES, **ALL, crowd="drop").fingerprint)
    prints.add(CocoScenes(photographs, make_coco(BOXES), CLASSES, **ALL, limit=2).fingerprint)
    prints.add(CocoScenes(photographs, make_coco(BOXES[1:]), CLASSES, **ALL).fingerprint)
    prints.add(CocoScenes(photographs, make_coco(BOXES), CLASSES[::-1], **ALL).fingerprint)
    assert len(prints) == 5
    assert all(len(value) == 64 for value in prints)
    assert len({scenes.digest(i) for i in range(3)}) == 3


def test_scenes_are_iterated_indexed_and_pickled(scenes):
    assert [scene.id for scene in scenes] == [10, 20, 30]
    assert scenes[-1].id == 30
    with pytest.raises(IndexError):
        scenes.annotation(3)
    unpickled = pickle.loads(pickle.dumps(scenes))
    assert unpickled.fingerprint == scenes.fingerprint
    assert torch.equal(unpickled[0].boxes, scenes[0].boxes)


@pytest.mark.parametrize(
    "options", [{"min_instances": -1}, {"max_target_area": 0}, {"limit": 0}, {"coverage": "mean"}, {"crowd": "maybe"}]
)
def test_bad_settings(photographs, make_coco, options):
    refused(next(iter(options)), CocoScenes, photographs, make_coco(BOXES), CLASSES, **options)


@pytest.mark.shared
def test_development_photographs(shared):
    from pycocotools.coco import COCO

    file = shared / "coco/annotations/instances_eval300.json"
    reference = COCO(file)
    names = {c["id"]: c["name"] for c in reference.dataset["categories"]}
    classes = tuple(sorted(names.values()))
    scenes = CocoScenes(shared / "coco/eval300", file, classes)
    assert scenes.ids == sorted(reference.getImgIds())
    pairs = 0
    for index, identity in enumerate(scenes.ids):
        entries = [a for a in reference.loadAnns(reference.getAnnIds(identity)) if min(a["bbox"][2:]) > 0]
        annotation = scenes.annotation(index)
        assert [classes[k - 1] for k in annotation.labels.tolist()] == [names[a["category_id"]] for a in entries]
        x, y, w, h = np.array([a["bbox"] for a in entries], dtype=np.float64).T
        assert np.array_equal(annotation.boxes.numpy(), np.stack([x, y, x + w, y + h], -1).astype(np.float32))
        pairs += len(scenes.targets(index))
    assert (len(scenes), pairs) == (300, 1079)


@pytest.mark.parametrize(
    ("boxes", "seems"),
    [
        ([[0.1, 0.2, 0.5, 0.4], [0, 0, 1, 1]], "fractions of the picture"),
        ([[60, 10, 90, 40], [5, 5, 20, 20], [50, 50, 99, 70]], "corners [x1, y1, x2, y2]"),
        ([[60, 10, 30, 40], [5, 5, 20, 20], [50, 50, 40, 20]], None),
        ([[60, 10, 90, 40], [5, 5, 2, 2]], None),
        ([], None),
    ],
)
def test_boxes_in_another_form_are_told(boxes, seems):
    limits = torch.tensor([100, 80, 100, 80]).expand(len(boxes), 4)
    with nullcontext() if seems is None else pytest.warns(UserWarning, match=re.escape(f"look like {seems}")):
        warn_of_form(torch.tensor(boxes, dtype=torch.float64).reshape(-1, 4), limits, "boxes.json")


def test_a_warning_says_that_boxes_are_corners(make_coco):
    boxes = [[0.5, 0.25, 0.5, 0.5], [0.1, 0.1, 0.2, 0.2]]
    data = {
        "images": [{"id": 1, "file_name": "a.png", "width": 100, "height": 80}],
        "categories": [{"id": 1, "name": "cup"}],
        "annotations": [{"id": n, "image_id": 1, "category_id": 1, "bbox": box} for n, box in enumerate(boxes)],
    }
    file = read_annotations(make_coco(data=data))
    with pytest.warns(UserWarning, match=r"gt\.json: bbox is .* these look like fractions of the picture"):
        _Packed(file, {1: 1}, "gt.json", drop_crowds=False)

import copy
import hashlib
import json

import pytest

from semfov.data.coco import read_annotations
from semfov.errors import DataError

BOXES = [(10, "person", (1, 2, 3, 4)), (10, "cat", (0, 0, 5, 5)), (20, "person", (1.5, 2.25, 3, 4))]


def test_index_and_digest(make_coco, capsys):
    path = make_coco(BOXES)
    index, digest = read_annotations(path)
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest()
    assert sorted(index.getImgIds()) == [10, 20, 30]
    assert [a["bbox"] for a in index.loadAnns(index.getAnnIds(imgIds=[10]))] == [[1, 2, 3, 4], [0, 0, 5, 5]]
    assert capsys.readouterr().out == ""


def test_ids_may_be_strings(make_coco, coco_dict):
    data = coco_dict(BOXES)
    for image in data["images"]:
        image["id"] = str(image["id"])
    for annotation in data["annotations"]:
        annotation["image_id"] = str(annotation["image_id"])
    index, _ = read_annotations(make_coco(data=data))
    assert sorted(index.imgs) == ["10", "20", "30"]


def test_a_missing_file_or_a_folder_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"no\.json: no such file; check data\.annotations"):
        read_annotations(tmp_path / "no.json")
    with pytest.raises(DataError, match="expected a file, got a folder"):
        read_annotations(tmp_path)


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000, b"1" * 10_000])
def test_a_file_that_is_not_json_is_refused(tmp_path, text):
    (tmp_path / "a.json").write_bytes(text)
    with pytest.raises(DataError, match=r"a\.json: not a JSON file"):
        read_annotations(tmp_path / "a.json")


MISSING = object()
FAULTS = [
    (("images",), MISSING, "expected images to be a list, got nothing"),
    (("annotations",), MISSING, "expected annotations to be a list, got nothing"),
    (("categories",), MISSING, "expected categories to be a list, got nothing"),
    (("images",), {}, "expected images to be a list, got an object"),
    (("images", 1), 5, r"images\[1\]: expected an object, got a number"),
    (("images", 1, "id"), MISSING, r"images\[1\]: expected id to be an integer or a string, got nothing"),
    (("images", 1, "id"), True, "expected id to be an integer or a string, got True"),
    (("images", 1, "id"), 1.0, "expected id to be an integer or a string, got 1.0"),
    (("images", 1, "id"), 30, r"images\[1\]: expected unique ids, got id 30 more than once"),
    (("images", 2, "id"), "twenty", "expected ids of one kind"),
    (("images", 0, "file_name"), MISSING, r"images\[0\]: expected file_name to be a string, got nothing"),
    (("images", 0, "file_name"), "", "expected file_name to be a string, got ''"),
    (("images", 0, "width"), 0, "expected width to be a whole number of pixels, got 0"),
    (("images", 0, "height"), "30", "expected height to be a whole number of pixels, got '30'"),
    (("images", 0, "width"), 1e308, "expected width to be a whole number of pixels, got 1e\\+308"),
    (("images", 0, "height"), 30.5, "expected height to be a whole number of pixels, got 30.5"),
    (("categories", 0, "name"), None, r"categories\[0\]: expected name to be a string, got None"),
    (("categories", 1, "id"), 3, r"categories\[1\]: expected unique ids, got id 3 more than once"),
    (("annotations", 1, "id"), 0, r"annotations\[1\]: expected unique ids, got id 0 more than once"),
    (("annotations", 1, "id"), MISSING, r"annotations\[1\]: expected id"),
    (("annotations", 0, "image_id"), 99, "expected image_id to be the id of one of the images, got 99"),
    (("annotations", 0, "image_id"), [10], r"expected image_id to be the id of one of the images, got \[10\]"),
    (("annotations", 0, "category_id"), MISSING, "expected category_id to be the id of one of the categories"),
    (("annotations", 0, "bbox"), MISSING, r"annotations\[0\]: expected bbox .* got nothing"),
    (("annotations", 0, "bbox"), [1, 2, 3], "expected bbox"),
    (("annotations", 0, "bbox"), [1, 2, 3, float("nan")], "expected bbox .* finite"),
    (("annotations", 0, "bbox"), [1, 2, 3, 10**400], "expected bbox .* finite"),
    (("annotations", 0, "bbox"), [1, 2, -3, 4], "expected bbox .* size of at least 0"),
    (("annotations", 0, "bbox"), [1, 2, "3", 4], "expected bbox"),
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
    with pytest.raises(DataError, match=rf"instances\.json: .*{message}.*; correct or replace the file"):
        read_annotations(make_coco(data=data))


def test_a_json_list_is_refused(make_coco):
    with pytest.raises(DataError, match="expected an object with images, annotations and categories, got a list"):
        read_annotations(make_coco(data=[]))


def test_long_values_are_shortened_in_the_message(make_coco, coco_dict):
    data = coco_dict(BOXES)
    data["images"][0]["width"] = "x" * 10_000
    with pytest.raises(DataError) as caught:
        read_annotations(make_coco(data=data))
    assert len(str(caught.value)) < 300


def test_deeply_nested_values_are_refused(make_coco, coco_dict, tmp_path):
    data = coco_dict(BOXES)
    data["images"][0]["width"] = "HERE"
    text = json.dumps(data).replace('"HERE"', "[" * 900 + "]" * 900)
    (tmp_path / "deep.json").write_text(text)
    with pytest.raises(DataError, match=r"deep\.json"):
        read_annotations(tmp_path / "deep.json")

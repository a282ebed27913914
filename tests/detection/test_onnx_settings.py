import json

import pytest

from semfov.detection.onnx_file import read_settings
from semfov.errors import DataError


def test_settings_are_empty_without_file_and_metadata(tmp_path):
    assert read_settings(tmp_path / "model.onnx", {}) == {"preprocessing": {}}


def test_the_settings_file_overrides_the_metadata(tmp_path):
    inside = {"head": "yolox", "classes": ["a"], "preprocessing": {"scale": 1.0, "channels": "rgb"}}
    beside = {"head": "yolov5", "licence": "MIT", "preprocessing": {"scale": 255.0}}
    (tmp_path / "model.json").write_text(json.dumps(beside))
    assert read_settings(tmp_path / "model.onnx", {"semfov": json.dumps(inside)}) == {
        "head": "yolov5",
        "classes": ["a"],
        "licence": "MIT",
        "preprocessing": {"scale": 255.0, "channels": "rgb"},
    }


def test_metadata_of_ultralytics(tmp_path):
    metadata = {"names": "{0: 'person', 1: 'dog'}", "imgsz": "[480, 640]", "stride": "32", "task": "detect"}
    found = read_settings(tmp_path / "model.onnx", metadata)
    assert found == {"classes": ["person", "dog"], "input_size": [640, 480], "preprocessing": {}}


@pytest.mark.parametrize("names", ["person,dog", "{1: 'a'}", "{0: ", "3"])
def test_metadata_of_another_form_is_ignored(tmp_path, names):
    assert read_settings(tmp_path / "model.onnx", {"names": names}) == {"preprocessing": {}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"head": ', "line 1"),
        ("[]", "an object"),
        ('{"preprocessing": 3}', "preprocessing: expected dict, got 3"),
        ('{"input_size": "416"}', "input_size: expected int or list, got '416'"),
        ('{"classes": "cat, dog"}', "classes: expected list"),
        ('{"logits": 1}', "logits: expected bool"),
        ('{"heads": "yolox"}', "unknown key 'heads'; known: name, head"),
    ],
)
def test_invalid_settings_are_refused_with_the_name_of_the_file(tmp_path, text, message):
    (tmp_path / "model.json").write_text(text)
    with pytest.raises(DataError, match=rf"model\.json.*{message}"):
        read_settings(tmp_path / "model.onnx", {})
    with pytest.raises(DataError, match=rf"metadata of other\.onnx.*{message}"):
        read_settings(tmp_path / "other.onnx", {"semfov": text})


def test_binary_settings_files_are_refused(tmp_path):
    (tmp_path / "model.json").write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match="cannot read"):
        read_settings(tmp_path / "model.onnx", {})

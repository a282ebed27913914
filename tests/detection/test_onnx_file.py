"""Settings of ONNX files, and copies of them with another input size."""

import json

import numpy as np
import pytest
import torch
from onnx import helper, numpy_helper
from torch.nn import functional as F
from torchvision.ops import box_iou

from semfov import load_detector
from semfov.detection.onnx_file import read_settings, with_input_size
from semfov.detection.onnx_session import OnnxSession
from tests.refusals import refused, unusable
from tests.small import write_network


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


def test_numbers_are_names_and_words_that_yaml_changes_are_refused(make_onnx):
    """YAML reads the names `no` and `yes` as booleans; a name that is a number is meant as one."""
    values = {"output0": np.random.default_rng(0).random((1, 6, 84)).astype(np.float32)}
    assert load_detector(make_onnx(values, metadata={"names": "{0: 7, 1: 12}"})).classes == ("7", "12")
    path = make_onnx(values, metadata={"names": "{0: False, 1: 'cat'}"})
    refused(r"classes: expected names, got \[False\]; YAML reads no, off", load_detector, path)
    assert load_detector(path, classes=["no", "cat"]).classes == ("no", "cat")


def test_metadata_are_settings_where_their_form_is_known(tmp_path):
    assert read_settings(tmp_path / "model.onnx", {}) == {"preprocessing": {}}
    metadata = {"names": "{0: 'person', 1: 'dog'}", "imgsz": "[480, 640]", "stride": "32", "task": "detect"}
    found = read_settings(tmp_path / "model.onnx", metadata)
    assert found == {"classes": ["person", "dog"], "input_size": [640, 480], "preprocessing": {}}
    for names in ["person,dog", "{1: 'a'}", "{0: ", "3"]:
        assert read_settings(tmp_path / "model.onnx", {"names": names}) == {"preprocessing": {}}


def test_invalid_and_binary_settings_are_refused_with_the_name_of_the_file(tmp_path):
    for text, message in [
        ('{"head": ', "line 1"),
        ("[]", "an object"),
        ('{"preprocessing": 3}', "preprocessing: expected an object, got 3"),
        ('{"input_size": "416"}', "input_size: expected a list, got '416'"),
        ('{"classes": "cat, dog"}', "classes: expected a list"),
        ('{"logits": 1}', "logits: expected true or false"),
        ('{"heads": "yolox"}', "expected no other keys than name, head.*, got 'heads'"),
    ]:
        (tmp_path / "model.json").write_text(text)
        unusable(rf"model\.json.*{message}", read_settings, tmp_path / "model.onnx", {})
        unusable(rf"metadata of other\.onnx.*{message}", read_settings, tmp_path / "other.onnx", {"semfov": text})
    (tmp_path / "model.json").write_bytes(b"\x9f\xfe\x07\x9f")
    unusable("expected a file of text", read_settings, tmp_path / "model.onnx", {})


WEIGHT = np.random.default_rng(0).normal(size=(6, 3, 8, 8)).astype(np.float32)


@pytest.fixture(params=["initializer", "node"])
def shuffled(request, tmp_path, monkeypatch):
    """A convolution of stride 8 and a shuffle of its channels, exported for 64 x 64 pixels."""
    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path / "cache"))
    shapes = {"apart": [1, 2, 3, 8, 8], "together": [1, -1, 8, 8], "cells": [1, 6, -1]}
    steps = [
        helper.make_node("Conv", ["image", "weight"], ["map"], strides=[8, 8]),
        helper.make_node("Reshape", ["map", "apart"], ["groups"]),
        helper.make_node("Transpose", ["groups"], ["mixed"], perm=[0, 2, 1, 3, 4]),
        helper.make_node("Reshape", ["mixed", "together"], ["joined"]),
        helper.make_node("Reshape", ["joined", "cells"], ["output"]),
    ]
    stored = {"weight": WEIGHT}
    if request.param == "node":
        steps = [
            helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.array(each)))
            for name, each in shapes.items()
        ] + steps
    else:
        stored |= shapes
    return write_network(
        tmp_path / "shuffled.onnx", steps, {"image": [1, 3, 64, 64]}, {"output": [1, 6, 64]}, stored, opset=13
    )


@pytest.mark.parametrize("canvas", [(64, 64), (96, 64), (32, 128)])
def test_a_resized_network_computes_the_same_convolution(shuffled, canvas):
    path = with_input_size(shuffled, canvas)
    image = torch.rand(1, 3, canvas[1], canvas[0], generator=torch.Generator().manual_seed(0))
    expected = F.conv2d(image, torch.from_numpy(WEIGHT), stride=8)[:, [0, 3, 1, 4, 2, 5]].flatten(2)
    torch.testing.assert_close(OnnxSession(path)(image)["output"], expected, rtol=1e-4, atol=1e-4)
    assert with_input_size(shuffled, canvas) == path
    assert (path == shuffled) == (canvas == (64, 64))


def test_copies_of_another_size_are_checked(shuffled):
    path = with_input_size(shuffled, (96, 96))
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    assert with_input_size(shuffled, (96, 96)).read_bytes() == content
    refused("input_size: expected multiples of 32 pixels", with_input_size, shuffled, (100, 64))


@pytest.mark.shared
@pytest.mark.parametrize("size", [416, 640])
def test_nanodet_plus_is_recognised_by_content_and_takes_other_sizes(shared, tmp_path, size, monkeypatch):
    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path))
    file = tmp_path / "mine.onnx"
    file.write_bytes((shared / "weights" / "nanodet_plus_m_1.5x_416.onnx").read_bytes())
    detector = load_detector(file, input_size=size)
    named = load_detector("nanodet-plus-m-1.5x", weights=file, input_size=size)
    assert (detector.name, detector.digest) == (named.name, named.digest)
    assert detector.input_size == (size, size)
    picture = torch.rand(1, 3, 300, 400, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(detector(picture).scores, named(picture).scores)


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "file"), [("nanodet-plus-m-1.5x", "nanodet_plus_m_1.5x_416.onnx"), ("yolox-nano", "yolox_nano_416.onnx")]
)
def test_a_published_model_sees_the_same_objects_at_all_sizes(name, file, shared, tmp_path, monkeypatch):
    from skimage.data import astronaut

    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path))
    image = torch.from_numpy(astronaut()).permute(2, 0, 1)[None] / 255
    boxes = []
    for size in (None, 160, 640):
        detector = load_detector(name, weights=shared / "weights" / file, input_size=size)
        found = detector(image)
        assert detector.input_size == (size or 416,) * 2
        assert detector.classes[found.labels[0, 0] - 1] == "person"
        boxes.append(found.boxes[0, :1])
    for other in boxes[1:]:
        assert float(box_iou(boxes[0], other)) > 0.75

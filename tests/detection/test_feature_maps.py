"""Feature maps: named by the structure of a network, from the pass that detects, equal on all ways of computing it."""

import re

import numpy as np
import pytest
import torch
from onnx import helper
from torch import nn

from semfov import load_detector
from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import _yolov3_tiny
from semfov.detection.feature_maps import NetworkStep, landmarks, stride_of
from semfov.detection.onnx import load_onnx
from semfov.detection.yolo import YoloV3
from tests.refusals import refused
from tests.small import Fixed, rand, write_network


def step(name, stride, *reads, convolution=True):
    return NetworkStep(name, stride, reads, convolution)


def test_landmarks_of_a_pyramid():
    """A backbone of three strides, a path down to stride 16, and heads with two branches at both."""
    steps = [
        step("stem", 8, "image"), step("c8", 8, "stem"), step("c16", 16, "c8"), step("c32", 32, "c16"),
        step("up", 16, "c32", convolution=False), step("joined", 16, "up", "c16", convolution=False),
        step("p16", 16, "joined"), step("classes16", 16, "p16"), step("boxes16", 16, "p16"),
        step("h32", 32, "c32"), step("classes32", 32, "h32"), step("boxes32", 32, "h32"),
    ]  # fmt: skip
    assert landmarks(steps) == {
        "backbone8": "c8", "backbone16": "c16", "backbone32": "c32", "head16": "p16", "head32": "h32"
    }  # fmt: skip
    assert landmarks([]) == {}
    assert landmarks([step("numbers", None, "image")]) == {}


@pytest.mark.parametrize(
    ("canvas", "side", "stride"), [(416, 52, 8), (416, 13, 32), (416, 7, 64), (10, 10, 1), (8, 20, 1)]
)
def test_strides_are_powers_of_two(canvas, side, stride):
    assert stride_of(canvas, side) == stride


@pytest.fixture(scope="module")
def tiny():
    torch.manual_seed(0)
    network = Darknet(_yolov3_tiny()).eval().requires_grad_(False)
    return YoloV3(network, tuple(f"class {n}" for n in range(80)), input_size=(96, 64), name="tiny").eval()


def test_maps_of_a_darknet_network_are_what_its_layers_return(tiny):
    """Twin: hooks on the layers, whose numbers were read from the cfg by hand."""
    layers = {"backbone8": 6, "backbone16": 8, "backbone32": 18, "head16": 21, "head32": 13}
    seen = {}
    hooks = [
        tiny.network.layers[number].register_forward_hook(
            lambda _, __, out, name=name: seen.update({name: out.clone()})
        )
        for name, number in layers.items()
    ]
    image = rand(2, 3, 60, 90)
    detections = tiny(image)
    for hook in hooks:
        hook.remove()
    features = tiny.features(image)
    assert set(features.maps) == set(layers)
    assert features.canvas == (96, 64)
    for name, expected in seen.items():
        torch.testing.assert_close(features.maps[name], expected)
        assert features.maps[name].shape[-1] == 96 // int(re.sub(r"\D", "", name))
    assert torch.equal(features.detections.boxes, detections.boxes)
    assert torch.equal(features.detections.scores, detections.scores)
    assert list(tiny.features(image, ["6", "head16"]).maps) == ["6", "head16"]


def test_onnxruntime_gives_the_maps_that_torch_gives(tiny, tmp_path, monkeypatch):
    from semfov.detection.darknet_onnx import network_digest

    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path))
    twin = YoloV3(tiny.network, tiny.classes, input_size=(96, 64), runtime="auto", digest=network_digest(tiny.network))
    image = rand(1, 3, 64, 96)
    fast, slow = twin.features(image), tiny.features(image)
    for name, expected in slow.maps.items():
        torch.testing.assert_close(fast.maps[name], expected, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(fast.detections.scores, slow.detections.scores, rtol=1e-3, atol=1e-4)


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """An ONNX model of three convolutions with stride 2, and its torch twin of the layers."""
    torch.manual_seed(1)
    convolutions = [nn.Conv2d(3, 4, 3, 8, 1), nn.Conv2d(4, 6, 3, 2, 1), nn.Conv2d(6, 5, 3, 2, 1), nn.Conv2d(5, 6, 1)]
    nodes, stored, source = (
        [],
        {"shape": [1, 6, 4], "sides": np.array([[64, 64, 64, 64, 1, 1]], np.float32).T},
        "images",
    )
    for number, layer in enumerate(convolutions):
        for kind in ("weight", "bias"):
            stored[f"{kind}{number}"] = getattr(layer, kind).detach().numpy()
        given = [source, f"weight{number}", f"bias{number}"]
        shape = {"strides": layer.stride, "pads": layer.padding * 2}
        nodes.append(helper.make_node("Conv", given, [f"conv{number}"], **shape))
        nodes.append(helper.make_node("Relu" if number < 3 else "Sigmoid", [f"conv{number}"], [f"map{number}"]))
        source = f"map{number}"
    nodes.append(helper.make_node("Reshape", [source, "shape"], ["shares"]))
    nodes.append(helper.make_node("Mul", ["shares", "sides"], ["output"]))  # boxes in pixels
    path = tmp_path_factory.mktemp("onnx") / "net.onnx"
    return write_network(path, nodes, {"images": [1, 3, 64, 64]}, {"output": [1, 6, 4]}, stored), convolutions


def test_maps_of_an_onnx_model_equal_a_torch_twin(network):
    path, convolutions = network
    detector = load_onnx(path, head="yolov8", classes=("a", "b"))
    image = rand(1, 3, 64, 64)
    features = detector.features(image)
    value, expected = detector.preprocessing(image), []
    for layer in convolutions[:3]:
        value = layer(value).relu()
        expected.append(value.detach())
    assert {name: tuple(each.shape) for name, each in features.maps.items()} == {
        "backbone8": (1, 4, 8, 8), "backbone16": (1, 6, 4, 4), "head32": (1, 5, 2, 2)
    }  # fmt: skip
    for each, twin in zip(features.maps.values(), expected, strict=True):
        torch.testing.assert_close(each, twin, rtol=1e-4, atol=1e-5)
    alone = detector.feature_maps(detector.fit(image)[0], ["backbone16"])
    assert alone.keys() == {"backbone16"}
    assert torch.equal(alone["backbone16"], features.maps["backbone16"])
    inside = detector.features(image, ["conv1"]).maps["conv1"]
    torch.testing.assert_close(inside.relu(), expected[1], rtol=1e-4, atol=1e-5)
    refused("did you mean 'head32'", detector.features, image, ["head23"])


def test_torchvision_gives_its_pyramid():
    from torchvision.models.detection import retinanet_resnet50_fpn

    torch.manual_seed(0)
    model = retinanet_resnet50_fpn(weights=None, weights_backbone=None, num_classes=3, min_size=64, max_size=96)
    detector = load_detector(model.eval(), classes=["cat", "dog"])
    image = rand(1, 3, 64, 96)
    features = detector.features(image)
    assert list(features.maps) == [f"pyramid{2**n}" for n in range(3, 8)]
    canvas, _ = detector.fit(image)
    pixels = model.transform.normalize(canvas)
    padded = model.transform.batch_images(list(pixels), size_divisible=32)
    for twin, each in zip(model.backbone(padded).values(), features.maps.values(), strict=True):
        torch.testing.assert_close(each, twin)
    assert detector.features(image.requires_grad_(), ["pyramid16"]).maps["pyramid16"].requires_grad


def test_a_detector_that_hides_its_maps_is_named():
    refused(r"access to its feature maps.*fixed", Fixed().features, torch.zeros(1, 3, 32, 32))

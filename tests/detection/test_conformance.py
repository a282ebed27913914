"""Properties of every detector, whatever its network and runtime."""

import copy
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from semfov.detection import Detections, Detector, Selection
from semfov.detection.load import load_yolo
from semfov.detection.onnx import load_onnx
from semfov.detection.torchvision import TorchvisionDetector
from semfov.errors import InputError

NAMES = ("cat", "dog", "cup")
SHARED = Path(os.environ.get("SEMFOV_SHARED", Path(__file__).parents[3] / "shared")) / "weights"


def build_darknet(runtime):
    def build(tmp_path, small_cfg, small_weights, make_onnx):
        return load_yolo(str(small_cfg), weights=small_weights, classes=NAMES[:2], stride=16, runtime=runtime)

    return build


def build_exported(static):
    def build(tmp_path, small_cfg, small_weights, make_onnx):
        from semfov.detection.export import export_onnx

        options = {"weights": small_weights, "classes": NAMES[:2], "stride": None if static else 16}
        export_onnx(load_yolo(str(small_cfg), **options), tmp_path / "small.onnx", static=static)
        return load_onnx(tmp_path / "small.onnx")

    return build


def build_onnx(*shapes, **options):
    """A model with one output of each given shape; values are random, but centres lie on the canvas."""

    def build(tmp_path, small_cfg, small_weights, make_onnx):
        generator = np.random.default_rng(0)
        outputs = {name: generator.random(shape).astype(np.float32) for name, shape in shapes}
        for name in ("output0", "boxes"):
            if name in outputs:
                boxes = outputs[name] if outputs[name].shape[1] > 7 else outputs[name].swapaxes(1, 2)
                boxes[..., :4] = boxes[..., :4] * [60, 60, 10, 10] + [0, 0, 3, 3]
        if "boxes" in outputs:
            outputs["boxes"][..., 2:4] += outputs["boxes"][..., :2]
        return load_onnx(make_onnx(outputs, **options), classes=NAMES, input_size=64)

    return build


def build_torchvision(kind):
    def build(tmp_path, small_cfg, small_weights, make_onnx):
        return torchvision_detector(kind)

    return build


def torchvision_detector(kind):
    from torchvision.models.detection import FCOS, FasterRCNN, RetinaNet
    from torchvision.models.detection.anchor_utils import AnchorGenerator, DefaultBoxGenerator
    from torchvision.models.detection.ssd import SSD
    from torchvision.models.detection.ssdlite import SSDLiteHead
    from torchvision.ops import MultiScaleRoIAlign

    torch.manual_seed(0)
    backbone = nn.Sequential(nn.Conv2d(3, 32, 8, 8))
    backbone.out_channels = [32] if kind.startswith("SSD") else 32
    small = {"min_size": 64, "max_size": 96}
    anchors = AnchorGenerator(((16,),), ((0.5, 1.0, 2.0),))
    model = {
        "Faster R-CNN": lambda: FasterRCNN(
            backbone, 4, rpn_anchor_generator=anchors, box_roi_pool=MultiScaleRoIAlign(["0"], 7, 2), **small
        ),
        "RetinaNet": lambda: RetinaNet(backbone, 4, anchor_generator=anchors, **small),
        "FCOS": lambda: FCOS(backbone, 4, anchor_generator=AnchorGenerator(((8,),), ((1.0,),)), **small),
        "SSD": lambda: SSD(backbone, DefaultBoxGenerator([[2]]), (64, 48), 4),
        "SSDlite": lambda: SSD(
            backbone,
            DefaultBoxGenerator([[2]]),
            (64, 48),
            4,
            head=SSDLiteHead([32], [4], 4, nn.BatchNorm2d),
        ),
    }[kind]()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "head" in name and parameter.ndim == 4:  # untrained heads give the same scores everywhere
                nn.init.kaiming_normal_(parameter)
    return TorchvisionDetector(model.requires_grad_(False), NAMES)


def build_real(file):
    def build(tmp_path, small_cfg, small_weights, make_onnx):
        if not (SHARED / file).is_file():
            pytest.skip(f"no {file} in {SHARED} (set SEMFOV_SHARED)")
        return load_onnx(SHARED / file)

    return build


@dataclass(frozen=True)
class Adapter:
    build: object
    gradients: bool = False


ADAPTERS = {
    "darknet": Adapter(build_darknet("auto"), gradients=True),
    "darknet, torch": Adapter(build_darknet("torch"), gradients=True),
    "onnx, own export": Adapter(build_exported(static=False)),
    "onnx, own static export": Adapter(build_exported(static=True)),
    "onnx, yolox": Adapter(build_onnx(("output", (1, 84, 8)))),
    "onnx, yolov5": Adapter(build_onnx(("output0", (1, 252, 8)))),
    "onnx, yolov8": Adapter(build_onnx(("output0", (1, 7, 84)))),
    "onnx, dynamic batch": Adapter(build_onnx(("output0", (1, 7, 84)), batch="batch")),
    "onnx, batch of two": Adapter(build_onnx(("output0", (1, 7, 84)), batch=2)),
    "onnx, candidates": Adapter(build_onnx(("boxes", (1, 9, 4)), ("classes", (1, 9, 3)))),
    "onnx, nanodet-plus": Adapter(build_onnx(("output", (1, 85, 35)))),
    "onnx, picodet": Adapter(
        build_onnx(
            *((f"{kind}{n}", (1, n, c)) for kind, c in (("a", 3), ("b", 32)) for n in (64, 16, 4, 1)),
            producer="PaddlePaddle",
        )
    ),
    "onnx, nanodet": Adapter(
        build_onnx(
            *((f"{kind}_pred_{n}", (1, n, c)) for n in (64, 16, 4) for kind, c in (("cls", 3), ("dis", 32))),
        )
    ),
    "onnx, detr": Adapter(build_onnx(("logits", (1, 9, 4)), ("pred_boxes", (1, 9, 4)))),
    "onnx, rtdetr": Adapter(build_onnx(("logits", (1, 9, 3)), ("pred_boxes", (1, 9, 4)))),
    "onnx, rtdetr in one tensor": Adapter(build_onnx(("rows", (1, 9, 7)))),
    "yolox-nano": Adapter(build_real("yolox_nano_416.onnx")),
    "picodet-s": Adapter(build_real("picodet_s_416_coco.onnx")),
    "faster r-cnn": Adapter(build_torchvision("Faster R-CNN"), gradients=True),
    "retinanet": Adapter(build_torchvision("RetinaNet"), gradients=True),
    "fcos": Adapter(build_torchvision("FCOS"), gradients=True),
    "ssd": Adapter(build_torchvision("SSD"), gradients=True),
    "ssdlite": Adapter(build_torchvision("SSDlite"), gradients=True),
}


# One of each way to run a network; the others differ from them in the outputs that they read.
FAMILIES = ("darknet", "onnx, own static export", "onnx, yolov8", "onnx, batch of two", "faster r-cnn")


def with_values(argument, *values):
    """Every detector with one of the values, and one of each family with all of them."""
    names = list(ADAPTERS)
    pairs = {(name, values[number % len(values)]): None for number, name in enumerate(names)}
    pairs |= {(family, value): None for family in FAMILIES for value in values}
    return pytest.mark.parametrize(("adapter", argument), list(pairs), indirect=["adapter"])


of_each_family = pytest.mark.parametrize("adapter", FAMILIES, indirect=True)


@pytest.fixture(params=ADAPTERS)
def adapter(request: pytest.FixtureRequest) -> Adapter:
    return ADAPTERS[request.param]


@pytest.fixture
def detector(adapter, tmp_path, small_cfg, small_weights, make_onnx) -> Detector:
    built = adapter.build(tmp_path, small_cfg, small_weights, make_onnx)
    built.selection = replace(built.selection, threshold=min(0.005, built.selection.threshold))
    return built


def photographs(batch, height, width, dtype=torch.float32):
    """Smooth random images."""
    coarse = torch.rand(batch, 3, 5, 7, dtype=dtype, generator=torch.Generator().manual_seed(3))
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)


def assert_valid(detector: Detector, found: Detections, images: torch.Tensor) -> None:
    batch, height, width = images.shape[0], *images.shape[-2:]
    length = found.boxes.shape[1]
    assert found.boxes.shape == (batch, length, 4)
    assert found.scores.shape == (batch, length, len(detector.classes) + 1)
    assert found.mask.shape == (batch, length)
    assert length == int(found.count.max()) <= detector.selection.limit
    real = found.scores[found.mask]
    assert bool((real >= 0).all())
    torch.testing.assert_close(real.sum(-1), torch.ones_like(real[:, 0]), rtol=0, atol=1e-5)
    assert bool((found.confidence.diff(dim=-1) <= 0).all())
    assert not found.scores[~found.mask].any()
    boxes = found.boxes[found.mask]
    assert bool((boxes[:, :2] < boxes[:, 2:]).all())
    assert bool((boxes >= 0).all())
    assert bool((boxes <= boxes.new_tensor([width, height] * 2)).all())
    assert found.boxes.device == found.scores.device == found.mask.device == images.device


def same(one: Detections, other: Detections, tolerance: float) -> None:
    assert torch.equal(one.mask, other.mask)
    torch.testing.assert_close(one.scores, other.scores, rtol=0, atol=tolerance)
    torch.testing.assert_close(one.boxes, other.boxes, rtol=tolerance, atol=100 * tolerance)


def test_scores_are_on_the_simplex_and_shapes_are_right(detector):
    images = photographs(3, 60, 83)
    before = images.clone()
    found = detector(images)
    assert int(found.count.max()) > 0
    assert_valid(detector, found, images)
    assert torch.equal(images, before)
    same(detector(images), found, 0.0)


def test_images_without_detections_give_empty_tensors(detector):
    detector.selection = Selection(threshold=1.0)
    found = detector(photographs(2, 40, 50))
    assert found.boxes.shape == (2, 0, 4)
    assert found.scores.shape == (2, 0, len(detector.classes) + 1)
    assert found.mask.shape == (2, 0)


@with_values("value", 0.0, 0.5, 1.0)
def test_uniform_images_give_valid_detections(detector, value):
    images = torch.full((1, 3, 48, 64), value)
    assert_valid(detector, detector(images), images)


@of_each_family
@pytest.mark.parametrize(
    "images",
    [
        torch.zeros(0, 3, 40, 50),
        torch.zeros(1, 3, 0, 50),
        torch.zeros(1, 4, 40, 50),
        torch.zeros(3, 40, 50),
        torch.zeros(1, 1, 3, 40, 50),
        torch.zeros(1, 3, 40, 50, dtype=torch.uint8),
    ],
    ids=lambda images: f"{images.dtype} {tuple(images.shape)}",
)
def test_inputs_that_are_not_a_batch_of_images_are_refused(detector, images):
    with pytest.raises(InputError, match=r"images: expected floating-point RGB in \[0, 1\] of shape \(B, 3, H, W\)"):
        detector(images)


@of_each_family
def test_canvases_of_bytes_and_empty_batches_of_canvases_are_refused(detector):
    canvas, placement = detector.fit(photographs(1, 40, 50))
    with pytest.raises(InputError, match="canvas: expected at least one image"):
        detector.detect(canvas[:0], placement)
    with pytest.raises(InputError, match="floating-point"):
        detector.propose(canvas.byte())


@with_values("dtype", torch.float16, torch.bfloat16, torch.float64)
def test_images_may_have_other_precisions(detector, dtype):
    images = photographs(1, 45, 64, dtype=torch.float64).to(dtype)
    found = detector(images)
    assert int(found.count) > 0
    assert bool(torch.isfinite(found.boxes).all())
    total = found.scores[found.mask].double().sum(-1)
    coarse = torch.finfo(found.scores.dtype).eps
    torch.testing.assert_close(total, torch.ones_like(total), rtol=0, atol=max(1e-5, 4 * coarse))


def test_a_batch_equals_a_loop(detector):
    images = photographs(5, 50, 70) * torch.linspace(0.4, 1, 5)[:, None, None, None]
    loop = Detections.stack([detector(image[None]) for image in images])
    same(detector(images), loop, 1e-5)


@with_values("size", (1, 1), (1, 300), (300, 1), (17, 31), (200, 301), (512, 64))
def test_images_may_have_any_size(detector, size):
    images = photographs(1, *size)
    assert_valid(detector, detector(images), images)


def test_fit_and_detect_equal_a_call_of_the_detector(detector):
    images = photographs(2, 45, 64)
    canvas, placement = detector.fit(images)
    assert canvas.shape[:2] == (2, 3)
    assert placement.size == (64, 45)
    candidates = detector.propose(canvas)
    assert candidates.boxes.shape[:2] == candidates.classes.shape[:2]
    assert candidates.classes.shape[-1] == len(detector.classes)
    same(detector.detect(canvas, placement), detector(images), 0.0)
    free = detector.detect(canvas)
    torch.testing.assert_close(free.scores[free.mask].sum(-1), torch.ones(int(free.count.sum())))


def test_bytes_are_proposed_as_their_share_of_white(detector):
    width, height = detector.input_size
    canvas = (photographs(2, height, width) * 255).round().byte()
    canvas[:, 0] //= 2  # channels that are not alike
    expected = detector.propose(canvas / 255)
    for given in (canvas, canvas.contiguous(memory_format=torch.channels_last)):
        found = detector.propose_bytes(given)
        torch.testing.assert_close(found.boxes, expected.boxes, rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(found.confidence, expected.confidence, rtol=1e-4, atol=1e-5)
    with pytest.raises(InputError, match="canvas: expected bytes"):
        detector.propose_bytes(canvas / 255)


def test_a_copy_gives_the_same_detections(detector):
    images = photographs(1, 45, 64)
    same(copy.deepcopy(detector)(images), detector(images), 1e-6)


def test_detector_moves_between_devices(detector, device):
    images = photographs(2, 45, 64)
    before = detector(images)
    found = detector.to(device)(images.to(device))
    assert_valid(detector, found, images.to(device))
    if device.type == "cpu":
        same(found, before, 1e-6)
    same(detector.to("cpu")(images), before, 1e-6)


def test_differentiable_detectors_pass_gradients_to_the_image(adapter, detector):
    images = photographs(1, 45, 64).requires_grad_()
    found = detector(images)
    if adapter.gradients:
        (found.scores.square().sum() + found.boxes.sum()).backward()
        assert bool(torch.isfinite(images.grad).all())
        assert bool(images.grad.any())
    else:
        assert not found.scores.requires_grad


def test_settings_are_json_and_differ_between_detectors(detector):
    settings = detector.settings()
    assert json.loads(json.dumps(settings)) == settings
    detector.selection = replace(detector.selection, iou=0.123)
    assert detector.settings() != settings


@with_values("policy", "residual", "normalised", "uniform", "none")
def test_detectors_accept_every_background_policy(detector, policy):
    detector.background = policy
    images = photographs(1, 45, 64)
    found = detector(images)
    assert_valid(detector, found, images)
    background = found.scores[found.mask][:, 0]
    expected = {"uniform": 1 / (len(detector.classes) + 1), "none": 0.0}
    if policy in expected:
        torch.testing.assert_close(background, torch.full_like(background, expected[policy]))

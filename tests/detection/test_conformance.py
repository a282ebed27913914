"""Properties of every detector, whatever its network and runtime. (`test_onnx` has the heads of ONNX models.)"""

import copy
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from semfov import Detections, Detector, Selection
from semfov.detection.export import export_onnx
from semfov.detection.onnx import load_onnx
from semfov.detection.torchvision import TorchvisionDetector
from tests.detection.test_torchvision import MODELS, randomise_heads
from tests.refusals import refused

NAMES = ("cat", "dog", "cup")
SHARED = Path(os.environ.get("SEMFOV_SHARED", Path(__file__).parents[3] / "shared")) / "weights"


def build_darknet(runtime):
    return lambda tmp_path, make_small, make_onnx: make_small(runtime)


def build_exported(static):
    def build(tmp_path, make_small, make_onnx):
        export_onnx(make_small(stride=None if static else 16), tmp_path / "small.onnx", static=static)
        return load_onnx(tmp_path / "small.onnx")

    return build


def build_onnx(**options):
    """A model with the head of YOLOv8; values are random, but centres lie on the canvas."""

    def build(tmp_path, make_small, make_onnx):
        columns = np.random.default_rng(0).random((1, 7, 84)).astype(np.float32)
        columns[:, :4] = columns[:, :4] * np.array([60, 60, 10, 10])[:, None] + np.array([0, 0, 3, 3])[:, None]
        return load_onnx(make_onnx({"output0": columns}, **options), classes=NAMES, input_size=64)

    return build


def build_torchvision(kind):
    def build(tmp_path, make_small, make_onnx):
        torch.manual_seed(0)
        return TorchvisionDetector(randomise_heads(MODELS[kind]()).float().requires_grad_(False), classes=NAMES)

    return build


def build_real(file):
    def build(tmp_path, make_small, make_onnx):
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
    "onnx": Adapter(build_onnx()),
    "onnx, dynamic batch": Adapter(build_onnx(batch="batch")),
    "onnx, batch of two": Adapter(build_onnx(batch=2)),
    "yolox-nano": Adapter(build_real("yolox_nano_416.onnx")),
    "picodet-s": Adapter(build_real("picodet_s_416_coco.onnx")),
    **{kind: Adapter(build_torchvision(kind), gradients=True) for kind in MODELS},
}

# One of each way to run a network.
of_each_family = pytest.mark.parametrize(
    "adapter", ["darknet", "onnx, own static export", "onnx", "onnx, batch of two", "Faster R-CNN"], indirect=True
)


@pytest.fixture(params=ADAPTERS)
def adapter(request: pytest.FixtureRequest) -> Adapter:
    return ADAPTERS[request.param]


@pytest.fixture
def detector(adapter, tmp_path, make_small, make_onnx) -> Detector:
    built = adapter.build(tmp_path, make_small, make_onnx)
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
    assert length == int(found.count.max()) <= detector.selection.limit
    real = found.scores[found.mask]
    assert bool((real >= 0).all())
    torch.testing.assert_close(real.sum(-1), torch.ones_like(real[:, 0]), rtol=0, atol=1e-5)
    # Fusion takes the boxes in the order of their vectors; the detector's own scores may have another.
    assert bool((found.scores[..., 1:].amax(-1).diff(dim=-1) <= 0).all())
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
    detector.selection = Selection(threshold=1.0)
    assert_valid(detector, detector(images), images)


@of_each_family
def test_what_is_no_batch_of_images_or_canvases_is_refused(detector):
    one = torch.zeros(1, 3, 40, 50)
    for images in (one[:0], one[:, :, :0], one[:, [0, 0, 1, 2]], one[0], one[None], one.byte()):
        refused(r"images: expected floating-point RGB in \[0, 1\] of shape \(B, 3, H, W", detector, images)
    canvas, placement = detector.fit(photographs(1, 40, 50))
    refused("canvas: expected at least one image", detector.detect, canvas[:0], placement)
    refused("floating-point", detector.propose, canvas.byte())


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
@of_each_family
def test_images_may_have_other_precisions(detector, dtype):
    images = photographs(1, 45, 64, dtype=torch.float64).to(dtype)
    found = detector(images)
    assert int(found.count) > 0
    assert bool(torch.isfinite(found.boxes).all())
    total = found.scores[found.mask].double().sum(-1)
    coarse = torch.finfo(found.scores.dtype).eps
    torch.testing.assert_close(total, torch.ones_like(total), rtol=0, atol=max(1e-5, 4 * coarse))


def test_a_batch_equals_a_loop_and_a_copy_the_detector(detector):
    images = photographs(5, 50, 70) * torch.linspace(0.4, 1, 5)[:, None, None, None]
    loop = Detections.stack([detector(image[None]) for image in images])
    same(detector(images), loop, 1e-5)
    same(copy.deepcopy(detector)(images), detector(images), 1e-6)


@of_each_family
def test_images_of_any_size_and_colour_give_valid_detections(detector):
    for value in [0.0, 0.5, 1.0]:
        images = torch.full((1, 3, 48, 64), value)
        assert_valid(detector, detector(images), images)
    for size in [(1, 1), (1, 300), (300, 1), (17, 31), (512, 64)]:
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
    refused("canvas: expected bytes", detector.propose_bytes, canvas / 255)


def test_detector_moves_between_devices(detector, device):
    images = photographs(2, 45, 64)
    before = detector(images)
    found = detector.to(device)(images.to(device))
    assert_valid(detector, found, images.to(device))
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


@pytest.mark.parametrize("policy", ["residual", "normalised", "uniform", "none"])
@of_each_family
def test_detectors_accept_every_background_policy(detector, policy):
    detector.background = policy
    images = photographs(1, 45, 64)
    found = detector(images)
    assert_valid(detector, found, images)
    background = found.scores[found.mask][:, 0]
    expected = {"uniform": 1 / (len(detector.classes) + 1), "none": 0.0}
    if policy in expected:
        torch.testing.assert_close(background, torch.full_like(background, expected[policy]))

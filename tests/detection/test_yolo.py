import math

import pytest
import torch

from semfov.detection import Selection
from semfov.detection.darknet import Darknet, read_weights
from semfov.detection.darknet_config import read_cfg
from semfov.detection.yolo import YoloV3, decode_yolo
from semfov.errors import InputError

ANCHORS = [(10.0, 14.0), (23.0, 27.0)]


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


@pytest.fixture
def detector(small_cfg, write_weights) -> YoloV3:
    network = Darknet(read_cfg(small_cfg)).eval().requires_grad_(False)
    digest = read_weights(network, write_weights())
    return YoloV3(network, ("cat", "dog"), digest=digest)


@pytest.mark.parametrize("scale", [1.0, 1.05])
def test_decoding_equals_a_scalar_loop(scale):
    raw = torch.randn(2, 2 * 8, 3, 5, dtype=torch.float64)
    candidates = decode_yolo(raw, ANCHORS, (160, 96), scale)
    for image in range(2):
        n = 0
        for row in range(3):
            for column in range(5):
                for anchor, (width, height) in enumerate(ANCHORS):
                    t = raw[image, anchor * 8 : anchor * 8 + 8, row, column].tolist()
                    x = (sigmoid(t[0]) * scale - (scale - 1) / 2 + column) * 32
                    y = (sigmoid(t[1]) * scale - (scale - 1) / 2 + row) * 32
                    w, h = width * math.exp(t[2]), height * math.exp(t[3])
                    box = [x - w / 2, y - h / 2, x + w / 2, y + h / 2]
                    assert candidates.boxes[image, n].tolist() == pytest.approx(box)
                    assert candidates.objectness[image, n].item() == pytest.approx(sigmoid(t[4]))
                    assert candidates.classes[image, n].tolist() == pytest.approx([sigmoid(v) for v in t[5:]])
                    n += 1
        assert candidates.boxes.shape[1] == n


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_decoding_keeps_dtype_and_device(dtype, device):
    candidates = decode_yolo(torch.zeros(1, 16, 1, 1, dtype=dtype, device=device), ANCHORS, (32, 32))
    for part in (candidates.boxes, candidates.classes, candidates.objectness):
        assert part.dtype == dtype
        assert part.device.type == device.type


def test_decoding_is_differentiable():
    raw = torch.randn(1, 16, 2, 2, dtype=torch.float64, requires_grad=True)

    def parts(raw):
        c = decode_yolo(raw, ANCHORS, (64, 64))
        return c.boxes, c.classes, c.objectness

    assert torch.autograd.gradcheck(parts, (raw,))


def test_decoding_compiles_to_a_single_graph():
    raw = torch.randn(1, 16, 2, 3)
    compiled = torch.compile(lambda raw: decode_yolo(raw, ANCHORS, (96, 64)).boxes, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(raw), decode_yolo(raw, ANCHORS, (96, 64)).boxes)


def test_decoding_refuses_a_wrong_number_of_channels():
    with pytest.raises(InputError, match="raw: expected a multiple of 2 anchors"):
        decode_yolo(torch.zeros(1, 15, 1, 1), ANCHORS, (32, 32))


def test_proposals_of_all_heads_are_concatenated(detector):
    canvas = torch.rand(2, 3, 32, 64)
    candidates = detector.propose(canvas)
    assert candidates.boxes.shape == (2, 2 * 4 * 8 + 16 * 32, 4)
    coarse, fine = detector.network(canvas)
    first = decode_yolo(coarse, [(8.0, 10.0), (20.0, 12.0)], (64, 32))
    second = decode_yolo(fine, [(4.0, 6.0)], (64, 32))
    torch.testing.assert_close(candidates.boxes, torch.cat([first.boxes, second.boxes], 1))
    torch.testing.assert_close(candidates.classes, torch.cat([first.classes, second.classes], 1))


def test_boxes_are_mapped_back_to_the_image(detector):
    detector.selection = Selection(threshold=0.0, limit=5)
    image = torch.rand(1, 3, 100, 150)
    canvas, placement = detector.fit(image)
    assert canvas.shape == (1, 3, 32, 64)
    found = detector(image)
    assert 0 < found.count.item() <= 5
    assert float(found.boxes[..., 2].max()) <= 150
    proposed = placement.boxes_to_image(detector.propose(canvas).boxes[0])
    torch.testing.assert_close(found.scores.sum(-1), torch.ones(1, found.mask.shape[1]))
    for box in found.boxes[0]:
        assert bool((proposed == box).all(-1).any())


def test_settings_contain_runtime_digest_and_cfg(detector, small_cfg, write_weights):
    before = detector.settings()
    assert before["runtime"] == "torch"
    other = read_cfg(small_cfg)
    other[-1].options["mask"] = "1"
    network = Darknet(other)
    digest = read_weights(network, write_weights())
    assert digest == before["digest"]
    assert YoloV3(network, ("cat", "dog"), digest=digest).settings()["cfg"] != before["cfg"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"classes": ("cat",)}, "classes: expected 2 names, got 1"),
        ({"input_size": (30, 32)}, "input_size: expected a multiple of 8"),
        ({"input_size": (0, 32)}, "input_size: expected a multiple of 8"),
        ({"stride": 6}, "stride: expected None or a multiple of 8"),
    ],
)
def test_refuses_invalid_settings(small_cfg, options, message):
    with pytest.raises(InputError, match=message):
        YoloV3(Darknet(read_cfg(small_cfg)), **({"classes": ("cat", "dog")} | options))

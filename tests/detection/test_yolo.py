import math

import pytest
import torch

from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import read_cfg
from semfov.detection.yolo import YoloV3, decode_yolo
from tests.refusals import refused

ANCHORS = [(10.0, 14.0), (23.0, 27.0)]


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


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


def test_decoding_keeps_dtype_and_device(dtype, device):
    candidates = decode_yolo(torch.zeros(1, 16, 1, 1, dtype=dtype, device=device), ANCHORS, (32, 32))
    for part in (candidates.boxes, candidates.classes, candidates.objectness):
        assert part.dtype == dtype
        assert part.device.type == device.type


def test_decoding_is_differentiable_and_compiles_to_a_single_graph():
    raw = torch.randn(1, 16, 2, 2, dtype=torch.float64, requires_grad=True)

    def parts(raw):
        c = decode_yolo(raw, ANCHORS, (64, 64))
        return c.boxes, c.classes, c.objectness

    assert torch.autograd.gradcheck(parts, (raw,))
    raw = torch.randn(1, 16, 2, 3)
    compiled = torch.compile(lambda raw: decode_yolo(raw, ANCHORS, (96, 64)).boxes, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(raw), decode_yolo(raw, ANCHORS, (96, 64)).boxes)


def test_proposals_of_all_heads_are_concatenated(make_small):
    detector = make_small()
    canvas = torch.rand(2, 3, 32, 64)
    candidates = detector.propose(canvas)
    assert candidates.boxes.shape == (2, 2 * 4 * 8 + 16 * 32, 4)
    coarse, fine = detector.network(canvas)
    first = decode_yolo(coarse, [(8.0, 10.0), (20.0, 12.0)], (64, 32))
    second = decode_yolo(fine, [(4.0, 6.0)], (64, 32))
    torch.testing.assert_close(candidates.boxes, torch.cat([first.boxes, second.boxes], 1))
    torch.testing.assert_close(candidates.classes, torch.cat([first.classes, second.classes], 1))


def test_refuses_invalid_settings_and_channels(small_cfg):
    refused("raw: expected a multiple of 2 anchors", decode_yolo, torch.zeros(1, 15, 1, 1), ANCHORS, (32, 32))
    for options, message in [
        ({"classes": ("cat",)}, "classes: expected 2 names, got 1"),
        ({"input_size": (30, 32)}, "input_size: expected a multiple of 8"),
        ({"input_size": (0, 32)}, "input_size: expected a multiple of 8"),
        ({"stride": 6}, "stride: expected None or a multiple of 8"),
    ]:
        refused(message, YoloV3, Darknet(read_cfg(small_cfg)), **{"classes": ("cat", "dog")} | options)


def test_settings_contain_runtime_digest_and_cfg(make_small, small_cfg):
    before = make_small().settings()
    assert before["runtime"] == "torch"
    small_cfg.write_text(small_cfg.read_text().replace("mask=0", "mask=1"))
    after = make_small().settings()
    assert after["digest"] == before["digest"]
    assert after["cfg"] != before["cfg"]

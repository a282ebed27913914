"""Darknet's cfgs, layers, weights and heads against a plain implementation that reads both files, without folding."""

import configparser
import hashlib
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from semfov.detection.darknet import Convolution, Darknet, Head, MaxPool
from semfov.detection.darknet_config import ARCHITECTURES, Section, _parse_cfg, _yolov3_tiny, read_cfg
from semfov.detection.weights import WEIGHTS
from semfov.detection.yolo import YoloV3, decode_yolo
from semfov.errors import DataError
from tests.refusals import refused, unusable


class PlainDarknet:
    """Computes the layers of a cfg one after the other, in float64."""

    def __init__(self, cfg: str, weights: Path, header: int = 20) -> None:
        number = iter(range(1000))
        self.parser = configparser.ConfigParser()
        self.parser.read_string(re.sub(r"\[(\w+)\]", lambda match: f"[{next(number)} {match[1]}]", cfg))
        self.numbers = torch.from_numpy(np.fromfile(weights, "<f4", offset=header).astype(np.float64))

    def take(self, *shape: int) -> torch.Tensor:
        count = int(np.prod(shape))
        taken, self.numbers = self.numbers[:count], self.numbers[count:]
        return taken.view(shape)

    def convolve(self, x: torch.Tensor, options) -> torch.Tensor:
        filters, size, groups = int(options["filters"]), int(options["size"]), int(options.get("groups", 1))
        shift = self.take(filters)
        normalised = options.get("batch_normalize") == "1"
        if normalised:
            scale, mean, variance = self.take(filters), self.take(filters), self.take(filters)
        kernel = self.take(filters, x.shape[1] // groups, size, size)
        padding = size // 2 if options.get("pad") == "1" else 0
        x = F.conv2d(x, kernel, stride=int(options.get("stride", 1)), padding=padding, groups=groups)
        x = F.batch_norm(x, mean, variance, scale, shift, eps=1e-5) if normalised else x + shift[:, None, None]
        return {
            "leaky": lambda x: torch.where(x > 0, x, x / 10),
            "linear": lambda x: x,
            "relu": lambda x: x.clamp(min=0),
            "mish": lambda x: x * torch.tanh(torch.log1p(torch.exp(x))),
        }[options["activation"]](x)

    def __call__(self, x: torch.Tensor) -> list[torch.Tensor]:
        outputs: list[torch.Tensor] = []
        maps = []
        for name in self.parser.sections()[1:]:
            options, kind = self.parser[name], name.split()[1]
            if kind == "convolutional":
                x = self.convolve(x, options)
            elif kind == "maxpool":
                size, stride = int(options["size"]), int(options["stride"])
                before = (size - 1) // 2
                padded = F.pad(x, (before, size - 1 - before) * 2, value=-1e30)
                # With stride 2 the size must not depend on the padding.
                x = F.max_pool2d(padded, size, stride)[..., : -(-x.shape[2] // stride), : -(-x.shape[3] // stride)]
            elif kind == "upsample":
                x = x.repeat_interleave(2, 2).repeat_interleave(2, 3)
            elif kind == "shortcut":
                x = x + outputs[int(options["from"])]
            elif kind == "route":
                x = torch.cat([outputs[int(layer)] for layer in options["layers"].split(",")], 1)
                groups = int(options.get("groups", 1))
                x = x.reshape(len(x), groups, -1, *x.shape[2:])[:, int(options.get("group_id", 0))]
            else:
                maps.append(x)
            outputs.append(x)
        assert len(self.numbers) == 0
        return maps


@pytest.mark.parametrize("version", [(0, 1), (0, 2)])
def test_small_network_equals_the_plain_implementation(small_cfg, write_weights, version, dtype):
    weights = write_weights(version)
    network = Darknet(read_cfg(small_cfg)).to(dtype)
    assert network.read_weights(weights) == hashlib.sha256(weights.read_bytes()).hexdigest()
    image = torch.rand(3, 3, 32, 64, dtype=torch.float64)
    expected = PlainDarknet(small_cfg.read_text(), weights, 20 if version == (0, 2) else 16)(image)
    actual = network(image.to(dtype))
    assert [tuple(m.shape) for m in actual] == [(3, 14, 4, 8), (3, 7, 16, 32)]
    tolerance = {"atol": 1e-4, "rtol": 1e-4} if dtype == torch.float32 else {"atol": 1e-10, "rtol": 1e-10}
    for a, e in zip(actual, expected, strict=True):
        assert a.dtype == dtype
        torch.testing.assert_close(a, e.to(dtype), **tolerance)


@pytest.mark.weights
def test_published_yolov3_tiny_equals_the_plain_implementation(tiny_weights):
    sections = _yolov3_tiny()
    lines = [f"[{s.kind}]\n" + "".join(f"{key}={value}\n" for key, value in s.options.items()) for s in sections]
    network = Darknet(sections).eval().requires_grad_(False)
    network.read_weights(tiny_weights)
    image = torch.rand(1, 3, 96, 64, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = PlainDarknet("".join(lines), tiny_weights)(image)
    for a, e in zip(network(image.float()), expected, strict=True):
        torch.testing.assert_close(a.double(), e, atol=2e-4, rtol=0)


def test_gradient_reaches_the_image_and_the_network_compiles_to_a_single_graph(small_cfg, write_weights):
    network = Darknet(read_cfg(small_cfg)).double()
    network.read_weights(write_weights())
    image = torch.rand(1, 3, 8, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: tuple(network(x)), (image,), fast_mode=True)
    assert torch.autograd.grad(sum(m.sum() for m in network(image)), network.layers[0].weight)[0].any()
    network, image = Darknet(read_cfg(small_cfg)).eval(), torch.rand(2, 3, 32, 64)
    compiled = torch.compile(network, fullgraph=True, backend="eager")
    for actual, expected in zip(compiled(image), network(image), strict=True):
        torch.testing.assert_close(actual, expected)


def test_keeps_only_outputs_that_later_layers_need():
    # If no outputs were dropped, the 107 layers of YOLOv3 would need many times the memory of the largest one.
    network = Darknet(ARCHITECTURES["yolov3"](classes=1)).requires_grad_(False)
    alive = []
    original = network.run

    def run(outputs, start, stop):
        for index in range(start, stop):
            outputs = original(outputs, index, index + 1)
            alive.append(len(outputs))
        return outputs

    network.run = run
    network(torch.zeros(1, 3, 32, 32))
    assert max(alive) <= 6


YOLO = "[yolo]\nmask=0\nanchors=1,2\nclasses=1\n"
NET = "[net]\nwidth=32\nheight=32\nchannels=3\n"
MAPS = "[convolutional]\nfilters=6\nactivation=linear\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected [net]"),
        (MAPS + YOLO, "expected [net]"),
        (NET + MAPS, "at least one [yolo]"),
        (NET + "[lstm]\n", "cfg:5: layer [lstm] is not supported"),
        (NET + "[convolutional]\nactivation=hardtan\n", "got 'hardtan'"),
        (NET + "[convolutional]\nactivation=linear\ndilation=2\n", "got dilation=2, which is not supported"),
        (
            NET + "[convolutional]\nfilters=4\ngroups=2\nactivation=linear\n",
            "groups that divide 3 input channels and 4 filters, got 2",
        ),
        (NET + MAPS + "[route]\nlayers=-2\n", "expected layers to name an earlier layer, got layers=-2"),
        (NET + MAPS + "[route]\nlayers=1\n", "expected layers to name an earlier layer, got layers=1"),
        (NET + MAPS + "[route]\nlayers=0\ngroups=2\ngroup_id=2\n", "got group_id=2 and groups=2"),
        (NET + MAPS + "[maxpool]\nstride=2\n[route]\nlayers=0,1\n", "expected layers of one size"),
        (NET + MAPS + "[maxpool]\nstride=2\n[shortcut]\nfrom=0\n", "one layer of the same shape"),
        (NET + MAPS + "[shortcut]\nfrom=0,0\n", "one layer of the same shape"),
        (NET + MAPS + "[yolo]\nmask=0,1\nanchors=1,2,3,4\nclasses=1\n", "expected 12 channels, got 6"),
        (NET + MAPS + "[yolo]\nmask=1\nanchors=1,2\nclasses=1\n", "got 2 numbers and the mask (1,)"),
        (NET + MAPS + "[yolo]\nmask=0\nanchors=1,2,3\nclasses=1\n", "got 3 numbers and the mask (0,)"),
        (NET + MAPS + "[yolo]\nanchors=1,2\nclasses=1\nscale_x_y=\n", "scale_x_y: expected one number, got ''"),
    ],
)
def test_refuses_invalid_cfgs_with_an_error_of_one_line(text, message):
    with pytest.raises(DataError) as caught:
        Darknet(_parse_cfg(text))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_dropout_is_ignored_and_masks_default_to_all_anchors():
    sections = _parse_cfg(NET + "[dropout]\nprobability=.5\n" + MAPS + YOLO)
    network, plain = Darknet(sections), Darknet([s for s in sections if s.kind != "dropout"])
    network.layers[1].load_state_dict(plain.layers[0].state_dict())
    image = torch.rand(1, 3, 4, 4)
    assert torch.equal(network(image)[0], plain(image)[0])
    section = Section("yolo", {"anchors": "1,2, 3,4", "classes": "1"})
    network = Darknet([*_parse_cfg(NET + MAPS.replace("6", "12")), section])
    assert network.heads[0].anchors == ((1.0, 2.0), (3.0, 4.0))


@pytest.mark.parametrize(
    ("name", "layers", "convolutions", "size", "masks"),
    [
        ("yolov3", 107, 75, 416, [(6, 7, 8), (3, 4, 5), (0, 1, 2)]),
        ("yolov3-spp", 114, 76, 608, [(6, 7, 8), (3, 4, 5), (0, 1, 2)]),
        ("yolov3-tiny", 24, 13, 416, [(3, 4, 5), (1, 2, 3)]),
    ],
)
def test_published_networks_have_the_published_layers_and_sizes(name, layers, convolutions, size, masks):
    sections = ARCHITECTURES[name]()
    network = Darknet(sections)
    found = [layer for layer in network.layers if isinstance(layer, Convolution)]
    assert len(network.layers) == layers
    assert len(found) == convolutions
    assert network.input_size == (size, size)
    assert network.stride == 32
    # The size of the published weights file equals the size that the network needs.
    numbers = sum(layer.weight.numel() + layer.out_channels * (4 if layer.normalised else 1) for layer in found)
    assert 20 + 4 * numbers == WEIGHTS[name].size
    anchors = [s.numbers("anchors") for s in sections if s.kind == "yolo"]
    pairs = [list(zip(a[::2], a[1::2], strict=True)) for a in anchors]
    for head, mask, own in zip(network.heads, masks, pairs, strict=True):
        assert isinstance(head, Head)
        assert head.anchors == tuple(own[index] for index in mask)
        assert head.channels == 255


def test_lateral_connections_and_heads_of_published_networks():
    routes = [s.integers("layers") for s in ARCHITECTURES["yolov3"]() if s.kind == "route"]
    assert routes == [(-4,), (-1, 61), (-4,), (-1, 36)]
    assert Darknet(ARCHITECTURES["yolov3-tiny"](classes=3)).heads[0].channels == 24


def darknet_maxpool(image: np.ndarray, size: int, stride: int, padding: int) -> np.ndarray:
    """Darknet's loops over one channel, with its integer divisions."""
    height, width = image.shape
    rows, columns = (height + padding - size) // stride + 1, (width + padding - size) // stride + 1
    result = np.full((rows, columns), -np.inf)
    offset = -(padding // 2)
    for i in range(rows):
        for j in range(columns):
            for n in range(size):
                for m in range(size):
                    y, x = offset + i * stride + n, offset + j * stride + m
                    if 0 <= y < height and 0 <= x < width:
                        result[i, j] = max(result[i, j], image[y, x])
    return result


@pytest.mark.parametrize("shape", [(13, 10), (8, 7)])
@pytest.mark.parametrize(
    ("size", "stride", "padding"),
    [(2, 2, 1), (2, 1, 1), (5, 1, 4), (13, 1, 12), (3, 2, 2), (3, 2, 0), (2, 2, 0), (3, 1, 3)],
)
def test_maxpool_equals_darknets(shape, size, stride, padding):
    if min(shape) + padding < size:
        pytest.skip("no output")
    image = np.random.default_rng(0).normal(size=shape) - 5
    actual = MaxPool(size, stride, padding)(torch.from_numpy(image)[None, None])
    np.testing.assert_array_equal(actual[0, 0].numpy(), darknet_maxpool(image, size, stride, padding))


def test_comments_blanks_and_repeated_keys():
    (section,) = _parse_cfg("# net\n ; net\n\n [ net ] \n width = 32 \n width=64\nempty=\n")
    assert section.kind == "net"
    assert section.options == {"width": "32", "empty": ""}
    assert section.where == "cfg:4"


def test_values_are_converted_and_checked():
    section = Section("yolo", {"mask": "1,2,", "anchors": "1.5,2,3,4", "size": "3", "word": "x"}, "a.cfg:7")
    assert section.integers("mask") == (1, 2)
    assert section.numbers("anchors") == (1.5, 2.0, 3.0, 4.0)
    assert section.integer("size") == 3
    assert section.integer("stride", 2) == 2
    unusable(r"a.cfg:7: \[yolo\]: expected the key 'classes', got none", section.integer, "classes")
    for key in ("mask", "word"):
        unusable(rf"a.cfg:7: \[yolo\] {key}: expected", section.integer, key)
    unusable("of at least 4, got '3'", section.integer, "size", minimum=4)
    unusable("expected finite numbers, got 'x'", section.numbers, "word")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:-4], "truncated"),
        (lambda data: data[:10], "truncated"),
        (lambda data: b"", "truncated"),
        (lambda data: data + bytes(4), "too long"),
        (lambda data: b"<html>" + data, "too long"),
        (lambda data: data[:-4] + np.float32(np.nan).tobytes(), "finite numbers"),
        (lambda data: data[: 20 + 24 * 4] + np.full(8, -1, "<f4").tobytes() + data[20 + 32 * 4 :], "variances"),
    ],
)
def test_refuses_damaged_weights_with_an_error_of_one_line(small_cfg, write_weights, damage, message):
    path = write_weights()
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DataError) as caught:
        Darknet(read_cfg(small_cfg)).read_weights(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_refuses_what_cannot_be_read_and_invalid_settings(small_cfg, tmp_path):
    for size in [(3, 32, 31), (3, 0, 32), (1, 32, 32)]:
        refused("image: expected", Darknet(read_cfg(small_cfg)), torch.zeros(1, *size))
    for text in ["width=3", "[net]\nwidth 3", "[net"]:
        unusable(r"cfg:\d: expected \[section\] or key=value", _parse_cfg, text)
    unusable(r"missing\.cfg: no such file", read_cfg, tmp_path / "missing.cfg")
    binary = tmp_path / "binary.cfg"
    binary.write_bytes(b"\x9f\xfe\x07\x9f")
    unusable("expected a file of text", read_cfg, binary)
    with pytest.raises(DataError, match=r"missing\.weights': no such file"):
        Darknet(read_cfg(small_cfg)).read_weights(tmp_path / "missing.weights")
    refused("raw: expected a multiple of 2 anchors", decode_yolo, torch.zeros(1, 15, 1, 1), ANCHORS, (32, 32))
    for options, message in [
        ({"classes": ("cat",)}, "classes: expected 2 names, got 1"),
        ({"input_size": (30, 32)}, "input_size: expected a multiple of 8"),
        ({"input_size": (0, 32)}, "input_size: expected a multiple of 8"),
        ({"stride": 6}, "stride: expected None or a multiple of 8"),
    ]:
        refused(message, YoloV3, Darknet(read_cfg(small_cfg)), **{"classes": ("cat", "dog")} | options)


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


def test_settings_contain_runtime_digest_and_cfg(make_small, small_cfg):
    before = make_small().settings()
    assert before["runtime"] == "torch"
    small_cfg.write_text(small_cfg.read_text().replace("mask=0", "mask=1"))
    after = make_small().settings()
    assert after["digest"] == before["digest"]
    assert after["cfg"] != before["cfg"]

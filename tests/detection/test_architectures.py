import pytest

from semfov.detection.darknet import Convolution, Darknet, Head
from semfov.detection.darknet_config import ARCHITECTURES
from semfov.detection.weights import WEIGHTS


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


def test_lateral_connections_of_yolov3():
    routes = [s.integers("layers") for s in ARCHITECTURES["yolov3"]() if s.kind == "route"]
    assert routes == [(-4,), (-1, 61), (-4,), (-1, 36)]


def test_heads_follow_the_number_of_classes():
    assert Darknet(ARCHITECTURES["yolov3-tiny"](classes=3)).heads[0].channels == 24

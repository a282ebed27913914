"""The last layers of a network, against the whole network."""

import pytest
import torch

from semfov.detection.architectures import yolov3, yolov3_tiny
from semfov.detection.darknet import Darknet
from semfov.errors import InputError
from semfov.training.tail import Tail

NETWORKS = {"yolov3-tiny": yolov3_tiny, "yolov3": yolov3}


@pytest.fixture(params=[("yolov3-tiny", 1), ("yolov3-tiny", 2), ("yolov3", 1), ("yolov3", 3)], ids=str)
def tail(request):
    """The tail of a network with random weights and 3 classes."""
    name, depth = request.param
    torch.manual_seed(0)
    return Tail(Darknet(NETWORKS[name](classes=3)).requires_grad_(False), depth)


def test_features_followed_by_the_tail_equal_the_network(tail):
    image = torch.rand(2, 3, 64, 96)
    features = tail.features(image)
    assert list(features) == tail.inputs
    for ours, whole in zip(tail(features), tail.network(image), strict=True):
        torch.testing.assert_close(ours, whole, rtol=1e-5, atol=1e-5)


def test_the_tail_does_not_change_its_features(tail):
    features = tail.features(torch.rand(1, 3, 32, 32))
    before = {number: tensor.clone() for number, tensor in features.items()}
    tail(features)
    for number, tensor in features.items():
        assert torch.equal(tensor, before[number])


def test_gradients_match_those_of_the_network(tail):
    image, parameters = torch.rand(1, 3, 32, 32), list(tail.named_parameters().values())
    for parameter in parameters:
        parameter.requires_grad_(True)

    def gradients(maps):
        return torch.autograd.grad(sum(raw.square().mean() for raw in maps), parameters)

    ours, whole = gradients(tail(tail.features(image))), gradients(tail.network(image))
    for one, other in zip(ours, whole, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


def test_features_do_not_depend_on_the_trained_weights(tail):
    image = torch.rand(1, 3, 32, 32)
    before = tail.features(image)
    for parameter in tail.named_parameters().values():
        parameter.data.zero_()
    for number, tensor in tail.features(image).items():
        assert torch.equal(tensor, before[number])


def test_layers_of_yolov3_tiny():
    network = Darknet(yolov3_tiny())
    layers = {depth: (Tail(network, depth).trained, Tail(network, depth).inputs) for depth in (1, 2)}
    assert layers == {1: ([15, 22], [14, 21]), 2: ([14, 15, 21, 22], [13, 20])}
    names = set(Tail(network).named_parameters())
    assert names == {f"layers.{number}.{what}" for number in (15, 22) for what in ("weight", "bias")}
    assert names <= set(dict(network.named_parameters()))


@pytest.mark.parametrize("depth", [0, 3])
def test_a_depth_that_the_network_does_not_have_is_refused(depth):
    with pytest.raises(InputError, match="depth: expected"):
        Tail(Darknet(yolov3_tiny()), depth)

"""The end of a network, trained by itself on what the rest of it gives."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn

from semfov.detection.darknet import Darknet
from semfov.detection.darknet_layers import Convolution, Head
from semfov.errors import check


class Tail:
    """The last convolutions before every head of a network, and the layers that depend on them.

    What these layers read of the others, the features, does not change while the tail is trained, and need be computed
    only once for an image. The convolutions are the network's own: training the tail trains the network.

    Args:
        network: whose tail it is.
        depth: convolutions before each head, one after the other, that belong to it.

    Attributes:
        trained: numbers of these convolutions, ascending.
        layers: numbers of the layers that depend on them, ascending.
        inputs: numbers of the layers that give the features, ascending.

    Raises:
        InputError: there are not so many convolutions one after the other before a head.

    >>> from semfov.detection.architectures import yolov3_tiny
    >>> tail = Tail(Darknet(yolov3_tiny()))
    >>> tail.trained, tail.inputs
    ([15, 22], [14, 21])
    """

    def __init__(self, network: Darknet, depth: int = 1) -> None:
        check(depth >= 1, "depth", "at least 1", depth)
        self.network = network
        self._maps = [number for number, layer in enumerate(network.layers) if isinstance(layer, Head)]
        trained = {number for head in self._maps for number in self._before(head, depth)}
        reached: set[int] = set()
        for number, sources in enumerate(network.sources):
            if number in trained or reached & set(sources):
                reached.add(number)
        self.trained, self.layers = sorted(trained), sorted(reached)
        self.inputs = sorted({source for number in self.layers for source in network.sources[number]} - reached)

    def _before(self, head: int, depth: int) -> Iterator[int]:
        """The convolutions before a head, the last one first."""
        number = head
        for _ in range(depth):
            number = self.network.sources[number][0]
            fits = number >= 0 and isinstance(self.network.layers[number], Convolution)
            check(fits, "depth", "only convolutions one after the other before each head", depth)
            yield number

    def named_parameters(self) -> dict[str, nn.Parameter]:
        """Weights and biases that are trained, by the names that the network has for them."""
        return {
            f"layers.{number}.{name}": parameter
            for number in self.trained
            for name, parameter in self.network.layers[number].named_parameters()
        }

    @torch.no_grad()
    def features(self, canvas: Tensor) -> dict[int, Tensor]:
        """What the tail reads of an image `(B, 3, H, W)`, by the number of the layer that gives it."""
        self.network.check_image(canvas)
        outputs = {-1: canvas.contiguous(memory_format=torch.channels_last)}
        found = {}
        for number in range(self.inputs[-1] + 1):
            outputs = self.network.run(outputs, number, number + 1)
            if number in self.inputs:
                found[number] = outputs[number]
        return found

    def __call__(self, features: Mapping[int, Tensor]) -> list[Tensor]:
        """Raw maps of the heads from the features of images."""
        outputs = dict(features)
        for number in self.layers:
            outputs[number] = self.network.layers[number](*(outputs[at] for at in self.network.sources[number]))
        return [outputs[number] for number in self._maps]

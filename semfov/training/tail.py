"""The last layers of a network, trained by themselves on the features of the other layers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn

from semfov.detection.darknet import Darknet
from semfov.detection.darknet_layers import Convolution, Head
from semfov.errors import check


class Tail:
    """The last convolutions before every head of a network, and the layers that depend on them.

    The features that these layers read from the other layers do not change during the training of the tail. They have
    to be computed only once for an image. The tail shares its convolutions with the network, so training the tail
    changes the network.

    Args:
        network: the network.
        depth: number of consecutive convolutions before each head to train.

    Attributes:
        trained: numbers of these convolutions, ascending.
        layers: numbers of these convolutions and of the layers that depend on them, ascending.
        inputs: numbers of the layers that give the features, ascending.

    Raises:
        InputError: a head has fewer consecutive convolutions before it.

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
        """Find the convolutions before a head, beginning with the last one."""
        number = head
        for _ in range(depth):
            number = self.network.sources[number][0]
            fits = number >= 0 and isinstance(self.network.layers[number], Convolution)
            check(fits, "depth", "no more than the number of consecutive convolutions before each head", depth)
            yield number

    def named_parameters(self) -> dict[str, nn.Parameter]:
        """Return the weights and biases to train, under their names in the network."""
        return {
            f"layers.{number}.{name}": parameter
            for number in self.trained
            for name, parameter in self.network.layers[number].named_parameters()
        }

    @torch.no_grad()
    def features(self, canvas: Tensor) -> dict[int, Tensor]:
        """Compute the features that the tail reads.

        Args:
            canvas: images `(B, 3, H, W)`.

        Returns:
            The features by the number of the layer that gives them.
        """
        self.network.check_image(canvas)
        outputs = {-1: canvas.contiguous(memory_format=torch.channels_last)}
        found = {}
        for number in range(self.inputs[-1] + 1):
            outputs = self.network.run(outputs, number, number + 1)
            if number in self.inputs:
                found[number] = outputs[number]
        return found

    def __call__(self, features: Mapping[int, Tensor]) -> list[Tensor]:
        """Compute the raw maps of the heads from the features of images."""
        outputs = dict(features)
        for number in self.layers:
            outputs[number] = self.network.layers[number](*(outputs[at] for at in self.network.sources[number]))
        return [outputs[number] for number in self._maps]

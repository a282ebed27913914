"""The layers of Darknet networks."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "linear": lambda x: x,
    "leaky": lambda x: F.leaky_relu(x, 0.1, inplace=True),
    "relu": lambda x: F.relu(x, inplace=True),
    "mish": F.mish,
    "swish": F.silu,
    "logistic": F.sigmoid,
}
"""Activations by their Darknet name; they may overwrite their argument."""


class Convolution(nn.Conv2d):
    """Convolution and activation; batch norm is folded into the weight and the bias.

    Attributes:
        normalised: whether the weights file holds batch-norm statistics for this layer.
        activation: name of the activation in `ACTIVATIONS`.

    Shape:
        - input: `(B, in_channels, H, W)`
        - output: `(B, out_channels, H', W')`
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        size: int,
        *,
        stride: int = 1,
        padding: int = 0,
        groups: int = 1,
        activation: str = "linear",
        normalised: bool = False,
    ) -> None:
        super().__init__(in_channels, out_channels, size, stride, padding, groups=groups)
        self.activation, self.normalised = activation, normalised

    def forward(self, input: Tensor) -> Tensor:
        """Convolve and activate."""
        return ACTIVATIONS[self.activation](super().forward(input))


class MaxPool(nn.Module):
    """Darknet's max pool.

    The padding (by default `size - 1`) is split between both sides; if it is odd, the larger half is on the right and
    at the bottom. The output is `(W + padding - size) // stride + 1` wide, so `size=2, stride=1` keeps the size.
    """

    def __init__(self, size: int, stride: int, padding: int) -> None:
        super().__init__()
        self.size, self.stride, self.padding = size, stride, padding

    def forward(self, image: Tensor) -> Tensor:
        """Pool `(B, C, H, W)` to `(B, C, H', W')`."""
        before = self.padding // 2
        right, bottom = (self._after(n, before) for n in (image.shape[-1], image.shape[-2]))
        if before == right == bottom and 2 * before <= self.size:
            return F.max_pool2d(image, self.size, self.stride, before)
        padded = F.pad(image, (before, right, before, bottom), value=float("-inf"))
        return F.max_pool2d(padded, self.size, self.stride)

    def _after(self, length: int, before: int) -> int:
        outputs = (length + self.padding - self.size) // self.stride + 1
        return max(0, (outputs - 1) * self.stride + self.size - length - before)


class Upsample(nn.Module):
    """Repeat every pixel `stride` times in both axes."""

    def __init__(self, stride: int) -> None:
        super().__init__()
        self.stride = stride

    def forward(self, image: Tensor) -> Tensor:
        """Enlarge `(B, C, H, W)` to `(B, C, stride H, stride W)`."""
        return F.interpolate(image, scale_factor=float(self.stride), mode="nearest")


class Route(nn.Module):
    """Concatenate the channels of earlier layers, or one of `groups` equal parts of each."""

    def __init__(self, groups: int = 1, group: int = 0) -> None:
        super().__init__()
        self.groups, self.group = groups, group

    def forward(self, *images: Tensor) -> Tensor:
        """Concatenate `(B, C_i, H, W)` to `(B, Σ C_i / groups, H, W)`."""
        chunks = [image.chunk(self.groups, 1)[self.group] for image in images]
        return chunks[0] if len(chunks) == 1 else torch.cat(chunks, 1)


class Shortcut(nn.Module):
    """Add the output of an earlier layer to the output of the previous one, and activate."""

    def __init__(self, activation: str) -> None:
        super().__init__()
        self.activation = activation

    def forward(self, image: Tensor, earlier: Tensor) -> Tensor:
        """Add two maps `(B, C, H, W)`."""
        return ACTIVATIONS[self.activation](image + earlier)


class Head(nn.Module):
    """A yolo layer: it returns its map unchanged, and holds the settings for decoding it.

    Attributes:
        anchors: `(width, height)` of the anchors in canvas pixels.
        classes: number of classes.
        scale: Darknet's `scale_x_y`; with more than 1, centres of boxes may lie outside their cell.
    """

    def __init__(self, anchors: tuple[tuple[float, float], ...], classes: int, scale: float = 1.0) -> None:
        super().__init__()
        self.anchors, self.classes, self.scale = anchors, classes, scale

    @property
    def channels(self) -> int:
        """Number of channels of the map: centre, size, objectness and classes of every anchor."""
        return len(self.anchors) * (5 + self.classes)

    def forward(self, image: Tensor) -> Tensor:
        """Return the map unchanged."""
        return image

"""Darknet networks as torch modules, built from the sections of a cfg."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import torch
from torch import Tensor, nn

from semfov.detection.darknet_config import Section
from semfov.detection.darknet_layers import ACTIVATIONS, Convolution, Head, MaxPool, Route, Shortcut, Upsample
from semfov.detection.winograd import WinogradConvolution
from semfov.errors import DataError, check, check_shape

# Keys that would change what a layer computes, with the only value that is implemented.
_NEUTRAL = {
    "convolutional": {"binary": "0", "xnor": "0", "dilation": "1", "antialiasing": "0"},
    "maxpool": {"maxpool_depth": "0", "antialiasing": "0"},
    "shortcut": {"weights_type": "none"},
    "upsample": {"scale": "1"},
    "yolo": {"new_coords": "0"},
}


class Darknet(nn.Module):
    """A network from the sections of a cfg, with random weights; `read_weights` gives it trained ones.

    Layers: convolutional, maxpool, upsample, route, shortcut, yolo, and dropout, which does nothing here.

    Attributes:
        input_size: `(width, height)` that the cfg asks for.
        stride: both sides of an input must be multiples of it.
        heads: the yolo layers, in order.

    Shape:
        - input: `(B, C, H, W)`
        - output: for each head with A anchors and K classes a map `(B, A (5 + K), H', W')`

    >>> from semfov.detection.architectures import yolov3_tiny
    >>> [tuple(m.shape) for m in Darknet(yolov3_tiny())(torch.zeros(1, 3, 64, 96))]
    [(1, 255, 2, 3), (1, 255, 4, 6)]
    """

    def __init__(self, sections: Sequence[Section]) -> None:
        super().__init__()
        if not sections or sections[0].kind not in ("net", "network"):
            raise DataError("cfg: expected [net] as its first section")
        self.input_size = (sections[0].integer("width", 416), sections[0].integer("height", 416))
        self.channels = sections[0].integer("channels", 3)
        builder = _Builder(self.channels)
        self.layers = nn.ModuleList([builder.add(section) for section in sections[1:]])
        self.heads = [layer for layer in self.layers if isinstance(layer, Head)]
        if not self.heads:
            raise DataError(f"{sections[0].where}: expected at least one [yolo] section, got none")
        self.stride = max(-(-shape.step.numerator // shape.step.denominator) for shape in builder.shapes)
        self._sources = builder.sources
        self._last_reader = {source: index for index, read in enumerate(self._sources) for source in read}

    def forward(self, image: Tensor) -> list[Tensor]:
        """Raw maps of the heads."""
        check_shape(image, "image", None, self.channels, None, None)
        height, width = image.shape[-2:]
        fits = height % self.stride == 0 and width % self.stride == 0 and height * width > 0
        check(fits, "image", f"sides that are multiples of {self.stride}", f"{width} x {height}")
        outputs = {-1: image.contiguous(memory_format=torch.channels_last)}
        maps = []
        for index, (layer, sources) in enumerate(zip(self.layers, self._sources, strict=True)):
            outputs[index] = layer(*(outputs[source] for source in sources))
            if isinstance(layer, Head):
                maps.append(outputs[index])
            for source in set(sources):
                if self._last_reader[source] == index:
                    del outputs[source]
        return maps

    def use_winograd(self, tile: int = 2, *, channels: int = 64) -> None:
        """Compute 3 x 3 convolutions of at least `channels` inputs by Winograd's algorithm; for inference only."""
        for index, layer in enumerate(self.layers):
            if isinstance(layer, Convolution) and WinogradConvolution.replaces(layer):
                if layer.in_channels >= channels:
                    self.layers[index] = WinogradConvolution(layer, tile)


@dataclass(frozen=True)
class _Shape:
    """Channels of an output, and input pixels per output pixel."""

    channels: int
    step: Fraction


class _Builder:
    """Turns sections into layers, and keeps track of shapes and of what each layer reads."""

    def __init__(self, channels: int) -> None:
        self.shapes: list[_Shape] = []
        self.sources: list[tuple[int, ...]] = []
        self._image = _Shape(channels, Fraction(1))
        self._makers: dict[str, Callable[[Section], nn.Module]] = {
            "convolutional": self._convolution,
            "maxpool": self._maxpool,
            "upsample": self._upsample,
            "route": self._route,
            "shortcut": self._shortcut,
            "yolo": self._yolo,
            "dropout": self._dropout,
        }

    def add(self, section: Section) -> nn.Module:
        if section.kind not in self._makers:
            known = ", ".join(self._makers)
            raise DataError(f"{section.where}: layer [{section.kind}] is not supported; supported: {known}")
        for key, value in _NEUTRAL.get(section.kind, {}).items():
            if section.text(key, value) != value:
                raise DataError(f"{section.where}: [{section.kind}] {key}={section.text(key)} is not supported")
        return self._makers[section.kind](section)

    @property
    def _here(self) -> _Shape:
        return self.shapes[-1] if self.shapes else self._image

    def _note(self, channels: int, step: Fraction, *sources: int) -> None:
        self.sources.append((len(self.shapes) - 1, *sources))
        self.shapes.append(_Shape(channels, step))

    def _convolution(self, section: Section) -> nn.Module:
        here, filters, groups = self._here, section.integer("filters", 1), section.integer("groups", 1)
        if here.channels % groups or filters % groups:
            raise DataError(f"{section.where}: groups={groups} divides not both {here.channels} and {filters} channels")
        size, stride = section.integer("size", 1), section.integer("stride", 1)
        same = section.integer("pad", 0, minimum=0)
        self._note(filters, here.step * stride)
        return Convolution(
            here.channels,
            filters,
            size,
            stride=stride,
            padding=size // 2 if same else section.integer("padding", 0, minimum=0),
            groups=groups,
            activation=_activation(section, "logistic"),
            normalised=bool(section.integer("batch_normalize", 0, minimum=0)),
        )

    def _maxpool(self, section: Section) -> nn.Module:
        stride = section.integer("stride", 1)
        size = section.integer("size", stride)
        self._note(self._here.channels, self._here.step * stride)
        return MaxPool(size, stride, section.integer("padding", size - 1, minimum=0))

    def _upsample(self, section: Section) -> nn.Module:
        stride = section.integer("stride", 2)
        self._note(self._here.channels, self._here.step / stride)
        return Upsample(stride)

    def _route(self, section: Section) -> nn.Module:
        sources = tuple(self._layer(section, "layers", layer) for layer in section.integers("layers"))
        groups, group = section.integer("groups", 1), section.integer("group_id", 0, minimum=0)
        shapes = [self.shapes[source] for source in sources]
        if len({shape.step for shape in shapes}) != 1:
            raise DataError(f"{section.where}: [route] expected layers of one size, got {section.text('layers')}")
        if group >= groups or any(shape.channels % groups for shape in shapes):
            raise DataError(f"{section.where}: [route] has no part {group} of {groups} equal groups of channels")
        self.sources.append(sources)
        self.shapes.append(_Shape(sum(shape.channels for shape in shapes) // groups, shapes[0].step))
        return Route(groups, group)

    def _shortcut(self, section: Section) -> nn.Module:
        sources = [self._layer(section, "from", layer) for layer in section.integers("from")]
        if len(sources) != 1 or self.shapes[sources[0]] != self._here:
            raise DataError(f"{section.where}: [shortcut] expected one layer of the same shape, got {sources}")
        self._note(self._here.channels, self._here.step, *sources)
        return Shortcut(_activation(section, "linear"))

    def _yolo(self, section: Section) -> nn.Module:
        numbers = section.numbers("anchors")
        pairs = list(zip(numbers[::2], numbers[1::2], strict=False))
        mask = section.integers("mask", ",".join(map(str, range(len(pairs)))))
        if len(numbers) % 2 or not mask or any(not 0 <= index < len(pairs) for index in mask):
            raise DataError(f"{section.where}: [yolo] mask {mask} does not choose from {len(numbers)} / 2 anchors")
        scale = section.numbers("scale_x_y", "1")
        head = Head(tuple(pairs[index] for index in mask), section.integer("classes", 20), scale[0])
        if head.channels != self._here.channels:
            raise DataError(f"{section.where}: [yolo] expected {head.channels} channels, got {self._here.channels}")
        self._note(self._here.channels, self._here.step)
        return head

    def _dropout(self, section: Section) -> nn.Module:
        self._note(self._here.channels, self._here.step)
        return nn.Identity()

    def _layer(self, section: Section, key: str, number: int) -> int:
        index = number if number >= 0 else len(self.shapes) + number
        if not 0 <= index < len(self.shapes):
            raise DataError(f"{section.where}: [{section.kind}] {key}={number} points to no earlier layer")
        return index


def _activation(section: Section, default: str) -> str:
    name = section.text("activation", default)
    if name not in ACTIVATIONS:
        raise DataError(f"{section.where}: activation {name!r} is not supported; known: {', '.join(ACTIVATIONS)}")
    return name

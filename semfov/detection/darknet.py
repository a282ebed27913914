"""Darknet networks as PyTorch modules: their layers, built from the sections of a cfg, and their weights files."""

import hashlib
import math
import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from os import PathLike
from pathlib import Path
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.detection.darknet_config import Section
from semfov.detection.feature_maps import NetworkStep, landmarks
from semfov.detection.onnx_file import check_canvas
from semfov.errors import DataError, check, check_data, check_shape
from semfov.io.files import reading
from semfov.io.schema import excerpt

_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "linear": lambda x: x,
    "leaky": lambda x: F.leaky_relu(x, 0.1, inplace=True),
    "relu": lambda x: F.relu(x, inplace=True),
    "mish": F.mish,
    "swish": F.silu,
    "logistic": F.sigmoid,
}
"""Activations by their Darknet name; they may overwrite their argument."""


class Convolution(nn.Conv2d):
    """Convolution and activation; batch norm is folded into the weight and the bias."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        size: int,
        *,
        stride: int,
        padding: int,
        groups: int,
        activation: str,
        normalised: bool,
    ) -> None:
        super().__init__(in_channels, out_channels, size, stride, padding, groups=groups)
        self.activation = activation
        self.normalised = normalised

    @property
    def stored_numbers(self) -> int:
        """Number of its numbers in a weights file: the kernel and the bias, and the other vectors of batch norm."""
        return self.weight.numel() + self.out_channels * self.stored_vectors

    @property
    def stored_vectors(self) -> int:
        """Number of its vectors in a weights file: bias, with batch norm also scale, mean and variance."""
        return 4 if self.normalised else 1

    def forward(self, input: Tensor) -> Tensor:
        return _ACTIVATIONS[self.activation](super().forward(input))


class MaxPool(nn.Module):
    """Darknet's max pool; of an odd padding (by default `size - 1`) the larger half is right and below."""

    def __init__(self, size: int, stride: int, padding: int) -> None:
        super().__init__()
        self.size = size
        self.stride = stride
        self.padding = padding

    def forward(self, image: Tensor) -> Tensor:
        """Pool `(B, C, H, W)` to `(B, C, H', W')`."""
        before = self.padding // 2
        right = self._padding_after(image.shape[-1])
        bottom = self._padding_after(image.shape[-2])
        # PyTorch's own padding is the same on both sides, and at most half the size.
        if before == right == bottom and 2 * before <= self.size:
            return F.max_pool2d(image, self.size, self.stride, before)
        padded = F.pad(image, (before, right, before, bottom), value=float("-inf"))
        return F.max_pool2d(padded, self.size, self.stride)

    def _padding_after(self, length: int) -> int:
        """Pixels beyond the end of a side that the last window reaches."""
        last = (length + self.padding - self.size) // self.stride
        end = last * self.stride + self.size - self.padding // 2
        return max(0, end - length)


class Route(nn.Module):
    """The channels of earlier layers, concatenated, or of one of `groups` equal parts of each."""

    def __init__(self, groups: int, group: int) -> None:
        super().__init__()
        self.groups = groups
        self.group = group

    def forward(self, *images: Tensor) -> Tensor:
        """Concatenate `(B, C_i, H, W)` to `(B, Σ C_i / groups, H, W)`."""
        chunks = [image.chunk(self.groups, 1)[self.group] for image in images]
        return chunks[0] if len(chunks) == 1 else torch.cat(chunks, 1)


class Shortcut(nn.Module):
    """The sum of the output of an earlier layer and that of the previous one, activated."""

    def __init__(self, activation: str) -> None:
        super().__init__()
        self.activation = activation

    def forward(self, image: Tensor, earlier: Tensor) -> Tensor:
        """Add two maps `(B, C, H, W)`."""
        return _ACTIVATIONS[self.activation](image + earlier)


class Head(nn.Identity):
    """A yolo layer: it returns its map unchanged, and holds the settings for decoding it; anchors `(width, height)`."""

    def __init__(self, anchors: tuple[tuple[float, float], ...], classes: int, scale: float) -> None:
        super().__init__()
        self.anchors = anchors
        self.classes = classes
        self.scale = scale

    @property
    def channels(self) -> int:
        """Number of channels of the map: centre, size, objectness and classes of every anchor."""
        return len(self.anchors) * (5 + self.classes)


# YOLOv3 has 62 million parameters and a map of 12 million numbers; the limits keep a typing error from filling memory.
_MOST_PARAMETERS = 3 * 10**8
_MOST_ELEMENTS = 2**28
_MOST_LAYERS = 2000
_LARGEST_KERNEL = 255

# Keys that change what a layer computes, with the only value that is implemented.
_NEUTRAL = {
    "convolutional": {"binary": "0", "xnor": "0", "dilation": "1", "antialiasing": "0"},
    "maxpool": {"maxpool_depth": "0", "antialiasing": "0"},
    "shortcut": {"weights_type": "none"},
    "upsample": {"scale": "1"},
    "yolo": {"new_coords": "0"},
}


class _Shape(NamedTuple):
    """Channels of an output, and input pixels per output pixel."""

    channels: int
    step: Fraction


class _Builder:
    """A maker of layers from sections, one after the other, that keeps track of what they return and read.

    Attributes:
        shapes: shapes of the outputs of the layers made so far.
        sources: the layers that each of them reads, -1 for the image.

    `_here` is the shape of the last output, before the first layer that of the image. `_pixels` are those of the image
    at the input size of the cfg, and `_parameters` those of all layers so far, for the limits.

    Invariant: after `add`, `shapes` and `sources` have one entry more, at the layer's number, all of whose sources are
    smaller numbers; and `_here` is the last shape.
    """

    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        width, height = size
        self._pixels = width * height
        self._parameters = 0
        self._here = _Shape(channels, Fraction(1))
        self.shapes: list[_Shape] = []
        self.sources: list[tuple[int, ...]] = []
        self._makers: dict[str, Callable[[Section], nn.Module]] = {
            "convolutional": self._convolution,
            "maxpool": self._max_pool,
            "upsample": self._upsample,
            "route": self._route,
            "shortcut": self._shortcut,
            "yolo": self._yolo,
            "dropout": self._dropout,
        }

    def add(self, section: Section) -> nn.Module:
        """Make the layer of a section."""
        few = len(self.shapes) < _MOST_LAYERS
        check_data(few, section.where, f"at most {_MOST_LAYERS} layers", "more; check the cfg")
        for key, value in _NEUTRAL.get(section.kind, {}).items():
            got = section.text(key, value)
            section.check(got == value, f"{key}={value}", f"{key}={got}, which is not supported")
        if section.kind not in self._makers:
            supported = ", ".join(self._makers)
            raise DataError(f"{section.where}: layer [{section.kind}] is not supported; supported: {supported}")
        return self._makers[section.kind](section)

    def _note(self, shape: _Shape, *sources: int) -> None:
        """Note what a layer returns and reads; raises `DataError` where its map is too large."""
        # A fraction, which is exact: a cfg may state sizes that no float can hold.
        numbers = self._pixels * shape.channels / shape.step**2
        most = f"a map of at most {_MOST_ELEMENTS:,} numbers"
        check_data(numbers <= _MOST_ELEMENTS, f"cfg: layer {len(self.shapes)}", most, "more")
        self.sources.append(sources)
        self.shapes.append(shape)
        self._here = shape

    @property
    def _previous(self) -> int:
        """Number of the layer before the one that is made."""
        return len(self.shapes) - 1

    def _convolution(self, section: Section) -> nn.Module:
        channels, step = self._here
        # Cfgs leave out keys for which Darknet has a value, such as this 1: here and in other layers it is the same.
        filters = section.integer("filters", 1)
        groups = section.integer("groups", 1)
        counts = f"{excerpt(channels)} input channels and {excerpt(filters)} filters"
        section.check(channels % groups == filters % groups == 0, f"groups that divide {counts}", excerpt(groups))
        size = section.integer("size", 1)
        stride = section.integer("stride", 1)
        # Parameters are counted before the layer is made, because making it allocates them.
        self._parameters += channels // groups * filters * size**2 + 4 * filters
        most = f"at most {_MOST_PARAMETERS:,} parameters up to this layer"
        section.check(self._parameters <= _MOST_PARAMETERS, most, "more; check the cfg")
        padding = section.integer("padding", 0, minimum=0)
        _check_kernel(section, size, stride, padding)
        self._note(_Shape(filters, step * stride), self._previous)
        # As in Darknet, `pad` is a flag that overrides `padding`.
        if section.integer("pad", 0, minimum=0):
            padding = size // 2
        return Convolution(
            channels,
            filters,
            size,
            stride=stride,
            padding=padding,
            groups=groups,
            activation=_activation(section, "logistic"),
            normalised=bool(section.integer("batch_normalize", 0, minimum=0)),
        )

    def _max_pool(self, section: Section) -> nn.Module:
        stride = section.integer("stride", 1)
        size = section.integer("size", stride)
        padding = section.integer("padding", size - 1, minimum=0)
        _check_kernel(section, size, stride, padding)
        self._note(_Shape(self._here.channels, self._here.step * stride), self._previous)
        return MaxPool(size, stride, padding)

    def _upsample(self, section: Section) -> nn.Module:
        stride = section.integer("stride", 2)
        self._note(_Shape(self._here.channels, self._here.step / stride), self._previous)
        return nn.Upsample(scale_factor=float(stride), mode="nearest")

    def _route(self, section: Section) -> nn.Module:
        """Note the channels of several layers, or one of equal groups of the channels of each."""
        sources = self._layers(section, "layers")
        groups = section.integer("groups", 1)
        group = section.integer("group_id", 0, minimum=0)
        shapes = [self.shapes[source] for source in sources]
        steps = {shape.step for shape in shapes}
        section.check(len(steps) == 1, "layers of one size", section.text("layers"))
        channels = [shape.channels for shape in shapes]
        divided = group < groups and not any(count % groups for count in channels)
        expected = f"a group_id below groups, and groups that divide the channels {excerpt(channels)}"
        section.check(divided, expected, f"group_id={excerpt(group)} and groups={excerpt(groups)}")
        self._note(_Shape(sum(channels) // groups, shapes[0].step), *sources)
        return Route(groups, group)

    def _shortcut(self, section: Section) -> nn.Module:
        sources = self._layers(section, "from")
        alike = len(sources) == 1 and self.shapes[sources[0]] == self._here
        section.check(alike, "one layer of the same shape", f"layers {sources}")
        self._note(self._here, self._previous, *sources)
        return Shortcut(_activation(section, "linear"))

    def _yolo(self, section: Section) -> nn.Module:
        """Note a head with the anchors that its mask selects, for a map with its channels."""
        numbers = section.numbers("anchors")
        anchors = list(zip(numbers[::2], numbers[1::2], strict=False))
        every_anchor = ",".join(map(str, range(len(anchors))))
        mask = section.integers("mask", every_anchor)
        are_pairs = len(numbers) % 2 == 0
        is_mask = bool(mask) and all(0 <= index < len(anchors) for index in mask)
        got = f"{len(numbers)} numbers and the mask {mask}"
        section.check(are_pairs and is_mask, "pairs of anchors and a mask of their indices", got)
        scale = section.numbers("scale_x_y", "1")
        section.check(len(scale) == 1, "one number", excerpt(section.text("scale_x_y", "1")), "scale_x_y")
        anchors_of_head = tuple(anchors[index] for index in mask)
        classes = section.integer("classes", 20)
        head = Head(anchors_of_head, classes, scale[0])
        section.check(head.channels == self._here.channels, f"{head.channels} channels", self._here.channels)
        self._note(self._here, self._previous)
        return head

    def _dropout(self, section: Section) -> nn.Module:
        self._note(self._here, self._previous)
        return nn.Identity()

    def _layers(self, section: Section, key: str) -> tuple[int, ...]:
        """Read the numbers of the earlier layers that a key names, below 0 from this one on."""
        count = len(self.shapes)
        numbers = tuple(number if number >= 0 else count + number for number in section.integers(key))
        earlier = all(0 <= number < count for number in numbers)
        section.check(earlier, f"{key} to name an earlier layer", f"{key}={section.text(key)}")
        return numbers


def _check_kernel(section: Section, size: int, stride: int, padding: int) -> None:
    """Raise `DataError` for a kernel that is too large, or padded by more than itself."""
    usual = max(size, stride) <= _LARGEST_KERNEL and padding <= size
    limits = f"size and stride up to {_LARGEST_KERNEL} and no more padding than size"
    section.check(usual, limits, f"{size}, {stride} and {padding}")


def _activation(section: Section, default: str) -> str:
    """Read the name of an activation."""
    name = section.text("activation", default)
    section.check(name in _ACTIVATIONS, f"one of the activations {', '.join(_ACTIVATIONS)}", repr(name))
    return name


_EPSILON = 1e-5  # constant ε that batch norm adds to the variance

_NEW_HEADER = 20  # bytes of the header of a weights file since version 0.2, which counts images in 64 bits
_OLD_HEADER = 16  # of an earlier one, which counts them in 32 bits


class Darknet(nn.Module):
    """A network from the sections of a cfg, with random weights: `(B, C, H, W)` → `(B, A (5 + K), H', W')` a head.

    Attributes:
        sections: the sections of the cfg, `[net]` first.
        input_size: `(width, height)` of the cfg in pixels.
        channels: number of channels C of an image.
        layers: the layers, numbered as in the cfg.
        heads: those of them that are heads.
        sources: the layers that each one reads, -1 for the image.
        steps: input pixels for a pixel of each layer's output.
        stride: the number of pixels that sides of an image are multiples of.

    `_last_reader` has for each layer the last one that reads its output, after which the output is released. The layers
    before `_stem` run one image at a time.
    """

    def __init__(self, sections: Sequence[Section]) -> None:
        super().__init__()
        self.sections = tuple(sections)
        first = f"[{sections[0].kind}]" if sections else "no sections"
        check_data(first in ("[net]", "[network]"), "cfg", "[net] as its first section", first)
        net = sections[0]
        self.input_size = (net.integer("width", 416), net.integer("height", 416))
        self.channels = net.integer("channels", 3)
        check_canvas(net.where, self.input_size)
        builder = _Builder(self.channels, self.input_size)
        self.layers = nn.ModuleList([builder.add(section) for section in sections[1:]])
        self.heads = [layer for layer in self.layers if isinstance(layer, Head)]
        net.check(bool(self.heads), "at least one [yolo] section", "none")
        self.sources = builder.sources
        self.steps = [shape.step for shape in builder.shapes]
        self.stride = max(math.ceil(step) for step in self.steps)
        self._last_reader = self._find_last_readers()
        # The maps of the first layers are so large that a CPU computes a batch faster one image at a time.
        self._stem = next((index for index, step in enumerate(self.steps) if step >= 8), 0)

    def _run_one_by_one(self, images: Tensor, stop: int) -> dict[int, Tensor]:
        """Run the layers before `stop` for each image of a batch by itself."""
        runs = [self.run({-1: image}, 0, stop) for image in images.split(1)]
        outputs = {}
        for index in runs[0]:
            outputs[index] = torch.cat([run[index] for run in runs])
        return outputs

    def _find_last_readers(self) -> dict[int, int]:
        """Find the last layer that reads the output of each layer; itself, if none does."""
        last_reader = {index: index for index in range(-1, len(self.layers))}
        for index, sources in enumerate(self.sources):
            last_reader |= dict.fromkeys(sources, index)
        # The network returns the maps of heads at its end.
        last_reader |= dict.fromkeys(self._head_numbers(), len(self.layers))
        return last_reader

    def _head_numbers(self) -> list[int]:
        """List the numbers of the layers that are heads."""
        return [index for index, layer in enumerate(self.layers) if isinstance(layer, Head)]

    def forward(self, image: Tensor) -> list[Tensor]:
        """Compute the maps of all heads for images `(B, C, H, W)`."""
        self.check_image(image)
        image = image.contiguous(memory_format=torch.channels_last)
        outputs = {-1: image}
        start = 0
        if image.device.type == "cpu" and image.shape[0] > 1:
            start = self._stem
            outputs = self._run_one_by_one(image, start)
        outputs = self.run(outputs, start, len(self.layers))
        return [outputs[index] for index in self._head_numbers()]

    def features(self, image: Tensor) -> Tensor:
        """Compute the input of the last convolution before the first head.

        Args:
            image: `(B, C, H, W)`.

        Returns:
            `(B, C', H', W')`.
        """
        self.check_image(image)
        image = image.contiguous(memory_format=torch.channels_last)
        first_head = self._head_numbers()[0]
        last_convolution = self.sources[first_head][0]
        its_input = self.sources[last_convolution][0]
        return self.run({-1: image}, 0, its_input + 1)[its_input]

    def landmarks(self) -> dict[str, int]:
        """List the names of feature maps by their place in the network (`semfov.detection.feature_maps`).

        Returns:
            Numbers of their layers, by name.
        """
        steps = []
        origins: dict[int, int] = {}  # of layers that hand on the map of another one
        for index, layer in enumerate(self.layers):
            sources = [origins.get(source, source) for source in self.sources[index]]
            if len(sources) == 1 and _hands_on(layer):
                origins[index] = sources[0]
                continue
            maps = tuple(str(number) for number in sources if number >= 0)  # without the image, -1
            stride = round(float(self.steps[index]))
            steps.append(NetworkStep(str(index), stride, maps, isinstance(layer, Convolution)))
        return {name: int(layer) for name, layer in landmarks(steps).items()}

    def cfg_digest(self) -> str:
        """Compute the sha256 of the sections of the cfg, in hexadecimal."""
        cfg = repr([(section.kind, sorted(section.options.items())) for section in self.sections])
        return hashlib.sha256(cfg.encode()).hexdigest()

    def check_image(self, image: Tensor) -> None:
        """Raise `InputError` unless the network takes images of this shape."""
        check_shape(image, "image", None, self.channels, None, None)
        height, width = image.shape[-2:]
        are_multiples = all(side > 0 and side % self.stride == 0 for side in (width, height))
        check(are_multiples, "image", f"sides that are multiples of {self.stride}", f"{width} x {height}")

    def run(self, outputs: dict[int, Tensor], start: int, stop: int) -> dict[int, Tensor]:
        """Run some layers.

        Args:
            outputs: outputs of earlier layers by their number, -1 for the image.
            start: number of the first layer to run.
            stop: number of the first one not to run.

        Returns:
            The outputs, by layer, that later layers read, or that the network returns.
        """
        # A copy: the first layer would write its output into the caller's mapping.
        outputs = dict(outputs)
        for index in range(start, stop):
            outputs[index] = self.layers[index](*(outputs[source] for source in self.sources[index]))
            # Maps go after their last reader, so that memory never has to hold all of them.
            outputs = {source: output for source, output in outputs.items() if self._last_reader[source] > index}
        return outputs

    @torch.no_grad()
    def read_weights(self, path: str | PathLike[str]) -> str:
        """Load the parameters in a weights file, with batch norm folded in; returns the file's sha256.

        The header of the file holds major version, minor version and revision as int32, then the number of images seen
        in training (uint64 since version 0.2, uint32 before). For each convolution of the cfg follow the bias, with
        batch norm also its scale, mean and variance, and the kernel `(O, I / groups, k, k)`.
        """
        layers = [layer for layer in self.layers if isinstance(layer, Convolution)]
        name = f"weights {str(path)!r}"
        lengths = [layer.stored_numbers for layer in layers]
        data = _read_data(Path(path), name, sum(lengths))
        numbers = torch.frombuffer(data, dtype=torch.float32, offset=_header_length(data))
        got = "NaN or infinite ones; the file is damaged or not a weights file"
        check_data(bool(numbers.isfinite().all()), name, "finite numbers", got)
        for layer, part in zip(layers, numbers.split(lengths), strict=True):
            weight, bias = _folded(part, layer, name)
            layer.weight.copy_(weight)
            cast(Tensor, layer.bias).copy_(bias)
        return hashlib.sha256(data).hexdigest()


def _folded(numbers: Tensor, layer: Convolution, name: str) -> tuple[Tensor, Tensor]:
    """Fold batch norm into a convolution: `weight · γ / √(σ² + ε)` and `β - μ γ / √(σ² + ε)`.

    Args:
        numbers: what a weights file stores of the layer: β, with batch norm γ, μ and σ², and the weight.
        layer: the layer.
        name: name of the file, for messages.

    Returns:
        The weight `(O, I / groups, k, k)` and the bias `(O,)`, in float64.
    """
    vectors, kernel = numbers.split([layer.out_channels * layer.stored_vectors, layer.weight.numel()])
    # In float64, so that a weight is rounded only once, when it is copied into the layer.
    weight = kernel.view(layer.weight.shape).double()
    bias, *batch_norm = vectors.view(-1, layer.out_channels).double()
    if not batch_norm:
        return weight, bias
    scale, mean, variance = batch_norm
    got = "negative ones; the file does not fit the cfg"
    check_data(not bool((variance < 0).any()), name, "variances of at least 0", got)
    factor = scale / (variance + _EPSILON).sqrt()
    return weight * factor[:, None, None, None], bias - mean * factor


def _hands_on(layer: nn.Module) -> bool:
    """Tell whether a layer with one source returns the map of this source: a head, a dropout or a plain route."""
    is_plain_route = isinstance(layer, Route) and layer.groups == 1
    return is_plain_route or isinstance(layer, nn.Identity)


def _read_data(path: Path, name: str, numbers: int) -> bytearray:
    """Read a weights file, header included; raises `DataError` unless it holds a number of numbers."""
    longest = _NEW_HEADER + 4 * numbers
    with reading(path, name), path.open("rb") as file:
        length = path.stat().st_size
        data = bytearray(file.read(longest + 1))  # a longer file is refused below, so it is not read to its end
    needed = _header_length(data) + 4 * numbers
    got = f"{length}; the file is {'truncated' if length < needed else 'too long'}, or belongs to another network"
    check_data(length == len(data) == needed, name, f"{needed} bytes for this network", got)
    return data


def _header_length(data: bytes | bytearray) -> int:
    """Find the bytes of the header of a weights file, which has the version of Darknet that wrote it."""
    if len(data) < struct.calcsize("<3i"):
        return _NEW_HEADER
    major, minor, _ = struct.unpack_from("<3i", data)
    # Numbers that no version has mark a file of another kind, of whichever length.
    new = 10 * major + minor >= 2 and major < 1000 and minor < 1000
    return _NEW_HEADER if new else _OLD_HEADER

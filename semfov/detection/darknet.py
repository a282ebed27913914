"""Darknet networks as PyTorch modules: their layers, built from the sections of a cfg, and their weights files."""

import hashlib
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
        stride: int = 1,
        padding: int = 0,
        groups: int = 1,
        activation: str = "linear",
        normalised: bool = False,
    ) -> None:
        super().__init__(in_channels, out_channels, size, stride, padding, groups=groups)
        self.activation, self.normalised = activation, normalised

    def forward(self, input: Tensor) -> Tensor:
        return _ACTIVATIONS[self.activation](super().forward(input))


class MaxPool(nn.Module):
    """Darknet's max pool; of an odd padding (by default `size - 1`) the larger half is right and below."""

    def __init__(self, size: int, stride: int, padding: int) -> None:
        super().__init__()
        self.size, self.stride, self.padding = size, stride, padding

    def forward(self, image: Tensor) -> Tensor:
        """Pool `(B, C, H, W)` to `(B, C, H', W')`."""
        before = self.padding // 2
        sides = image.shape[-1], image.shape[-2]
        outputs = [(length + self.padding - self.size) // self.stride for length in sides]
        reached = [count * self.stride + self.size - before for count in outputs]
        right, bottom = (max(0, reach - length) for reach, length in zip(reached, sides, strict=True))
        if before == right == bottom and 2 * before <= self.size:
            return F.max_pool2d(image, self.size, self.stride, before)
        padded = F.pad(image, (before, right, before, bottom), value=float("-inf"))
        return F.max_pool2d(padded, self.size, self.stride)


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
        return _ACTIVATIONS[self.activation](image + earlier)


class Head(nn.Identity):
    """A yolo layer: it returns its map unchanged, and holds the settings for decoding it; anchors `(width, height)`."""

    def __init__(self, anchors: tuple[tuple[float, float], ...], classes: int, scale: float = 1.0) -> None:
        super().__init__()
        self.anchors, self.classes, self.scale = anchors, classes, scale

    @property
    def channels(self) -> int:
        """Number of channels of the map: centre, size, objectness and classes of every anchor."""
        return len(self.anchors) * (5 + self.classes)


# YOLOv3 has 62 million parameters and a map of 12 million numbers; the limits keep a typing error from filling memory.
_MOST_PARAMETERS = 3 * 10**8
_MOST_ELEMENTS = 2**28
_MOST_LAYERS = 2000
_LARGEST_KERNEL = 255

_KINDS = ("convolutional", "maxpool", "upsample", "route", "shortcut", "yolo", "dropout")

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
    """Makes layers from sections, and keeps track of shapes and of the layers that each layer reads."""

    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        self._pixels = size[0] * size[1]
        self._parameters = 0
        self.shapes: list[_Shape] = []
        self.sources: list[tuple[int, ...]] = []
        self._here = _Shape(channels, Fraction(1))

    def add(self, section: Section) -> nn.Module:
        count, kind, here = len(self.shapes), section.kind, self._here
        check_data(count < _MOST_LAYERS, section.where, f"at most {_MOST_LAYERS} layers", "more; check the cfg")
        for key, value in _NEUTRAL.get(kind, {}).items():
            got = section.text(key, value)
            section.check(got == value, f"{key}={value}", f"{key}={got}, which is not supported")
        makers = {"convolutional": self._convolution, "route": self._route, "yolo": self._yolo}
        if kind in makers:
            return makers[kind](section)
        if kind == "maxpool":
            stride = section.integer("stride", 1)
            size = section.integer("size", stride)
            padding = section.integer("padding", size - 1, minimum=0)
            _check_kernel(section, size, stride, padding)
            self._note(here.channels, here.step * stride)
            return MaxPool(size, stride, padding)
        if kind == "upsample":
            stride = section.integer("stride", 2)
            self._note(here.channels, here.step / stride)
            return nn.Upsample(scale_factor=float(stride), mode="nearest")
        if kind == "shortcut":
            sources = self._layers(section, "from")
            fits = len(sources) == 1 and self.shapes[sources[0]] == here
            section.check(fits, "one layer of the same shape", f"layers {sources}")
            self._note(here.channels, here.step, *sources)
            return Shortcut(_activation(section, "linear"))
        if kind != "dropout":
            raise DataError(f"{section.where}: layer [{kind}] is not supported; supported: {', '.join(_KINDS)}")
        self._note(here.channels, here.step)
        return nn.Identity()

    def _note(self, channels: int, step: Fraction, *further: int, sources: tuple[int, ...] | None = None) -> None:
        """Note the shape and the sources of a layer, unless its output is too large at the input size of the cfg."""
        shape = _Shape(channels, step)
        fits = shape.channels * self._pixels <= _MOST_ELEMENTS * shape.step**2
        check_data(fits, f"cfg: layer {len(self.shapes)}", f"a map of at most {_MOST_ELEMENTS:,} numbers", "more")
        self.sources.append((len(self.shapes) - 1, *further) if sources is None else sources)
        self.shapes.append(shape)
        self._here = shape

    def _convolution(self, section: Section) -> nn.Module:
        here, filters, groups = self._here, section.integer("filters", 1), section.integer("groups", 1)
        counts = f"{excerpt(here.channels)} input channels and {excerpt(filters)} filters"
        section.check(here.channels % groups == filters % groups == 0, f"groups that divide {counts}", excerpt(groups))
        size, stride = section.integer("size", 1), section.integer("stride", 1)
        # Parameters are counted before the layer is made, because making it allocates them.
        self._parameters += here.channels // groups * filters * size**2 + 4 * filters
        most = f"at most {_MOST_PARAMETERS:,} parameters up to this layer"
        section.check(self._parameters <= _MOST_PARAMETERS, most, "more; check the cfg")
        padding = section.integer("padding", 0, minimum=0)
        _check_kernel(section, size, stride, padding)
        self._note(filters, here.step * stride)
        return Convolution(
            here.channels,
            filters,
            size,
            stride=stride,
            padding=size // 2 if section.integer("pad", 0, minimum=0) else padding,
            groups=groups,
            activation=_activation(section, "logistic"),
            normalised=bool(section.integer("batch_normalize", 0, minimum=0)),
        )

    def _route(self, section: Section) -> nn.Module:
        sources = self._layers(section, "layers")
        groups, group = section.integer("groups", 1), section.integer("group_id", 0, minimum=0)
        shapes = [self.shapes[source] for source in sources]
        section.check(len({shape.step for shape in shapes}) == 1, "layers of one size", section.text("layers"))
        counts = [shape.channels for shape in shapes]
        parts = f"a group_id below groups, and groups that divide the channels {excerpt(counts)}"
        fits = group < groups and not any(count % groups for count in counts)
        section.check(fits, parts, f"group_id={excerpt(group)} and groups={excerpt(groups)}")
        self._note(sum(counts) // groups, shapes[0].step, sources=sources)
        return Route(groups, group)

    def _yolo(self, section: Section) -> nn.Module:
        numbers = section.numbers("anchors")
        pairs = list(zip(numbers[::2], numbers[1::2], strict=False))
        mask = section.integers("mask", ",".join(map(str, range(len(pairs)))))
        fits = len(numbers) % 2 == 0 and bool(mask) and all(0 <= index < len(pairs) for index in mask)
        section.check(
            fits, "pairs of anchors and a mask of their indices", f"{len(numbers)} numbers and the mask {mask}"
        )
        scale = section.numbers("scale_x_y", "1")
        section.check(len(scale) == 1, "one number", excerpt(section.text("scale_x_y", "1")), "scale_x_y")
        head = Head(tuple(pairs[index] for index in mask), section.integer("classes", 20), scale[0])
        section.check(head.channels == self._here.channels, f"{head.channels} channels", self._here.channels)
        self._note(self._here.channels, self._here.step)
        return head

    def _layers(self, section: Section, key: str) -> tuple[int, ...]:
        """Numbers of the earlier layers that a key names, below 0 from this one on."""
        count = len(self.shapes)
        numbers = tuple(number if number >= 0 else count + number for number in section.integers(key))
        earlier = all(0 <= number < count for number in numbers)
        section.check(earlier, f"{key} to name an earlier layer", f"{key}={section.text(key)}")
        return numbers


def _check_kernel(section: Section, size: int, stride: int, padding: int) -> None:
    fits = max(size, stride) <= _LARGEST_KERNEL and padding <= size
    limits = f"size and stride up to {_LARGEST_KERNEL} and no more padding than size"
    section.check(fits, limits, f"{size}, {stride} and {padding}")


def _activation(section: Section, default: str) -> str:
    name = section.text("activation", default)
    section.check(name in _ACTIVATIONS, f"one of the activations {', '.join(_ACTIVATIONS)}", repr(name))
    return name


_EPSILON = 1e-5  # constant ε that batch norm adds to the variance


class Darknet(nn.Module):
    """A network from the sections of a cfg, with random weights: `(B, C, H, W)` → `(B, A (5 + K), H', W')` a head."""

    def __init__(self, sections: Sequence[Section]) -> None:
        super().__init__()
        self.sections = tuple(sections)
        first = f"[{sections[0].kind}]" if sections else "no sections"
        check_data(first in ("[net]", "[network]"), "cfg", "[net] as its first section", first)
        self.input_size = (sections[0].integer("width", 416), sections[0].integer("height", 416))
        self.channels = sections[0].integer("channels", 3)
        check_canvas(sections[0].where, self.input_size)
        builder = _Builder(self.channels, self.input_size)
        self.layers = nn.ModuleList([builder.add(section) for section in sections[1:]])
        self.heads = [layer for layer in self.layers if isinstance(layer, Head)]
        sections[0].check(bool(self.heads), "at least one [yolo] section", "none")
        self.stride = max(-(-shape.step.numerator // shape.step.denominator) for shape in builder.shapes)
        self.sources = builder.sources
        self.steps = [shape.step for shape in builder.shapes]
        # The last layer that reads each output, after which it is released; the network returns the maps of the heads.
        self._last_reader = {index: index for index in range(-1, len(self.layers))}
        self._last_reader |= {source: index for index, read in enumerate(self.sources) for source in read}
        self._last_reader |= {i: len(self.layers) for i, layer in enumerate(self.layers) if isinstance(layer, Head)}
        # The maps of the first layers are so large that a CPU computes a batch faster one image at a time.
        self._stem = next((index for index, shape in enumerate(builder.shapes) if shape.step >= 8), 0)

    def forward(self, image: Tensor) -> list[Tensor]:
        self.check_image(image)
        image = image.contiguous(memory_format=torch.channels_last)
        stem = self._stem if image.device.type == "cpu" and image.shape[0] > 1 else 0
        outputs = {-1: image}
        if stem:
            runs = [self.run({-1: single}, 0, stem) for single in image.split(1)]
            outputs = {index: torch.cat([run[index] for run in runs]) for index in runs[0]}
        outputs = self.run(outputs, stem, len(self.layers))
        return [outputs[index] for index, layer in enumerate(self.layers) if isinstance(layer, Head)]

    def features(self, image: Tensor) -> Tensor:
        """Compute the input of the last convolution before the first head, `(B, C, H', W')`."""
        self.check_image(image)
        head = next(index for index, layer in enumerate(self.layers) if layer is self.heads[0])
        last = self.sources[self.sources[head][0]][0]
        return self.run({-1: image.contiguous(memory_format=torch.channels_last)}, 0, last + 1)[last]

    def landmarks(self) -> dict[str, int]:
        """Numbers of the layers whose maps have a name by their place (`semfov.detection.feature_maps`)."""
        steps = []
        same: dict[int, int] = {}  # layers that hand on the map of another one
        for index, (layer, sources) in enumerate(zip(self.layers, self.sources, strict=True)):
            reads = [same.get(source, source) for source in sources]
            if len(reads) == 1 and (isinstance(layer, nn.Identity) or (isinstance(layer, Route) and layer.groups == 1)):
                same[index] = reads[0]
                continue
            names = tuple(str(read) for read in reads if read >= 0)
            stride, convolution = round(float(self.steps[index])), isinstance(layer, Convolution)
            steps.append(NetworkStep(str(index), stride, names, convolution))
        return {name: int(layer) for name, layer in landmarks(steps).items()}

    def cfg_digest(self) -> str:
        cfg = repr([(section.kind, sorted(section.options.items())) for section in self.sections])
        return hashlib.sha256(cfg.encode()).hexdigest()

    def check_image(self, image: Tensor) -> None:
        """Raise `InputError` unless the network takes images of this shape."""
        check_shape(image, "image", None, self.channels, None, None)
        height, width = image.shape[-2:]
        fits = height % self.stride == 0 and width % self.stride == 0 and height * width > 0
        check(fits, "image", f"sides that are multiples of {self.stride}", f"{width} x {height}")

    def run(self, outputs: dict[int, Tensor], start: int, stop: int) -> dict[int, Tensor]:
        """Run layers `start` to `stop - 1` on outputs by layer (-1 is the image); returns those that are read later."""
        outputs = dict(outputs)
        for index in range(start, stop):
            outputs[index] = self.layers[index](*(outputs[source] for source in self.sources[index]))
            outputs = {source: output for source, output in outputs.items() if self._last_reader[source] > index}
        return outputs

    @torch.no_grad()
    def read_weights(self, path: str | PathLike[str]) -> str:
        """Load the parameters in a weights file, with batch norm folded in.

        The header of the file holds major version, minor version and revision as int32, then the number of images seen
        in training (uint64 since version 0.2, uint32 before). For each convolution of the cfg follow the bias, with
        batch norm also its scale, mean and variance, and the kernel `(O, I / groups, k, k)`. Batch norm is folded in
        float64:

            weight' = weight · γ / √(σ² + ε),   bias = β - μ γ / √(σ² + ε)
        """
        layers = [layer for layer in self.layers if isinstance(layer, Convolution)]
        longest = 20 + 4 * sum(_count(layer) for layer in layers)
        with reading(path, f"weights {str(path)!r}"), Path(path).open("rb") as file:
            length = Path(path).stat().st_size
            data = bytearray(file.read(longest + 1))  # a longer file is refused below, so it is not read to its end
        start = 20
        if len(data) >= 12:
            major, minor, _ = struct.unpack_from("<3i", data)
            start = 20 if 10 * major + minor >= 2 and major < 1000 and minor < 1000 else 16
        needed = start + 4 * sum(_count(layer) for layer in layers)
        got = f"{length}; the file is {'truncated' if length < needed else 'too long'}, or belongs to another network"
        check_data(length == len(data) == needed, f"weights {str(path)!r}", f"{needed} bytes for this network", got)
        numbers = torch.frombuffer(data, dtype=torch.float32, offset=start)
        got = "NaN or infinite ones; the file is damaged or not a weights file"
        check_data(bool(numbers.isfinite().all()), f"weights {str(path)!r}", "finite numbers", got)
        for layer in layers:
            channels = layer.out_channels
            vectors = numbers[: channels * (4 if layer.normalised else 1)].view(-1, channels).double()
            weight = numbers[vectors.numel() : _count(layer)].view(layer.weight.shape).double()
            bias = vectors[0]
            if layer.normalised:
                _, scale, mean, variance = vectors
                got = "negative ones; the file does not fit the cfg"
                least = not bool((variance < 0).any())
                check_data(least, f"weights {str(path)!r}", "variances of at least 0", got)
                factor = scale / (variance + _EPSILON).sqrt()
                weight, bias = weight * factor[:, None, None, None], bias - mean * factor
            layer.weight.copy_(weight)
            cast(Tensor, layer.bias).copy_(bias)
            numbers = numbers[_count(layer) :]
        return hashlib.sha256(data).hexdigest()


def _count(layer: Convolution) -> int:
    return layer.weight.numel() + layer.out_channels * (4 if layer.normalised else 1)

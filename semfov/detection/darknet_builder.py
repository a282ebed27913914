"""Building layers from the sections of a cfg, with checks that the layers fit together."""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

from torch import nn

from semfov.detection.darknet_config import Section
from semfov.detection.darknet_layers import ACTIVATIONS, Convolution, Head, MaxPool, Route, Shortcut, Upsample
from semfov.errors import DataError
from semfov.io.schema import excerpt

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


@dataclass(frozen=True)
class Shape:
    """Channels of an output, and input pixels per output pixel."""

    channels: int
    step: Fraction


class Builder:
    """Makes layers from sections, and keeps track of shapes and of the layers that each layer reads.

    Args:
        channels: number of channels of the image.
        size: `(width, height)` of the image.
    """

    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        self._pixels = size[0] * size[1]
        self._parameters = 0
        self.shapes: list[Shape] = []
        self.sources: list[tuple[int, ...]] = []
        self._image = Shape(channels, Fraction(1))
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
        """Make the layer of the next section."""
        if len(self.shapes) >= _MOST_LAYERS:
            raise DataError(f"{section.where}: expected at most {_MOST_LAYERS} layers, got more; check the cfg")
        if section.kind not in self._makers:
            kinds = ", ".join(self._makers)
            raise DataError(f"{section.where}: layer [{section.kind}] is not supported; supported: {kinds}")
        for key, value in _NEUTRAL.get(section.kind, {}).items():
            if section.text(key, value) != value:
                raise DataError(f"{section.where}: [{section.kind}] {key}={section.text(key)} is not supported")
        return self._makers[section.kind](section)

    @property
    def _here(self) -> Shape:
        return self.shapes[-1] if self.shapes else self._image

    def _note(self, channels: int, step: Fraction, *sources: int) -> None:
        self._append(Shape(channels, step), (len(self.shapes) - 1, *sources))

    def _append(self, shape: Shape, sources: tuple[int, ...]) -> None:
        """Note the shape and the sources of a layer, unless its output is too large at the input size of the cfg."""
        if shape.channels * self._pixels > _MOST_ELEMENTS * shape.step**2:
            raise DataError(
                f"cfg: layer {len(self.shapes)} has a map of more than {_MOST_ELEMENTS:,} numbers; check the cfg"
            )
        self.sources.append(sources)
        self.shapes.append(shape)

    def _convolution(self, section: Section) -> nn.Module:
        here, filters, groups = self._here, section.integer("filters", 1), section.integer("groups", 1)
        if here.channels % groups or filters % groups:
            raise DataError(
                f"{section.where}: expected groups that divide {excerpt(here.channels)} input channels and "
                f"{excerpt(filters)} filters, got {excerpt(groups)}"
            )
        size, stride = section.integer("size", 1), section.integer("stride", 1)
        # Parameters are counted before the layer is made, because making it allocates them.
        self._parameters += here.channels // groups * filters * size**2 + 4 * filters
        if self._parameters > _MOST_PARAMETERS:
            raise DataError(
                f"{section.where}: expected at most {_MOST_PARAMETERS:,} parameters up to this layer, got more; "
                f"check the cfg"
            )
        _check_kernel(section, size, stride, section.integer("padding", 0, minimum=0))
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
        padding = section.integer("padding", size - 1, minimum=0)
        _check_kernel(section, size, stride, padding)
        self._note(self._here.channels, self._here.step * stride)
        return MaxPool(size, stride, padding)

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
            counts = excerpt([shape.channels for shape in shapes])
            raise DataError(
                f"{section.where}: [route] expected a group_id below groups, and groups that divide the channels "
                f"{counts}, got group_id={excerpt(group)} and groups={excerpt(groups)}"
            )
        self._append(Shape(sum(shape.channels for shape in shapes) // groups, shapes[0].step), sources)
        return Route(groups, group)

    def _shortcut(self, section: Section) -> nn.Module:
        sources = [self._layer(section, "from", layer) for layer in section.integers("from")]
        if len(sources) != 1 or self.shapes[sources[0]] != self._here:
            raise DataError(f"{section.where}: [shortcut] expected one layer of the same shape, got layers {sources}")
        self._note(self._here.channels, self._here.step, *sources)
        return Shortcut(_activation(section, "linear"))

    def _yolo(self, section: Section) -> nn.Module:
        numbers = section.numbers("anchors")
        pairs = list(zip(numbers[::2], numbers[1::2], strict=False))
        mask = section.integers("mask", ",".join(map(str, range(len(pairs)))))
        if len(numbers) % 2 or not mask or any(not 0 <= index < len(pairs) for index in mask):
            raise DataError(
                f"{section.where}: [yolo] expected pairs of anchors and a mask of their indices, got {len(numbers)} "
                f"numbers and the mask {mask}"
            )
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
            raise DataError(
                f"{section.where}: [{section.kind}] expected {key} to name an earlier layer, got {key}={number}"
            )
        return index


def _check_kernel(section: Section, size: int, stride: int, padding: int) -> None:
    if size > _LARGEST_KERNEL or stride > _LARGEST_KERNEL or padding > size:
        raise DataError(
            f"{section.where}: [{section.kind}] expected size and stride up to {_LARGEST_KERNEL} and no more padding "
            f"than size, got {size}, {stride} and {padding}"
        )


def _activation(section: Section, default: str) -> str:
    name = section.text("activation", default)
    if name not in ACTIVATIONS:
        raise DataError(f"{section.where}: activation {name!r} is not supported; known: {', '.join(ACTIVATIONS)}")
    return name

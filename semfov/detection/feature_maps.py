"""Feature maps of a network, named by their place in the network and their stride."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from math import log2
from typing import NamedTuple

import torch
from torch import Tensor, nn

from semfov.detection.detections import Detections
from semfov.detection.placement import Placement
from semfov.errors import InputError, lookup

_LEAST_STRIDE = 8  # smallest stride of the maps that are named; finer ones hold edges and colours


@dataclass(frozen=True)
class FeatureMaps:
    """Feature maps of a batch of images, and the detections of the same pass.

    A map is named by its place in the network and its stride, the canvas pixels for one of its own: `backbone8` is
    the last map of stride 8 before the network first halves it, `head16` the one from which boxes of stride 16 are
    computed. Models of torchvision and transformers have those of their `pyramid` or `backbone`.

    Attributes:
        maps: by name, `(B, C, h, w)`, over the whole canvas with its padding.
        canvas: `(width, height)` of the canvas in pixels.
        placement: placement of the images on the canvas.
        detections: the selected boxes, in image pixels.

    Example::

        features = semfov.load_detector("yolox-nano").features(images)
        features.maps["backbone8"], features.detections
    """

    maps: Mapping[str, Tensor]
    canvas: tuple[int, int]
    placement: Placement
    detections: Detections


class NetworkStep(NamedTuple):
    """A step of a network.

    Attributes:
        name: the tensor that it computes.
        stride: stride of the tensor in canvas pixels; None if it is no map.
        reads: names of the tensors that it reads.
        convolution: whether it is a convolution.
    """

    name: str
    stride: int | None
    reads: tuple[str, ...]
    convolution: bool


def landmarks(steps: Sequence[NetworkStep]) -> dict[str, str]:
    """List the names of feature maps by their place in a network: `backbone8`, `head8`, ….

    `backbone` is the first map of a stride that a coarser one is computed from (the coarsest: that a finer one is).
    `head` is the last map that two convolutions read, else the last that one reads, of those that are computed after
    the coarsest stride, or a finer one again, is reached.

    Args:
        steps: the steps of the network, in order of computation.

    Returns:
        The names of the steps, by those of their places and strides.
    """
    strides = {step.name: step.stride for step in steps if step.stride is not None}
    names: dict[str, str] = {}
    for place, maps in (("backbone", _backbone_maps(steps, strides)), ("head", _head_maps(steps, strides))):
        for stride, name in sorted(maps.items()):
            if stride >= _LEAST_STRIDE:
                names[f"{place}{stride}"] = name
    return names


class _Change(NamedTuple):
    """A map that a step computes from one of another stride, and the strides of both."""

    source: str
    from_stride: int
    result: str
    to_stride: int


def _changes(steps: Sequence[NetworkStep], strides: Mapping[str, int]) -> Iterator[_Change]:
    """List where a map is computed from one of another stride, in order of computation."""
    for step in steps:
        if step.name not in strides:
            continue
        stride = strides[step.name]
        for source in step.reads:
            source_stride = strides.get(source, stride)  # weights are no maps, and change nothing
            if source_stride != stride:
                yield _Change(source, source_stride, step.name, stride)


def _backbone_maps(steps: Sequence[NetworkStep], strides: Mapping[str, int]) -> dict[int, str]:
    """Find the first map of each stride that a coarser one is computed from, or else a finer one."""
    halved: dict[int, str] = {}
    doubled: dict[int, str] = {}
    for change in _changes(steps, strides):
        maps = halved if change.to_stride > change.from_stride else doubled
        maps.setdefault(change.from_stride, change.source)
    return {**doubled, **halved}


def _head_maps(steps: Sequence[NetworkStep], strides: Mapping[str, int]) -> dict[int, str]:
    """Find the last map of each stride that two convolutions read, else the last that one reads, after the backbone."""
    if not strides:
        return {}
    order = {step.name: place for place, step in enumerate(steps)}
    end = _backbone_end(steps, strides, order)
    # The first tensor that a convolution reads is its map; the others are weights.
    readers = Counter(step.reads[0] for step in steps if step.convolution and step.reads)
    maps_after = [(name, stride) for name, stride in strides.items() if order[name] >= end]
    # Of the maps of one stride, the last one replaces those before it.
    read = {stride: name for name, stride in maps_after if readers[name] > 0}
    shared = {stride: name for name, stride in maps_after if readers[name] > 1}
    # Boxes and scores come from a map that two convolutions read, so that such a map replaces any other.
    return {**read, **shared}


def _backbone_end(steps: Sequence[NetworkStep], strides: Mapping[str, int], order: Mapping[str, int]) -> int:
    """Find where the backbone ends: at the first map of the coarsest stride, or at the first finer than one it reads.

    Args:
        steps: of the network.
        strides: of its maps, by name.
        order: places of the maps in `steps`, by name.

    Returns:
        The place.
    """
    coarsest = max(strides.values())
    ends = [name for name, stride in strides.items() if stride == coarsest]
    ends += [change.result for change in _changes(steps, strides) if change.to_stride < change.from_stride]
    return min(order[name] for name in ends)


def stride_of(canvas: int, side: int) -> int:
    """Find the stride of a map: the canvas pixels for each of its pixels, as the nearest power of two.

    Args:
        canvas: side of the canvas in pixels.
        side: the same side of the map.

    Returns:
        The stride in pixels.
    """
    return int(2 ** round(log2(max(canvas / side, 1))))


def choose_layers(layers: Iterable[str] | None, have: Sequence[str], detector: str) -> tuple[str, ...]:
    """Choose the requested layers.

    Args:
        layers: their names; None for all that a detector names.
        have: the layers that the detector names.
        detector: name of the detector, for the message.

    Returns:
        The names.

    Raises:
        InputError: the detector has no maps, or none of these names.
    """
    if not have:
        raise no_features(detector)
    if layers is None:
        return tuple(have)
    return tuple(lookup(layer, have, f"feature map of {detector}") for layer in layers)


def no_features(detector: str) -> InputError:
    """Make the error of a detector that hides its feature maps.

    Args:
        detector: its name.

    Returns:
        The error.
    """
    return InputError(
        f"detector: expected one that gives access to its feature maps, such as yolox-nano, yolov3-tiny or a model of "
        f"torchvision or transformers, got {detector}"
    )


@contextmanager
def record_maps(modules: Mapping[str, nn.Module]) -> Iterator[dict[str, list[Tensor]]]:
    """Record the maps that modules return while the block runs.

    Args:
        modules: the modules, by the name of what they return.

    Yields:
        The maps by name, in the order in which a module returns them. They are there at the end of the block, when the
        runs of a module on parts of a batch are joined.
    """
    runs: dict[str, list[list[Tensor]]] = {name: [] for name in modules}
    maps: dict[str, list[Tensor]] = {}
    with ExitStack() as hooks:
        for name, module in modules.items():
            hooks.callback(module.register_forward_hook(partial(_note, runs[name])).remove)
        yield maps
        for name, parts in runs.items():
            maps[name] = [torch.cat(pieces) for pieces in zip(*parts, strict=True)]


def _note(runs: list[list[Tensor]], module: nn.Module, inputs: object, output: object) -> None:
    """Note the maps in what a module returns, as a hook of it."""
    tensors = filter(_is_map, _tensors_in(output))
    runs.append(list(tensors))


def _is_map(tensor: Tensor) -> bool:
    """Tell whether a tensor has the form of a map, `(B, C, h, w)`."""
    return tensor.ndim == 4 and tensor.is_floating_point()


def _tensors_in(output: object) -> Iterator[Tensor]:
    """List the tensors in what a module returns, which may be nested, in order."""
    if isinstance(output, Mapping):
        output = tuple(output.values())
    if isinstance(output, Tensor):
        yield output
    elif isinstance(output, list | tuple):
        for part in output:
            yield from _tensors_in(part)

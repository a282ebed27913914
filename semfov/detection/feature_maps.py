"""Feature maps of a look: what a network computes on the way to its boxes, named by their place in it and stride."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
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
    """Name maps by their place in the structure of a network: `backbone8`, `head8`, ….

    `backbone` is the first map of a stride that a coarser one is computed from (the coarsest: that a finer one is).
    `head` is the last map that two convolutions read, else the last that one reads, of those that are computed after
    the coarsest stride, or a finer one again, is reached.

    Args:
        steps: the steps of the network, in order of computation.

    Returns:
        The names of the steps, by those of their places and strides.
    """
    strides = {step.name: step.stride for step in steps if step.stride is not None}
    places: dict[tuple[str, int], str] = {}
    for stride, name in _backbone_maps(steps, strides).items():
        places["backbone", stride] = name
    for stride, name in _head_maps(steps, strides).items():
        places["head", stride] = name
    return {f"{place}{stride}": name for (place, stride), name in sorted(places.items()) if stride >= _LEAST_STRIDE}


def _changes(steps: Sequence[NetworkStep], strides: Mapping[str, int]) -> Iterator[tuple[NetworkStep, str]]:
    """List the steps that compute a map of another stride than one that they read, with the map that they read."""
    for step in steps:
        for read in step.reads if step.name in strides else ():
            if strides.get(read, strides[step.name]) != strides[step.name]:
                yield step, read


def _backbone_maps(steps: Sequence[NetworkStep], strides: Mapping[str, int]) -> dict[int, str]:
    """Find the first map of each stride that a coarser one is computed from, or else a finer one."""
    halved: dict[int, str] = {}
    doubled: dict[int, str] = {}
    for step, read in _changes(steps, strides):
        maps = halved if strides[step.name] > strides[read] else doubled
        maps.setdefault(strides[read], read)
    return {**doubled, **halved}


def _head_maps(steps: Sequence[NetworkStep], strides: Mapping[str, int]) -> dict[int, str]:
    """Find the last map of each stride that two convolutions read, else the last that one reads, after the backbone."""
    if not strides:
        return {}
    order = {step.name: place for place, step in enumerate(steps)}
    end = _backbone_end(steps, strides, order)
    # The first tensor that a convolution reads is its map; the others are weights.
    readers = Counter(step.reads[0] for step in steps if step.convolution and step.reads)
    maps: dict[int, str] = {}
    for name, stride in strides.items():
        if not readers[name] or order[name] < end:
            continue
        # A map that one convolution reads does not replace one that two read, as boxes and scores come from those.
        if readers[name] > 1 or readers[maps.get(stride, name)] == 1:
            maps[stride] = name
    return maps


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
    ends = [order[name] for name, stride in strides.items() if stride == coarsest]
    ends += [order[step.name] for step, read in _changes(steps, strides) if strides[step.name] < strides[read]]
    return min(ends)


def stride_of(canvas: int, side: int) -> int:
    """Find the stride of a map: the power of two that is nearest to the canvas pixels for one of its own.

    Args:
        canvas: side of the canvas in pixels.
        side: the same side of the map.

    Returns:
        The stride in pixels.
    """
    return int(2 ** round(log2(max(canvas / side, 1))))


def choose_layers(layers: Iterable[str] | None, have: Sequence[str], detector: str) -> tuple[str, ...]:
    """Choose the layers that are asked for.

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

    def hook_of(name: str) -> Callable[[nn.Module, object, object], None]:
        def note(module: nn.Module, inputs: object, output: object) -> None:
            runs[name].append(list(_maps_in(output)))

        return note

    hooks = [module.register_forward_hook(hook_of(name)) for name, module in modules.items()]
    try:
        yield maps
        for name, parts in runs.items():
            maps[name] = [torch.cat(pieces) for pieces in zip(*parts, strict=True)]
    finally:
        for hook in hooks:
            hook.remove()


def _maps_in(output: object) -> Iterator[Tensor]:
    """List the maps `(B, C, h, w)` in what a module returns, in order."""
    if isinstance(output, Tensor):
        if output.ndim == 4 and output.is_floating_point():
            yield output
    elif isinstance(output, Mapping | list | tuple):
        for part in output.values() if isinstance(output, Mapping) else output:
            yield from _maps_in(part)

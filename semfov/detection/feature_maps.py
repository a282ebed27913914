"""Feature maps of a look: what a network computes on the way to its boxes, named by their place in it and stride."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import log2
from typing import Any, NamedTuple

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
    """A step of a network: the map that it computes, its stride (None if it is no map), and the maps that it reads."""

    name: str
    stride: int | None
    reads: tuple[str, ...]
    convolution: bool


def landmarks(steps: Sequence[NetworkStep]) -> dict[str, str]:
    """Names `backbone8`, `head8`, … of maps by the structure of a network, from its steps in order of computation.

    `backbone` is the first map of a stride that a coarser one is computed from (the coarsest: that a finer one is).
    `head` is the last map that two convolutions read, else the last that one reads, of those that are computed after
    the coarsest stride, or a finer one again, is reached.
    """
    strides = {step.name: step.stride for step in steps if step.stride is not None}
    order = {step.name: place for place, step in enumerate(steps)}
    readers = Counter(read for step in steps if step.convolution for read in step.reads[:1])
    coarser: dict[int, str] = {}
    finer: dict[int, str] = {}
    begun = [order[name] for name, stride in strides.items() if stride == max(strides.values())][:1]
    for step in steps:
        for read in step.reads if step.name in strides else ():
            change = strides[step.name] - strides.get(read, strides[step.name])
            if change > 0:
                coarser.setdefault(strides[read], read)
            elif change < 0:
                finer.setdefault(strides[read], read)
                begun.append(order[step.name])
    named = {("backbone", stride): name for stride, name in {**finer, **coarser}.items()}
    for stride in set(strides.values()):
        late = [name for name in strides if strides[name] == stride and readers[name] and order[name] >= min(begun)]
        if late:
            named["head", stride] = ([name for name in late if readers[name] > 1] or late)[-1]
    return {f"{place}{stride}": name for (place, stride), name in sorted(named.items()) if stride >= _LEAST_STRIDE}


def stride_of(canvas: int, side: int) -> int:
    """The power of two that is nearest to the pixels of a canvas for one pixel of a map."""
    return int(2 ** round(log2(max(canvas / side, 1))))


def chosen(layers: Iterable[str] | None, have: Sequence[str], detector: str) -> tuple[str, ...]:
    """The layers that are asked for, all that a detector names if None; raises `InputError` where there is no map."""
    if not have:
        raise no_features(detector)
    return tuple(have if layers is None else (lookup(layer, have, f"feature map of {detector}") for layer in layers))


def no_features(detector: str) -> InputError:
    """The error of a detector that hides its feature maps."""
    return InputError(
        f"detector: expected one that gives access to its feature maps, such as yolox-nano, yolov3-tiny or a model of "
        f"torchvision or transformers, got {detector}"
    )


@contextmanager
def recorded(modules: Mapping[str, nn.Module]) -> Iterator[dict[str, list[Tensor]]]:
    """Record, by name, the maps that modules return while the block runs; parts of a batch are joined at its end."""
    runs: dict[str, list[list[Tensor]]] = {name: [] for name in modules}
    maps: dict[str, list[Tensor]] = {}
    hooks = [
        module.register_forward_hook(lambda _, __, output, name=name: runs[name].append(list(_maps_in(output))))
        for name, module in modules.items()
    ]
    try:
        yield maps
        maps.update({name: [torch.cat(parts) for parts in zip(*each, strict=True)] for name, each in runs.items()})
    finally:
        for hook in hooks:
            hook.remove()


def _maps_in(output: Any) -> Iterator[Tensor]:
    """The maps `(B, C, h, w)` in what a module returns, in order."""
    if isinstance(output, Tensor):
        if output.ndim == 4 and output.is_floating_point():
            yield output
    elif isinstance(output, Mapping | list | tuple):
        for part in output.values() if isinstance(output, Mapping) else output:
            yield from _maps_in(part)

"""YOLOv3 (Redmon and Farhadi 2018) as a `Detector`, computed by torch or, as an ONNX model, by onnxruntime."""

from collections.abc import Mapping, Sequence
from typing import Literal, cast

import torch
from torch import Tensor

from semfov.detection.darknet import Darknet
from semfov.detection.darknet_onnx import OnnxTwin, network_digest, parameter_versions
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import choose_layers, record_maps
from semfov.detection.scores import HALVES, Candidates
from semfov.errors import check
from semfov.sensor.constants import constant

Runtime = Literal["auto", "torch", "onnxruntime"]

_RUNTIMES: tuple[Runtime, ...] = ("auto", "torch", "onnxruntime")


def _check_multiples(size: tuple[int, int], stride: int | None, step: int) -> None:
    """Raise `InputError` unless the sides of a canvas, and the stride of its padding, are multiples of a step."""
    are_multiples = all(_is_multiple(side, step) for side in size)
    check(are_multiples, "input_size", f"a multiple of {step} along both axes", size)
    if stride is not None:
        can_pad = isinstance(stride, int) and _is_multiple(stride, step)
        check(can_pad, "stride", f"None or a multiple of {step}", repr(stride))


def _is_multiple(side: int, step: int) -> bool:
    """Tell whether a side in pixels is a multiple of a step, and not 0."""
    return side > 0 and side % step == 0


@constant
def _cells(
    size: tuple[int, int],
    canvas: tuple[int, int],
    anchors: tuple[tuple[float, float], ...],
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute what is the same for all maps of a head.

    Args:
        size: `(columns, rows)` of the map.
        canvas: `(width, height)` of the canvas in pixels.
        anchors: `(width, height)` of each anchor in canvas pixels.
        dtype: dtype of the results.
        device: device of the results.

    Returns:
        Column and row of every cell `(h, w, 1, 2)`, the size of a cell in canvas pixels `(2,)`, and half the anchors
        `(A, 2)`.
    """
    axes = [torch.arange(length, device=device, dtype=dtype) for length in size]
    corner = torch.stack(torch.meshgrid(*axes, indexing="xy"), -1)[:, :, None]
    step = [pixels / length for pixels, length in zip(canvas, size, strict=True)]
    return (
        corner,
        torch.tensor(step, dtype=dtype, device=device),
        torch.tensor(anchors, dtype=dtype, device=device) / 2,
    )


def decode_yolo(
    raw: Tensor, anchors: Sequence[tuple[float, float]], canvas: tuple[int, int], scale: float = 1.0
) -> Candidates:
    r"""Decode the raw map of a YOLOv3 head to boxes and scores (Redmon and Farhadi 2018, section 2.1).

    For the cell in column i and row j, with `s` canvas pixels per cell and the anchor `(p_w, p_h)`:

        b_x = (σ(t_x) + i) s,   b_y = (σ(t_y) + j) s,   b_w = p_w exp(t_w),   b_h = p_h exp(t_h)

    Objectness and class scores are `σ(t)`. A `scale` above 1, YOLOv4's, lets `b` reach the border of its cell:
    `scale · σ(t) - (scale - 1) / 2` instead of `σ(t)`.

    Args:
        raw: `(B, A (5 + K), h, w)`.
        anchors: `(width, height)` of each of the A anchors in canvas pixels.
        canvas: `(width, height)` of the canvas in pixels.
        scale: `scale_x_y` of the head.

    Returns:
        A box for each anchor of each cell, `h w A` in all.

    Raises:
        InputError: the channels are no multiple of the anchors.
    """
    batch, channels, rows, columns = raw.shape
    check(channels % len(anchors) == 0, "raw", f"a multiple of {len(anchors)} anchors as channels", tuple(raw.shape))
    numbers = raw.permute(0, 2, 3, 1).reshape(batch, rows, columns, len(anchors), -1)  # (B, h, w, A, 5 + K)
    offset = numbers[..., 0:2].sigmoid()
    growth = numbers[..., 2:4].exp()
    scores = numbers[..., 4:].sigmoid()

    anchor_sizes = tuple((width, height) for width, height in anchors)
    cell, step, half_anchors = _cells((columns, rows), (canvas[0], canvas[1]), anchor_sizes, raw.dtype, raw.device)
    place_in_cell = offset * scale - (scale - 1) / 2
    centre = (place_in_cell + cell) * step
    half = growth * half_anchors
    boxes = torch.cat([centre - half, centre + half], -1)

    objectness = scores[..., 0].flatten(1)  # (B, h w A)
    classes = scores[..., 1:].flatten(1, 3)  # (B, h w A, K)
    return Candidates(boxes.reshape(batch, -1, 4), classes, objectness)


class YoloV3(Detector):
    """A Darknet network with YOLOv3 heads as a `Detector`; input_size `(width, height)`; it is differentiable.

    With runtime `auto`, onnxruntime computes it on a CPU where that is equal up to rounding, and torch in all other
    cases.

    Attributes:
        network: the network.
        runtime: what computes it; `_twin` is onnxruntime's copy, None for runtime `torch`.
    """

    def __init__(
        self,
        network: Darknet,
        classes: tuple[str, ...],
        *,
        name: str = "yolov3",
        input_size: tuple[int, int] | None = None,
        stride: int | None = None,
        digest: str = "",
        runtime: Runtime = "torch",
    ) -> None:
        check(runtime in _RUNTIMES, "runtime", " or ".join(map(repr, _RUNTIMES)), repr(runtime))
        size = network.input_size if input_size is None else input_size
        _check_multiples(size, stride, network.stride)
        for head in network.heads:
            check(head.classes == len(classes), "classes", f"{head.classes} names", len(classes))
        super().__init__(name, classes, size, stride=stride, digest=digest)
        self.network = network
        self.runtime = runtime
        self._twin: OnnxTwin | None = None
        if runtime != "torch":
            # Before the digest is computed, so that a change in between is noticed.
            versions = parameter_versions([*network.parameters()])
            self._twin = OnnxTwin(network_digest(network), versions)

    def propose(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of all heads on a canvas `(B, 3, H, W)`, RGB in [0, 1]."""
        candidates, _ = self._compute(canvas, {})
        return candidates

    def propose_with_features(
        self, canvas: Tensor, layers: Sequence[str] | None = None
    ) -> tuple[Candidates, dict[str, Tensor]]:
        """Compute all boxes and feature maps in one pass; layers are also named by their number in the cfg."""
        by_place = self.network.landmarks()
        by_number = {str(number): number for number in range(len(self.network.layers))}
        numbers = {**by_number, **by_place}
        wanted = [*by_place] if layers is None else layers
        chosen = choose_layers(wanted, [*numbers], self.name)
        return self._compute(canvas, {layer: numbers[layer] for layer in chosen})

    def _compute(self, canvas: Tensor, layers: Mapping[str, int]) -> tuple[Candidates, dict[str, Tensor]]:
        """Compute all boxes of all heads, and the maps of layers, by the runtime that this canvas allows.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1].
            layers: numbers of layers whose maps are wanted, by name.

        Returns:
            The boxes, and maps `(B, C, h, w)` by name.
        """
        check(canvas.is_floating_point(), "canvas", "floating-point RGB in [0, 1]", canvas.dtype)
        twin = self._twin
        if twin is not None:
            obstacle = twin.obstacle_here(self.network, canvas)
            if self._choose_runtime(obstacle) == "onnxruntime":
                return twin(self.network, canvas, layers)
        modules = {layer: self.network.layers[number] for layer, number in layers.items()}
        dtype = next(self.network.parameters()).dtype
        with record_maps(modules) as maps_by_layer:
            raw_maps = self.network(canvas.to(dtype))
        first_maps = {layer: maps[0] for layer, maps in maps_by_layer.items()}
        return self._decode(raw_maps, canvas), first_maps

    def _decode(self, raw_maps: Sequence[Tensor], canvas: Tensor) -> Candidates:
        """Decode the raw maps of all heads, `(B, A (5 + K), h, w)` each, to the boxes of all of them."""
        height, width = canvas.shape[-2:]
        boxes = []
        classes = []
        objectness = []
        for raw, head in zip(raw_maps, self.network.heads, strict=True):
            # Half precision is too coarse for pixels.
            precise = raw.float() if raw.dtype in HALVES else raw
            candidates = decode_yolo(precise, head.anchors, (width, height), head.scale)
            boxes.append(candidates.boxes)
            classes.append(candidates.classes)
            objectness.append(cast(Tensor, candidates.objectness))
        return Candidates(torch.cat(boxes, 1), torch.cat(classes, 1), torch.cat(objectness, 1))

    def head_input(self, canvas: Tensor) -> Tensor:
        """Compute the input of the last convolution before the first head, by torch with any runtime."""
        return self.network.features(canvas.to(next(self.network.parameters()).dtype))

    def _choose_runtime(self, obstacle: str | None) -> Runtime:
        """Choose the runtime; `obstacle` is the reason why onnxruntime cannot be used."""
        if obstacle is None:
            return "onnxruntime"
        check(self.runtime == "auto", "runtime", f"'auto' or 'torch' for {obstacle}", repr(self.runtime))
        return "torch"

    def settings(self) -> dict[str, object]:
        """List the settings that the detections depend on; `runtime` is the one that is used without gradients."""
        return super().settings() | {
            "cfg": self.network.cfg_digest(),
            "runtime": "torch" if self._twin is None else self._choose_runtime(self._twin.obstacle(self.network)),
            "dtype": str(next(self.network.parameters()).dtype),
        }

"""YOLOv3 (Redmon and Farhadi 2018) as a `Detector`."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.detection.darknet import Darknet
from semfov.detection.darknet_onnx import OnnxTwin, Runtime, network_digest
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import chosen, recorded
from semfov.detection.scores import HALVES, BackgroundPolicy, Candidates
from semfov.detection.selection import Selection
from semfov.errors import InputError, check


def decode_yolo(
    raw: Tensor, anchors: Sequence[tuple[float, float]], canvas: tuple[int, int], scale: float = 1.0
) -> Candidates:
    r"""Decode the raw map of a YOLOv3 head to boxes and scores (Redmon and Farhadi 2018, section 2.1).

    For the cell in column i and row j, with `s` canvas pixels per cell and the anchor `(p_w, p_h)`:

        b_x = (σ(t_x) + i) s,   b_y = (σ(t_y) + j) s,   b_w = p_w exp(t_w),   b_h = p_h exp(t_h)

    Objectness and class scores are `σ(t)`.

    Shapes: raw `(B, A (5 + K), h, w)`.
    """
    batch, channels, rows, columns = raw.shape
    check(channels % len(anchors) == 0, "raw", f"a multiple of {len(anchors)} anchors as channels", tuple(raw.shape))
    cells = raw.permute(0, 2, 3, 1).reshape(batch, rows, columns, len(anchors), -1)
    column = torch.arange(columns, device=raw.device, dtype=raw.dtype)
    row = torch.arange(rows, device=raw.device, dtype=raw.dtype)
    corner = torch.stack(torch.meshgrid(column, row, indexing="xy"), -1)[:, :, None]
    step = raw.new_tensor([canvas[0] / columns, canvas[1] / rows])
    centre = (cells[..., 0:2].sigmoid() * scale - (scale - 1) / 2 + corner) * step
    half = cells[..., 2:4].exp() * (raw.new_tensor(anchors) / 2)
    boxes = torch.cat([centre - half, centre + half], -1)
    scores = cells[..., 4:].sigmoid()
    return Candidates(boxes.reshape(batch, -1, 4), scores[..., 1:].flatten(1, 3), scores[..., 0].flatten(1))


_RUNTIMES: tuple[Runtime, ...] = ("auto", "torch", "onnxruntime")


class YoloV3(Detector):
    """A Darknet network with YOLOv3 heads as a `Detector`; input_size `(width, height)`.

    Boxes and scores are differentiable with respect to the image. A canvas of another dtype is converted to the
    network's dtype.

    With runtime `"auto"`, onnxruntime computes the network on a CPU where no gradients are needed. It is faster there,
    and its results are equal up to rounding. Torch computes the network in all other cases: where gradients are enabled
    and the canvas or a parameter requires one, on accelerators, in other precisions, with weights that were changed
    after loading, and in compiled, exported or transformed functions. Forward hooks of the network are not called where
    onnxruntime computes it.
    """

    def __init__(
        self,
        network: Darknet,
        classes: tuple[str, ...],
        *,
        name: str = "yolov3",
        input_size: tuple[int, int] | None = None,
        stride: int | None = None,
        background: BackgroundPolicy = "residual",
        selection: Selection | None = None,
        digest: str = "",
        runtime: Runtime = "torch",
    ) -> None:
        check(runtime in _RUNTIMES, "runtime", " or ".join(map(repr, _RUNTIMES)), repr(runtime))
        size = network.input_size if input_size is None else input_size
        multiple = f"a multiple of {network.stride}"
        whole = all(n > 0 and n % network.stride == 0 for n in size)
        check(whole, "input_size", f"{multiple} along both axes", size)
        fits = stride is None or (isinstance(stride, int) and stride > 0 and stride % network.stride == 0)
        check(fits, "stride", f"None or {multiple}", repr(stride))
        for head in network.heads:
            check(head.classes == len(classes), "classes", f"{head.classes} names", len(classes))
        super().__init__(name, classes, size, background=background, selection=selection, stride=stride, digest=digest)
        self.network = network
        self.runtime = runtime
        self._twin = None if runtime == "torch" else OnnxTwin(network_digest(network))

    def propose(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of all heads on a canvas `(B, 3, H, W)`, RGB in [0, 1]."""
        if self._onnxruntime(canvas):
            assert self._twin is not None
            return self._twin(self.network, canvas)
        return self._propose_by_torch(canvas)

    def _onnxruntime(self, canvas: Tensor) -> bool:
        """Whether onnxruntime computes the network on this canvas; raises `InputError` for one without floats."""
        if not canvas.is_floating_point():
            raise InputError(f"canvas: expected floating-point RGB in [0, 1], got {canvas.dtype}")
        twin = self._twin
        return twin is not None and self._chosen(twin.obstacle_here(self.network, canvas)) == "onnxruntime"

    def _propose_by_torch(self, canvas: Tensor) -> Candidates:
        """All boxes of all heads, by torch."""
        maps = self.network(canvas.to(next(self.network.parameters()).dtype))
        maps = [raw.float() if raw.dtype in HALVES else raw for raw in maps]
        size = (canvas.shape[-1], canvas.shape[-2])
        candidates = [
            decode_yolo(raw, head.anchors, size, head.scale) for raw, head in zip(maps, self.network.heads, strict=True)
        ]
        return Candidates(
            torch.cat([some.boxes for some in candidates], 1),
            torch.cat([some.classes for some in candidates], 1),
            torch.cat([some.objectness for some in candidates if some.objectness is not None], 1),
        )

    def propose_with_features(
        self, canvas: Tensor, layers: Sequence[str] | None = None
    ) -> tuple[Candidates, dict[str, Tensor]]:
        """Compute all boxes and feature maps in one pass; layers are also named by their number in the cfg."""
        named = self.network.landmarks()
        numbers = {**{str(n): n for n in range(len(self.network.layers))}, **named}
        asked = [*named] if layers is None else layers
        wanted = {layer: numbers[layer] for layer in chosen(asked, [*numbers], self.name)}
        if self._onnxruntime(canvas):
            assert self._twin is not None
            return self._twin.with_features(self.network, canvas, wanted)
        with recorded({layer: self.network.layers[number] for layer, number in wanted.items()}) as maps:
            candidates = self._propose_by_torch(canvas)
        return candidates, {layer: each[0] for layer, each in maps.items()}

    def head_input(self, canvas: Tensor) -> Tensor:
        """Compute the input of the last convolution before the first head, by torch with any runtime."""
        return self.network.features(canvas.to(next(self.network.parameters()).dtype))

    def _chosen(self, obstacle: str | None) -> Runtime:
        """The runtime to use; `obstacle` is the reason why onnxruntime cannot be used."""
        if obstacle is None:
            return "onnxruntime"
        check(self.runtime == "auto", "runtime", f"'auto' or 'torch' for {obstacle}", repr(self.runtime))
        return "torch"

    def settings(self) -> dict[str, object]:
        """List the settings that the detections depend on; `runtime` is the one that is used without gradients."""
        return super().settings() | {
            "cfg": self.network.cfg_digest(),
            "runtime": "torch" if self._twin is None else self._chosen(self._twin.obstacle(self.network)),
            "dtype": str(next(self.network.parameters()).dtype),
        }

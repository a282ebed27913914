"""YOLOv3 (Redmon and Farhadi 2018) as a `Detector`."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.detection.darknet import Darknet
from semfov.detection.detector import Detector
from semfov.detection.onnx_twin import RUNTIMES, OnnxTwin, Runtime, network_digest
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.detection.selection import Selection
from semfov.errors import InputError, check


def decode_yolo(
    raw: Tensor, anchors: Sequence[tuple[float, float]], canvas: tuple[int, int], scale: float = 1.0
) -> Candidates:
    r"""Boxes and scores from the raw map of a YOLOv3 head (Redmon and Farhadi 2018, section 2.1).

    For the cell in column i and row j, with `s` the canvas pixels per cell and `(p_w, p_h)` the anchor:

        b_x = (σ(t_x) + i) s,   b_y = (σ(t_y) + j) s,   b_w = p_w exp(t_w),   b_h = p_h exp(t_h)

    Objectness and class scores are `σ(t)`.

    Args:
        raw: `(B, A (5 + K), h, w)`; channels are anchor by anchor x, y, width, height, objectness, classes.
        anchors: A pairs `(width, height)` in canvas pixels.
        canvas: `(width, height)` of the network's input.
        scale: σ(t) of the centre is stretched to `scale · σ(t) - (scale - 1) / 2`.

    Returns:
        `h · w · A` candidates for each image, row by row, anchors of a cell together.

    >>> decode_yolo(torch.zeros(1, 6, 1, 1), [(8, 4)], (32, 32)).boxes
    tensor([[[12., 14., 20., 18.]]])
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


class YoloV3(Detector):
    """A Darknet network with YOLOv3 heads as a `Detector`.

    Differentiable from the scores and boxes to the image. A canvas of another dtype is converted to the network's.

    With runtime `"auto"` onnxruntime computes what no gradient is asked of, on a CPU: it is faster there, and equal up
    to rounding. Torch computes all else: where gradients are enabled and the canvas or a parameter requires one, on
    accelerators, in other precisions, with weights changed after loading, and in compiled, exported or transformed
    functions. Forward hooks of the network see nothing of onnxruntime's work.

    Args:
        network: the network, trained.
        classes: names of its K classes.
        name: what tables and fitted models call it.
        input_size: `(width, height)` of the canvas; None takes the cfg's.
        stride: pad the canvas to a multiple of it only; None pads to `input_size`.
        background: background policy of the scores.
        selection: which candidates are kept.
        digest: sha256 of the weights.
        runtime: `"auto"`, always `"torch"`, or always `"onnxruntime"`, which refuses what it cannot compute.
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
        check(runtime in RUNTIMES, "runtime", " or ".join(map(repr, RUNTIMES)), repr(runtime))
        size = network.input_size if input_size is None else input_size
        multiple = f"a multiple of {network.stride}"
        check(all(n > 0 and n % network.stride == 0 for n in size), "input_size", f"{multiple} in both axes", size)
        fits = stride is None or (isinstance(stride, int) and stride > 0 and stride % network.stride == 0)
        check(fits, "stride", f"None or {multiple}", repr(stride))
        for head in network.heads:
            check(head.classes == len(classes), "classes", f"{head.classes} names", len(classes))
        super().__init__(name, classes, size, background=background, selection=selection, stride=stride, digest=digest)
        self.network = network
        self.runtime = runtime
        self._twin = None if runtime == "torch" else OnnxTwin(network_digest(network))

    def propose(self, canvas: Tensor) -> Candidates:
        """Every box of every head on a canvas `(B, 3, H, W)`, RGB in [0, 1]."""
        if not canvas.is_floating_point():
            raise InputError(f"canvas: expected floating-point RGB in [0, 1], got {canvas.dtype}")
        if self._twin is not None and self._chosen(self._twin.obstacle_here(self.network, canvas)) == "onnxruntime":
            return self._twin(self.network, canvas)
        maps = self.network(canvas.to(next(self.network.parameters()).dtype))
        size = (canvas.shape[-1], canvas.shape[-2])
        parts = [
            decode_yolo(raw, head.anchors, size, head.scale) for raw, head in zip(maps, self.network.heads, strict=True)
        ]
        return Candidates(
            torch.cat([part.boxes for part in parts], 1),
            torch.cat([part.classes for part in parts], 1),
            torch.cat([part.objectness for part in parts if part.objectness is not None], 1),
        )

    def features(self, canvas: Tensor) -> Tensor:
        """What the last convolution before the first head reads; torch computes it, whatever the runtime."""
        return self.network.features(canvas.to(next(self.network.parameters()).dtype))

    def _chosen(self, obstacle: str | None) -> Runtime:
        """What computes, where `obstacle` is why onnxruntime cannot."""
        if obstacle is None:
            return "onnxruntime"
        check(self.runtime == "auto", "runtime", f"'auto' or 'torch' for {obstacle}", repr(self.runtime))
        return "torch"

    def settings(self) -> dict[str, object]:
        """What the detections depend on; `runtime` is what computes without gradients."""
        return super().settings() | {
            "cfg": self.network.cfg_digest(),
            "runtime": "torch" if self._twin is None else self._chosen(self._twin.obstacle(self.network)),
            "dtype": str(next(self.network.parameters()).dtype),
        }

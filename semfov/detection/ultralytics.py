"""Models of Ultralytics as detectors, with the full score vector of every box."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from semfov.detection.modules import ModuleDetector, module_digest
from semfov.detection.onnx_heads import decode_yolov8
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.detection.selection import Selection
from semfov.errors import InputError


class _UltralyticsDetector(ModuleDetector):
    """A detection model of Ultralytics as a `Detector`; it is differentiable; input_size `(width, height)`."""

    def __init__(self, network: Any, classes: Sequence[str] | None, **options: Any) -> None:
        if classes is None:
            labels = network.names
            classes = [labels[index] for index in sorted(labels)] if isinstance(labels, dict) else list(labels)
        super().__init__(network, classes, fill=114 / 255, stride=32, **options)

    def feature_modules(self) -> dict[str, nn.Module]:
        """The layers that the head reads; a network without a list of layers has none."""
        layers: Any = getattr(self.model, "model", None)
        read = getattr(layers[-1], "f", None) if isinstance(layers, nn.Sequential) else None
        return {f"head{place}": layers[place] for place in read} if isinstance(read, list | tuple) else {}

    def propose(self, canvas: Tensor) -> Candidates:
        outputs = self.model(self._pixels(canvas))
        columns = outputs[0] if isinstance(outputs, list | tuple) else outputs
        if not isinstance(columns, Tensor) or columns.ndim != 3 or columns.shape[1] != 4 + self._count:
            got = tuple(columns.shape) if isinstance(columns, Tensor) else type(columns).__name__
            raise InputError(
                f"detector: expected a network that returns all class scores of each box, (B, {4 + self._count}, N), "
                f"got {got}; use a detection model whose head selects no boxes (end2end off)"
            )
        return self._named(decode_yolov8(columns.to(canvas.dtype)))


def wrap_ultralytics(
    model: nn.Module,
    *,
    classes: Sequence[str] | None = None,
    name: str = "ultralytics",
    input_size: int | tuple[int, int] = 640,
    background: BackgroundPolicy = "residual",
    selection: Selection | None = None,
    device: torch.device | str | None = None,
) -> _UltralyticsDetector:
    """Make a detector of a model of Ultralytics; input_size `(width, height)`."""
    network = _network(model)
    return _UltralyticsDetector(
        network if device is None else network.to(device),
        classes,
        name=name,
        input_size=(input_size, input_size) if isinstance(input_size, int) else input_size,
        background=background,
        selection=selection,
        digest=module_digest(network),
    ).eval()


def _network(model: Any) -> nn.Module:
    """The network of an `ultralytics.YOLO` object, which has it as its `model`; a network has layers there."""
    inner = getattr(model, "model", None)
    network = inner if hasattr(inner, "names") else model
    if not isinstance(network, nn.Module) or not hasattr(network, "names"):
        raise InputError(f"detector: expected a network of Ultralytics with names, got {type(model).__name__}")
    return network

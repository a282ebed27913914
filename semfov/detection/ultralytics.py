"""Models of Ultralytics as detectors, with the full score vector of every box."""

from collections.abc import Sequence
from typing import cast

from torch import Tensor, nn

from semfov.detection.modules import ModuleDetector, module_digest
from semfov.detection.onnx_decoding import decode_yolov8
from semfov.detection.scores import Candidates
from semfov.errors import InputError, check


class UltralyticsDetector(ModuleDetector):
    """A detection model of Ultralytics as a `Detector`; it is differentiable; input_size `(width, height)`."""

    def __init__(
        self,
        model: nn.Module,
        *,
        classes: Sequence[str] | None = None,
        name: str = "ultralytics",
        input_size: int | tuple[int, int] = 640,
    ) -> None:
        network = _network_of(model)
        if classes is None:
            classes = _names_of(network)
        if isinstance(input_size, int):
            input_size = input_size, input_size
        super().__init__(
            network,
            classes,
            name,
            input_size,
            fill=114 / 255,  # the grey around pictures that Ultralytics' models are trained with
            stride=32,
            digest=module_digest(network),
        )

    def feature_modules(self) -> dict[str, nn.Module]:
        """Find the layers that the head reads; a network without a list of layers has none."""
        layers = getattr(self.model, "model", None)
        if not isinstance(layers, nn.Sequential):
            return {}
        head_inputs = getattr(layers[-1], "f", None)  # where Ultralytics keeps the numbers of the layers that one reads
        if not isinstance(head_inputs, list | tuple):
            return {}
        return {f"head{number}": layers[number] for number in head_inputs}

    def propose(self, canvas: Tensor) -> Candidates:
        outputs = self.model(self._pixels(canvas))
        columns = outputs[0] if isinstance(outputs, list | tuple) else outputs
        shape = tuple(columns.shape) if isinstance(columns, Tensor) else (type(columns).__name__,)
        channels = 4 + self._count
        expected = f"a network that returns all class scores of each box, (B, {channels}, N)"
        remedy = "use a detection model whose head selects no boxes (end2end off)"
        check(len(shape) == 3 and shape[1] == channels, "detector", expected, f"{shape}; {remedy}")
        return self._of_classes(decode_yolov8(columns.to(canvas.dtype)))


def _network_of(model: nn.Module) -> nn.Module:
    """Find the network in a model of Ultralytics: in an `ultralytics.YOLO` its `model`, else the model itself."""
    # A network has layers as its own `model`, which have no names of classes.
    for network in (getattr(model, "model", None), model):
        if isinstance(network, nn.Module) and hasattr(network, "names"):
            return network
    raise InputError(f"detector: expected a network of Ultralytics with names, got {type(model).__name__}")


def _names_of(network: nn.Module) -> list[str]:
    """List the names of a network's classes, which it has by number or in a list."""
    names = cast(dict[int, str] | list[str], network.names)
    if isinstance(names, dict):
        return [names[number] for number in sorted(names)]
    return list(names)

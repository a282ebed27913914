"""Export a Darknet detector to ONNX, boxes decoded, for `load_onnx` and for any other runtime.

python -m semfov.detection.export yolov3-tiny out.onnx
"""

import argparse
import json
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from semfov.detection.darknet_builder import Builder
from semfov.detection.darknet_layers import Convolution, Head, MaxPool, Route, Shortcut, Upsample
from semfov.detection.detector import Detector
from semfov.detection.onnx_settings import METADATA_KEY
from semfov.detection.yolo import YoloV3
from semfov.errors import InputError, check
from semfov.files import replacing

OPSET = 17
IR_VERSION = 8
"""Of opset 17's time; newer ones are refused by runtimes that could run the model."""

OUTPUTS = ("boxes", "objectness", "classes")


class _Graph:
    """Nodes and constants of a graph under construction; every method returns the name of its output."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def add(self, op: str, *inputs: str, outputs: int = 1, **attributes: Any) -> Any:
        from onnx import helper

        start = f"{op.lower()}_{len(self.nodes)}"
        names = [start] if outputs == 1 else [f"{start}_{index}" for index in range(outputs)]
        self.nodes.append(helper.make_node(op, list(inputs), names, **attributes))
        return start if outputs == 1 else names

    def name_last(self, name: str) -> None:
        """Call the output of the last node `name`."""
        self.nodes[-1].output[0] = name

    def constant(self, values: Tensor | list[int] | list[float] | int | float) -> str:
        from onnx import numpy_helper

        tensor = torch.as_tensor(values)
        name = f"constant_{len(self.constants)}"
        self.constants[name] = numpy_helper.from_array(tensor.detach().cpu().contiguous().numpy(), name)
        return name

    def activation(self, kind: str, source: str) -> str:
        """An activation of Darknet."""
        if kind == "linear":
            return source
        if kind == "leaky":
            return self.add("LeakyRelu", source, alpha=0.1)
        if kind == "relu":
            return self.add("Relu", source)
        if kind == "mish":
            return self.add("Mul", source, self.add("Tanh", self.add("Softplus", source)))
        gate = self.add("Sigmoid", source)
        return self.add("Mul", source, gate) if kind == "swish" else gate

    def layer(self, layer: Any, *sources: str) -> str:
        """A layer of a Darknet network."""
        if isinstance(layer, Convolution):
            return self.activation(layer.activation, self._convolution(layer, sources[0]))
        if isinstance(layer, MaxPool):
            before, after = layer.padding // 2, layer.padding - layer.padding // 2
            return self.add(
                "MaxPool",
                sources[0],
                kernel_shape=[layer.size] * 2,
                strides=[layer.stride] * 2,
                pads=[before, before, after, after],
            )
        if isinstance(layer, Upsample):
            scales = self.constant([1.0, 1.0, float(layer.stride), float(layer.stride)])
            return self.add("Resize", sources[0], "", scales, mode="nearest", nearest_mode="floor",
                            coordinate_transformation_mode="asymmetric")  # fmt: skip
        if isinstance(layer, Route):
            parts = [self._part(source, layer) for source in sources]
            return parts[0] if len(parts) == 1 else self.add("Concat", *parts, axis=1)
        if isinstance(layer, Shortcut):
            return self.activation(layer.activation, self.add("Add", *sources))
        return sources[0]

    def _convolution(self, layer: Convolution, source: str) -> str:
        vertical, horizontal = (int(side) for side in layer.padding)
        return self.add(
            "Conv",
            source,
            self.constant(layer.weight.float()),
            self.constant(layer.bias.float()),  # type: ignore[union-attr]
            strides=list(layer.stride),
            pads=[vertical, horizontal, vertical, horizontal],
            group=layer.groups,
        )

    def _part(self, source: str, layer: Route) -> str:
        return source if layer.groups == 1 else self.add("Split", source, outputs=layer.groups, axis=1)[layer.group]

    def decode(self, head: Head, source: str, step: float) -> tuple[str, str, str]:
        """Boxes `(B, h w A, 4)`, objectness `(B, h w A)` and classes `(B, h w A, K)` as `decode_yolo` computes them."""
        anchors, channels = len(head.anchors), 5 + head.classes
        shape = self.constant([0, anchors, channels, -1])
        cells = self.add("Transpose", self.add("Reshape", source, shape), perm=[0, 3, 1, 2])
        parts = self.add("Split", cells, self.constant([2, 2, 1, head.classes]), outputs=4, axis=3)
        shift, size, objectness, classes = parts
        centre = self.add("Mul", self.add("Sigmoid", shift), self.constant(float(head.scale)))
        corner = self.add("Sub", self._corners(source), self.constant((head.scale - 1) / 2))
        centre = self.add("Mul", self.add("Add", centre, corner), self.constant(step))
        half = self.add("Mul", self.add("Exp", size), self.constant(torch.tensor(head.anchors) / 2))
        boxes = self.add("Concat", self.add("Sub", centre, half), self.add("Add", centre, half), axis=3)
        return (
            self.add("Reshape", boxes, self.constant([0, -1, 4])),
            self.add("Reshape", self.add("Sigmoid", objectness), self.constant([0, -1])),
            self.add("Reshape", self.add("Sigmoid", classes), self.constant([0, -1, head.classes])),
        )

    def _corners(self, source: str) -> str:
        """Column and row of every cell of a map, `(h w, 1, 2)`, for maps of any size."""
        size = self.add("Shape", source)
        rows, columns = (self.add("Gather", size, self.constant(axis)) for axis in (2, 3))
        count = self.add("Mul", rows, columns)
        cell = self.add("Range", self.constant(0), count, self.constant(1))
        column, row = self.add("Mod", cell, columns), self.add("Div", cell, columns)
        axes = self.constant([1, 2])
        pair = [self.add("Unsqueeze", each, axes) for each in (column, row)]
        return self.add("Cast", self.add("Concat", *pair, axis=2), to=1)


def export_onnx(detector: Detector, path: str | PathLike[str], *, static: bool = False) -> None:
    """Write a Darknet detector as an ONNX model.

    The model takes `images` `(B, 3, H, W)`, RGB in [0, 1], and gives `boxes` `(B, N, 4)`, `(x1, y1, x2, y2)` in
    canvas pixels, `objectness` `(B, N)` and `classes` `(B, N, K)`: every box of every head, undecided. Class names,
    input size and padding are in its metadata.

    Args:
        detector: a YOLOv3 that was loaded with `winograd=False`.
        path: where the model goes.
        static: one image of the detector's `input_size`, for runtimes that need to know; else any batch and any size
            that is a multiple of the network's stride.

    Raises:
        InputError: the detector is none of Darknet's, or its convolutions are Winograd's.
        DataError: the file cannot be written.
    """
    if not isinstance(detector, YoloV3):
        raise InputError(f"detector: expected a Darknet network, got {type(detector).__name__}")
    check(not detector.network.winograd, "detector", "plain convolutions: load it with winograd=False", "Winograd's")
    try:
        from onnx import TensorProto, helper, save
    except ImportError as error:
        raise ModuleNotFoundError("exporting needs the package onnx: pip install onnx") from error
    graph = _build(detector)
    width, height = detector.input_size
    batch, rows, columns = (1, height, width) if static else ("batch", "height", "width")
    boxes, classes = None if static else "boxes", len(detector.classes)
    shapes = {"boxes": [batch, boxes, 4], "objectness": [batch, boxes], "classes": [batch, boxes, classes]}
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            detector.name,
            [helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch, 3, rows, columns])],
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, shapes[name]) for name in OUTPUTS],
            list(graph.constants.values()),
        ),
        producer_name="semfov",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    helper.set_model_props(model, {METADATA_KEY: json.dumps(_settings(detector, static))})
    with replacing(Path(path)) as temporary:
        save(model, fspath(temporary))


def _build(detector: YoloV3) -> _Graph:
    """The whole graph, from `images` to `OUTPUTS`."""
    network = detector.network
    builder = Builder(network.channels)
    for section in network.sections[1:]:
        builder.add(section)
    graph = _Graph()
    names = {-1: "images"}
    found = []
    for index, layer in enumerate(network.layers):
        names[index] = graph.layer(layer, *(names[source] for source in builder.sources[index]))
        if isinstance(layer, Head):
            found.append(graph.decode(layer, names[index], float(builder.shapes[index].step)))
    for name, parts in zip(OUTPUTS, zip(*found, strict=True), strict=True):
        graph.add("Concat", *parts, axis=1)
        graph.name_last(name)
    return graph


def _settings(detector: YoloV3, static: bool) -> dict[str, object]:
    return {
        "name": detector.name,
        "head": "candidates",
        "classes": list(detector.classes),
        "input_size": list(detector.input_size),
        "background": detector.background,
        "preprocessing": {"fill": detector.fill},
    } | ({} if static else {"stride": detector.stride})


def largest_difference(detector: Detector, path: str | PathLike[str]) -> float:
    """Largest absolute difference of any number between a detector and its export, on one noise image.

    Boxes are compared as fractions of the canvas, so that all numbers are of order 1.
    """
    from semfov.detection.onnx import load_onnx

    exported = load_onnx(path)
    noise = torch.rand(1, 3, 480, 640, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        ours, theirs = (each.propose(each.fit(noise)[0]) for each in (detector, exported))
    side = max(detector.input_size)
    pairs = (
        (ours.boxes / side, theirs.boxes / side),
        (ours.classes, theirs.classes),
        (ours.objectness, theirs.objectness),
    )
    return max(float((a - b).abs().max()) for a, b in pairs if a is not None and b is not None)


def main() -> None:
    """Command line of the export."""
    from semfov.detection.load import load_yolo

    parser = argparse.ArgumentParser(prog="python -m semfov.detection.export", description="Darknet detector to ONNX")
    parser.add_argument("detector", help="yolov3-tiny, yolov3, yolov3-spp, or the path of a cfg")
    parser.add_argument("output", type=Path, help="the ONNX file to write")
    parser.add_argument("--weights", help="weights file, for a cfg or instead of the published weights")
    parser.add_argument("--classes", help="text file with a class name on each line, if not COCO's")
    parser.add_argument("--input-size", type=int, help="side of the canvas in pixels")
    parser.add_argument("--static", action="store_true", help="fix the batch to one image, and the image's size")
    arguments = parser.parse_args()
    detector = load_yolo(
        arguments.detector,
        weights=arguments.weights,
        classes=arguments.classes,
        input_size=arguments.input_size,
        stride=None if arguments.static else 32,
        winograd=False,
    )
    export_onnx(detector, arguments.output, static=arguments.static)
    difference = largest_difference(detector, arguments.output)
    print(f"{arguments.output}: largest difference from the torch network {difference:.1e}")


if __name__ == "__main__":
    main()

"""Export of a look as one ONNX graph: window, detector, selection and evidence, for robots and cameras.

Run it from a checkout: python -m examples.export_look yolox-nano look.onnx
"""

import argparse
import json
import tempfile
import warnings
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from examples.look_graph import IR_VERSION, OPSET, LookGraph, Proposals, Value, constant
from semfov.detection.detector import Detector
from semfov.detection.load import load_detector
from semfov.detection.onnx import OnnxDetector
from semfov.detection.preprocessing import Preprocessing
from semfov.detection.scores import Candidates, score_vectors
from semfov.errors import InputError, SemfovError, check
from semfov.io.files import replacing
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import WindowEye
from semfov.zoom.hints import Gist
from semfov.zoom.survey import STEPS

_LOOK_METADATA_KEY = "semfov.look"


def export_look(
    eye: WindowEye, path: str | PathLike[str], evidence: GlimpseEvidence | None = None, *, cells: int = 32
) -> None:
    """Write a look of an eye as one ONNX model, which runs without torch and without semfov.

    Inputs:

    - `picture`: `(H, W, 3)`, bytes, RGB, of any size;
    - `fixation`: `(3,)`, float32, `(x, y, magnification)` as for `WindowEye.look`.

    Outputs:

    - `boxes` `(L, 4)` in picture pixels and `scores` `(L, K+1)`, background first; most confident first;
    - `cut` `(L,)`, true where the border of the window cuts the box;
    - `window` `(4,)`, the part of the picture that was seen;
    - with evidence: `rates` `(K+1, 3, c, c)`, logarithms of the number of further objects of any class (0) and of each
      class that looks one, two and three octaves closer are expected to find in each cell of the window.

    Windows are rounded to whole pixels, resampled as bytes with antialiasing, and cut to the picture, as by the eye.
    (The eye reads very large windows that are reduced more than four times as means of squares of pixels. The graph
    does not, and its canvas differs slightly.) A detector that is an ONNX file is converted to opset 18 and otherwise
    unchanged. Any other detector is exported by torch. Boxes that the border of the window cuts are kept, whatever the
    setting `cut` of the eye.

    Args:
        eye: the eye.
        path: file to write.
        evidence: predicts what closer looks find; None leaves it out.
        cells: c, number of cells along a side of the window for the evidence: 32, or 16 for windows one octave coarser
            than the closest.

    Raises:
        InputError: the evidence is for other classes, or the detector cannot be exported.
        ModuleNotFoundError: the packages onnx and onnxscript are not installed.
        DataError: the file cannot be written.

    Example::

        eye = WindowEye(semfov.load_detector("yolox-nano"), stretch=False)
        export_look(eye, "look.onnx", GlimpseEvidence.from_pretrained("yolox-nano"))
    """
    try:
        import onnxscript  # noqa: F401 (torch exports with it)
        from onnx import checker
    except ImportError as error:
        raise ModuleNotFoundError("exporting a look needs two packages: pip install onnx onnxscript") from error
    detector = eye.detector
    check(cells >= 8 and cells % 8 == 0, "cells", "a multiple of 8", cells)
    if evidence is not None:
        count = len(detector.classes)
        check(evidence.classes == count, "evidence", f"one for {count} classes", evidence.classes)
        evidence.check_compatible(eye.settings())
    graph = LookGraph(detector)
    model = _model_of(graph, _look(graph, detector, evidence, cells))
    metadata = {"classes": list(detector.classes), "input_size": list(detector.input_size), "cells": cells}
    model.metadata_props.add(key=_LOOK_METADATA_KEY, value=json.dumps(metadata))
    checker.check_model(model)
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(model.SerializeToString())


class _Output(NamedTuple):
    """An output of the exported model: its name, its value, and its shape, with words for sizes that are open."""

    name: str
    value: Value
    shape: list[int | str]


def _look(graph: LookGraph, detector: Detector, evidence: GlimpseEvidence | None, cells: int) -> list[_Output]:
    """Add a look to a graph, from its inputs `picture` and `fixation` on; returns the outputs of `export_look`."""
    classes = len(detector.classes)
    picture = Value(graph, "picture", torch.uint8)
    window = graph.window(picture, Value(graph, "fixation", torch.float32))
    proposals = _propose(graph, detector, window.canvas)
    on_canvas = graph.select(proposals, detector.selection)
    detections = on_canvas._replace(boxes=graph.to_picture(on_canvas.boxes, window))
    outputs = [
        _Output("boxes", detections.boxes, ["found", 4]),
        _Output("scores", detections.vectors, ["found", classes + 1]),
        _Output("cut", graph.cut(on_canvas.boxes, window, picture), ["found"]),
        _Output("window", window.shown.to(torch.float32), [4]),
    ]
    if evidence is not None:
        hints_on_canvas = graph.hints(proposals)
        hints = hints_on_canvas._replace(boxes=graph.to_picture(hints_on_canvas.boxes, window))
        gist = graph.gist(hints, detections, window, cells, classes)
        nothing = torch.zeros(cells, cells, classes), torch.zeros(cells, cells), torch.zeros(cells, cells, classes)
        (rates,) = graph.append(_exported(_Predicting(evidence), *nothing), "evidence/", _numbered(gist))
        outputs.append(_Output("rates", rates, [classes + 1, STEPS, cells, cells]))
    return outputs


def _model_of(graph: LookGraph, outputs: Sequence[_Output]) -> Any:
    """Make the ONNX model of a graph."""
    from onnx import TensorProto, helper

    described = []
    for output in outputs:
        graph.add("Identity", output.value.name, output=output.name)
        element = TensorProto.BOOL if output.value.dtype == torch.bool else TensorProto.FLOAT
        described.append(helper.make_tensor_value_info(output.name, element, output.shape))
    inputs = [
        helper.make_tensor_value_info("picture", TensorProto.UINT8, ["height", "width", 3]),
        helper.make_tensor_value_info("fixation", TensorProto.FLOAT, [3]),
    ]
    return helper.make_model(
        helper.make_graph(graph.nodes, "look", inputs, described, list(graph.constants.values())),
        producer_name="semfov",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )


class _Proposing(nn.Module):
    """Module that returns boxes, confidence and score vectors of every candidate of a torch detector."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, canvas: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return _columns(self.detector.propose(canvas), self.detector)


class _Decoding(nn.Module):
    """Module that returns the same from the outputs of the network of an `OnnxDetector`."""

    def __init__(self, detector: OnnxDetector, names: list[str]) -> None:
        super().__init__()
        self.detector = detector
        self.names = names

    def forward(self, *outputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        by_name = dict(zip(self.names, outputs, strict=True))
        return _columns(self.detector.decode(by_name, self.detector.input_size), self.detector)


class _Predicting(nn.Module):
    """Module that returns the rates that evidence predicts for a gist."""

    def __init__(self, evidence: GlimpseEvidence) -> None:
        super().__init__()
        self.evidence = evidence

    def forward(self, strongest: Tensor, size: Tensor, found: Tensor) -> tuple[Tensor]:
        look = Gist(0, (0, 0), 1, strongest, size, found > 0)
        classes = torch.arange(1, self.evidence.classes + 1)
        return (torch.cat([self.evidence.survey.rates(look), self.evidence.rates(look, classes)]),)


def _columns(candidates: Candidates, detector: Detector) -> tuple[Tensor, Tensor, Tensor]:
    return candidates.boxes, candidates.confidence, score_vectors(candidates, detector.background)


def _propose(graph: LookGraph, detector: Detector, canvas: Value) -> Proposals:
    """Add the detector to a graph, for a canvas `(1, 3, h, w)`."""
    if isinstance(detector, OnnxDetector):
        outputs = _network(graph, detector, canvas)
        examples = detector.session.probe(detector.input_size)
        decoding = _exported(_Decoding(detector, list(examples)), *examples.values())
        columns = graph.append(decoding, "head/", _numbered(outputs))
    else:
        width, height = detector.input_size
        proposing = _exported(_Proposing(detector), torch.zeros(1, 3, height, width))
        columns = graph.append(proposing, "detector/", _numbered([canvas]))
    return Proposals(*columns)


def _network(graph: LookGraph, detector: OnnxDetector, canvas: Value) -> list[Value]:
    """Add the network in a detector's file to a graph, for a canvas; returns its outputs."""
    import onnx
    from onnx import version_converter

    model = onnx.load(detector.session.path)
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in constants]
    if len(inputs) != 1 or detector.session.shape[0] not in (None, 1):
        names = ", ".join(f"{value.name!r}" for value in inputs)
        raise InputError(f"detector: expected a network that takes one image and nothing else, got inputs {names}")
    try:
        model = version_converter.convert_version(model, OPSET)
    except Exception as error:  # the converter raises errors of many kinds
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"detector: expected a model that converts to opset {OPSET}, got {reason}") from error
    image = _preprocessed(graph, detector.preprocessing, canvas)
    image = image.node("Cast", to=inputs[0].type.tensor_type.elem_type)
    outputs = graph.append(model, "network/", {inputs[0].name: image})
    return [output.to(torch.float32) for output in outputs]


def _preprocessed(graph: LookGraph, preprocessing: Preprocessing, canvas: Value) -> Value:
    """Add `(canvas · scale - mean) / std` to a graph, with the channels in the network's order."""
    if preprocessing.channels == "bgr":
        canvas = canvas.take(constant(graph, torch.tensor([2, 1, 0])), axis=1)
    factor = [preprocessing.scale / std for std in preprocessing.std]
    shift = [mean / std for mean, std in zip(preprocessing.mean, preprocessing.std, strict=True)]
    by_channel = (1, 3, 1, 1)
    scaled = canvas * constant(graph, torch.tensor(factor).view(by_channel))
    return scaled - constant(graph, torch.tensor(shift).view(by_channel))


def _exported(module: nn.Module, *inputs: Tensor) -> Any:
    """Make the ONNX model of a torch module, whose inputs are `x_0`, `x_1` and so on."""
    import onnx

    names = [f"x_{number}" for number in range(len(inputs))]
    with warnings.catch_warnings(), torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")  # from inside the exporter
        path = Path(folder) / "part.onnx"
        torch.onnx.export(
            module.eval().requires_grad_(False),
            inputs,
            path,
            input_names=names,
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
            external_data=False,
        )
        return onnx.load(path)


def _numbered(values: Iterable[Value]) -> dict[str, Value]:
    """Name the values that a module of `_exported` reads."""
    return {f"x_{number}": value for number, value in enumerate(values)}


def main() -> None:
    """Run the command line of the export."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.export_look", description="export a look as one ONNX graph"
    )
    parser.add_argument("detector", help="a name, or an ONNX file")
    parser.add_argument("output", type=Path, help="the ONNX file to write")
    parser.add_argument("--weights", help="file of the detector's weights, instead of a download")
    parser.add_argument("--evidence", help="fitted evidence by magnification: a name or a file")
    parser.add_argument("--cells", type=int, default=32, help="cells along a side of the window, for the evidence")
    options = parser.parse_args()
    try:
        weights = {} if options.weights is None else {"weights": options.weights}
        detector = load_detector(options.detector, **weights)
        evidence = None if options.evidence is None else GlimpseEvidence.from_pretrained(options.evidence)
        eye = WindowEye(detector, stretch=False).eval()
        export_look(eye, options.output, evidence, cells=options.cells)
    except SemfovError as error:
        parser.exit(1, f"error: {error}\n")
    print(f"written: {options.output}")


if __name__ == "__main__":
    main()

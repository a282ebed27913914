"""Export of a look as one ONNX graph: window, detector, selection and evidence, for robots and cameras.

Run it from a checkout: python -m examples.export_look yolox-nano look.onnx
"""

import argparse
import json
import tempfile
import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from examples.look_graph import IR_VERSION, OPSET, LookGraph
from semfov.detection.detector import Detector
from semfov.detection.load import load_detector
from semfov.detection.onnx import OnnxDetector
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
        from onnx import TensorProto, checker, helper
    except ImportError as error:
        raise ModuleNotFoundError("exporting a look needs two packages: pip install onnx onnxscript") from error
    detector = eye.detector
    kinds = len(detector.classes)
    check(cells >= 8 and cells % 8 == 0, "cells", "a multiple of 8", cells)
    if evidence is not None:
        check(evidence.classes == kinds, "evidence", f"one for {kinds} classes", evidence.classes)
        evidence.check_compatible(eye.settings())
    graph = LookGraph(detector)
    canvas, frame, start = graph.window("picture", "fixation")
    boxes, confidence, vectors = _propose(graph, detector, canvas)
    on_canvas, scores = graph.selection(boxes, confidence, vectors, detector.selection)
    placed, cut = graph.placed(on_canvas, frame, "picture")
    window = graph.add("Slice", frame, graph.constant([0]), graph.constant([4]))
    outputs: dict[str, tuple[str, list[Any]]] = {
        "boxes": (placed, ["found", 4]),
        "scores": (scores, ["found", kinds + 1]),
        "cut": (cut, ["found"]),
        "window": (graph.add("Cast", window, to=TensorProto.FLOAT), [4]),
    }
    if evidence is not None:
        faint, values = graph.hints(boxes, confidence, vectors)
        hints = graph.placed(faint, frame, "picture")[0], values
        gist = graph.gist(hints, (placed, scores), start, cells, kinds)
        (rates,) = graph.append(_exported(_Predicting(evidence), *_examples(cells, kinds)), "evidence/", _named(gist))
        outputs["rates"] = rates, [kinds + 1, STEPS, cells, cells]
    for name, (value, _) in outputs.items():
        graph.add("Identity", value, output=name)
    described = [
        helper.make_tensor_value_info(name, TensorProto.BOOL if name == "cut" else TensorProto.FLOAT, shape)
        for name, (_, shape) in outputs.items()
    ]
    inputs = [
        helper.make_tensor_value_info("picture", TensorProto.UINT8, ["height", "width", 3]),
        helper.make_tensor_value_info("fixation", TensorProto.FLOAT, [3]),
    ]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "look", inputs, described, list(graph.constants.values())),
        producer_name="semfov",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    metadata = {"classes": list(detector.classes), "input_size": list(detector.input_size), "cells": cells}
    model.metadata_props.add(key=_LOOK_METADATA_KEY, value=json.dumps(metadata))
    checker.check_model(model)
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(model.SerializeToString())


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
        self.detector, self.names = detector, names

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


def _propose(graph: LookGraph, detector: Detector, canvas: str) -> tuple[str, str, str]:
    """Boxes `(1, N, 4)`, confidence `(1, N)` and score vectors `(1, N, K+1)` of a canvas."""
    wide, high = detector.input_size
    if isinstance(detector, OnnxDetector):
        outputs = _network(graph, detector, canvas)
        raw = detector.session.probe(detector.input_size)
        decoding = _exported(_Decoding(detector, list(raw)), *raw.values())
        proposals = graph.append(decoding, "head/", _named(outputs))
    else:
        proposals = graph.append(
            _exported(_Proposing(detector), torch.zeros(1, 3, high, wide)), "detector/", {"x_0": canvas}
        )
    boxes, confidence, vectors = proposals
    return boxes, confidence, vectors


def _network(graph: LookGraph, detector: OnnxDetector, canvas: str) -> list[str]:
    """Add the network in a detector's file to the graph, for a canvas; returns its outputs."""
    import onnx
    from onnx import version_converter

    preprocessing = detector.preprocessing
    if preprocessing.channels == "bgr":
        canvas = graph.add("Gather", canvas, graph.constant([2, 1, 0]), axis=1)
    factor, shift = (
        torch.tensor([value / std for value, std in zip(values, preprocessing.std, strict=True)]).view(1, 3, 1, 1)
        for values in ([preprocessing.scale] * 3, preprocessing.mean)
    )
    image = graph.add("Sub", graph.add("Mul", canvas, graph.constant(factor)), graph.constant(shift))
    model = onnx.load(detector.session.path)
    constants = {constant.name for constant in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in constants]
    if len(inputs) != 1 or detector.session.shape[0] not in (None, 1):
        names = ", ".join(f"{value.name!r}" for value in inputs)
        raise InputError(f"detector: expected a network that takes one image and nothing else, got inputs {names}")
    try:
        model = version_converter.convert_version(model, OPSET)
    except Exception as error:  # the converter raises errors of many kinds
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"detector: expected a model that converts to opset {OPSET}, got {reason}") from error
    image = graph.add("Cast", image, to=inputs[0].type.tensor_type.elem_type)
    outputs = graph.append(model, "network/", {inputs[0].name: image})
    return [graph.add("Cast", output, to=onnx.TensorProto.FLOAT) for output in outputs]


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


def _named(values: Any) -> dict[str, str]:
    return {f"x_{number}": value for number, value in enumerate(values)}


def _examples(cells: int, classes: int) -> tuple[Tensor, Tensor, Tensor]:
    return torch.zeros(cells, cells, classes), torch.zeros(cells, cells), torch.zeros(cells, cells, classes)


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
        detector = load_detector(options.detector, **({} if options.weights is None else {"weights": options.weights}))
        evidence = None if options.evidence is None else GlimpseEvidence.from_pretrained(options.evidence)
        export_look(WindowEye(detector, stretch=False).eval(), options.output, evidence, cells=options.cells)
    except SemfovError as error:
        parser.exit(1, f"error: {error}\n")
    print(f"written: {options.output}")


if __name__ == "__main__":
    main()

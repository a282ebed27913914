"""Fuzz ONNX files: detectors with unusual shapes, types and metadata, valid or damaged."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from benchmarks.fuzz.runner import Case, Draw, changed
from semfov.detection import Detections, Detector
from semfov.detection.load import load_detector

SIDES = (1, 7, 48, 100_000, 2**40, 0, -1, "w")
TYPES = (TensorProto.DOUBLE, TensorProto.INT64, TensorProto.BOOL, TensorProto.STRING)
FAULTS = ("height", "width", "batch", "channels", "rank", "type", "classes", "metadata", "file", "options")
METADATA: tuple[dict[str, str], ...] = (
    {},
    {"names": "{0: 'cup', 1: 'cat'}"},
    {"names": "[" * 5000},
    {"names": "{0: 'a', 2: 'b'}"},
    {"imgsz": "[32, 32]"},
    {"imgsz": "[1e9]"},
    {"semfov": "[" * 20_000},
    {"semfov": json.dumps({"classes": ["cup", "cat"], "head": "yolov5"})},
    {"semfov": json.dumps({"classes": [1]})},
    {"semfov": json.dumps({"input_size": [10**9, 10**9]})},
    {"semfov": json.dumps({"head": "nothing"})},
    {"semfov": "{" + "}" * 9},
    {"noise": "x" * (2**20 + 1)},
)


def onnx_files(draw: Draw, folder: Path) -> Case:
    """`load_detector`: a detector with finite boxes and scores on the simplex, or an error that names the fault."""
    faults = draw.data.draw(st.sets(st.sampled_from(FAULTS), max_size=2), label="faults")

    def faulty(fault: str, odd: Iterable[Any], usual: Any) -> Any:
        return draw.choose(odd, fault) if fault in faults else usual

    shape = [
        faulty("batch", ("b", 2, 10**9, 0), 1),
        faulty("channels", (1, 4, "c"), 3),
        faulty("height", SIDES, 32),
        faulty("width", SIDES, 32),
    ]
    rank, kind = faulty("rank", (2, 1, 0), 3), faulty("type", TYPES, TensorProto.FLOAT)
    options: dict[str, Any] = {"head": "yolov5", "classes": ["cup", "cat"]}
    if "options" in faults:
        del options[draw.choose(options, "left out")]
        options |= draw.choose(({}, {"input_size": (32, 32)}, {"input_size": 10**9}, {"threshold": 2}), "option")
    model = network(shape, rank, faulty("classes", (0, 1, 3), 2), kind, draw.rng)
    for key, value in faulty("metadata", METADATA, {}).items():
        model.metadata_props.add(key=key, value=value)
    damage = faulty("file", ("cut", "bytes", "bit", "text", "longer"), "none")
    path = folder / "model.onnx"
    path.write_bytes(changed(model.SerializeToString(), damage, draw.rng))

    def detect() -> tuple[Detector, Detections]:
        detector = load_detector(path, threads=1, **options)
        return detector, detector(torch.rand(1, 3, 40, 30))

    def check(found: tuple[Detector, Detections]) -> None:
        detector, detections = found
        assert bool(detections.boxes.isfinite().all())
        assert detections.scores.shape[-1] == len(detector.classes) + 1
        assert bool(((detections.scores.sum(-1) - 1).abs() < 1e-3)[detections.mask].all())

    return Case(detect, check, may=bool(faults), must=False)


def network(image: list[Any], rank: int, classes: int, kind: int, rng: np.random.Generator) -> onnx.ModelProto:
    """Return a network with YOLOv5-style rows that do not depend on the image, converted to the given rank and type."""
    rows = rng.random((1, 6, 5 + classes)).astype(np.float32)
    rows[..., :4] *= 30
    rows = rows.reshape(rows.shape if rank == 3 else {2: (6, -1), 1: (-1,), 0: (-1,)}[rank])
    last = helper.make_node("Identity", ["sum"], ["cut"])
    if rank == 0:
        last = helper.make_node("ReduceMean", ["sum"], ["cut"], keepdims=0)
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["rows", "nothing"], ["sum"]),
        last,
        helper.make_node("Cast", ["cut"], ["output"], to=kind),
    ]
    stored = [numpy_helper.from_array(rows, "rows"), numpy_helper.from_array(np.zeros((), np.float32), "zero")]
    inputs = [helper.make_tensor_value_info("image", TensorProto.FLOAT, image)]
    outputs = [helper.make_tensor_value_info("output", kind, None)]
    graph = helper.make_graph(nodes, "graph", inputs, outputs, stored)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)

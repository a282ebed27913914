"""Fuzz the outputs of ONNX models: boxes and scores in the forms of exporters, or in forms that have to be refused."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from benchmarks.fuzz.runner import Case, Draw
from semfov.detection.onnx import OnnxDetector, load_onnx
from semfov.detection.scores import Candidates

CANVASES = ((64, 64), (96, 64), (64, 160))  # width, height
NAMES = ("cup", "cat", "dog", "tv", "boat")
WRONG = ("none", "fractions", "logits", "far", "task", "label", "count")

_Array = NDArray[np.float32]


def onnx_outputs(draw: Draw, folder: Path) -> Case:
    """`load_onnx` without a head: the boxes and scores that were written, or an error that names what does not fit."""
    canvas, form = draw.choose(CANVASES, "canvas"), draw.choose(FORMS, "form")
    wrong, classes = draw.choose(WRONG, "wrong"), draw.integer(1, len(NAMES), "classes")
    own_rows = form in ("end2end", "rtdetr rows", "rtdetr", "detr", "candidates")
    boxes, scores = _truth(draw, 12 if own_rows else _cells(canvas), classes, canvas, one=form == "end2end")
    metadata = {"names": str(dict(enumerate(NAMES[:classes])))}
    if form == "end2end" and draw.flag("metadata"):
        metadata["end2end"] = "True"
    if wrong == "task":
        metadata["task"] = draw.choose(("segment", "pose", "obb", "classify"), "task")
    written = boxes
    if wrong == "fractions":
        written = (boxes / np.array([*canvas, *canvas])).astype(np.float32)
    elif wrong == "far":
        written = boxes + 5000
    written_scores = 12 * scores - 6 if wrong == "logits" and form not in ("rtdetr", "detr") else scores
    if wrong == "logits" and form in ("rtdetr", "detr"):
        metadata["probabilities"] = "yes"  # after their sigmoid or softmax
    outputs = FORMS[form](written, written_scores, canvas, "probabilities" in metadata)
    if wrong == "label" and form == "end2end":
        outputs["output0"][0, 0, 5] = classes + 2
    if wrong == "count":
        del metadata["names"]
    path = folder / "model.onnx"
    path.write_bytes(_network(outputs, canvas, metadata).SerializeToString())

    def detect() -> tuple[OnnxDetector, Candidates]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            detector = load_onnx(path, threads=1)
            return detector, detector.propose(torch.full((1, 3, canvas[1], canvas[0]), 0.5))

    def check(found: tuple[OnnxDetector, Candidates]) -> None:
        candidates = found[1]
        assert np.abs(candidates.boxes[0].numpy() - boxes).max() < 0.05, found[0].head
        assert np.abs(candidates.classes[0].numpy() - scores).max() < 1e-3, found[0].head

    # A shape may fit two heads, or none with certainty, so every form may be refused.
    return Case(detect, check, may=True, must=wrong not in ("none", *(() if form == "end2end" else ("label",))))


def _truth(draw: Draw, count: int, classes: int, canvas: tuple[int, int], *, one: bool) -> tuple[_Array, _Array]:
    """Boxes `(N, 4)` on a canvas and scores `(N, K)`; with `one`, one class of each box has a score."""
    size = np.array(canvas, np.float32)
    centre = draw.rng.random((count, 2)).astype(np.float32) * size
    half = (0.05 + 0.2 * draw.rng.random((count, 2)).astype(np.float32)) * size
    scores = draw.rng.random((count, classes)).astype(np.float32)
    if one:
        kept = draw.rng.integers(0, classes, count)
        scores *= np.arange(classes) == kept[:, None]
    return np.concatenate([centre - half, centre + half], -1), scores


def _cells(canvas: tuple[int, int]) -> int:
    return sum(-(-canvas[0] // stride) * -(-canvas[1] // stride) for stride in (8, 16, 32))


def _centred(boxes: _Array) -> _Array:
    """Centres and sizes of boxes."""
    return np.concatenate([(boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]], -1)


def _with_objectness(boxes: _Array, scores: _Array) -> _Array:
    return np.concatenate([_centred(boxes), np.ones((len(boxes), 1), np.float32), scores], -1)[None]


def _yolox(boxes: _Array, scores: _Array, canvas: tuple[int, int], probabilities: bool) -> dict[str, _Array]:
    """Offsets from the cells, and logarithms of the sizes, in strides."""
    rows, at = _with_objectness(boxes, scores), 0
    for stride in (8, 16, 32):
        columns, lines = -(-canvas[0] // stride), -(-canvas[1] // stride)
        y, x = np.divmod(np.arange(columns * lines), columns)
        level = rows[0, at : at + columns * lines]
        level[:, :2] = level[:, :2] / stride - np.stack([x, y], -1)
        level[:, 2:4] = np.log(level[:, 2:4] / stride)
        at += columns * lines
    return {"output": rows}


def _end_to_end(boxes: _Array, scores: _Array, canvas: tuple[int, int], probabilities: bool) -> dict[str, _Array]:
    label = np.abs(scores).argmax(-1)
    best = np.take_along_axis(scores, label[:, None], 1)
    return {"output0": np.concatenate([boxes, best, label[:, None].astype(np.float32)], -1)[None]}


def _detr(boxes: _Array, scores: _Array, canvas: tuple[int, int], probabilities: bool) -> dict[str, _Array]:
    """Scores of all classes and of no object, before the softmax; `scores` are made such that they sum to 1."""
    scores /= scores.sum(-1, keepdims=True) + 0.5
    full = np.concatenate([scores, 1 - scores.sum(-1, keepdims=True)], -1)
    logits = full if probabilities else np.log(full.clip(1e-9))
    return {"logits": logits[None], "pred_boxes": _fractions(boxes, canvas)[None]}


def _rtdetr(boxes: _Array, scores: _Array, canvas: tuple[int, int], probabilities: bool) -> dict[str, _Array]:
    logits = scores if probabilities else np.log(scores.clip(1e-9) / (1 - scores).clip(1e-9))
    return {"logits": logits[None], "pred_boxes": _fractions(boxes, canvas)[None]}


def _fractions(boxes: _Array, canvas: tuple[int, int]) -> _Array:
    return (_centred(boxes) / np.array([*canvas, *canvas])).astype(np.float32)


def _v8(boxes: _Array, scores: _Array) -> _Array:
    return np.concatenate([_centred(boxes), scores], -1)[None]


_Form = Callable[[_Array, _Array, tuple[int, int], bool], dict[str, _Array]]

FORMS: dict[str, _Form] = {
    "yolov8": lambda boxes, scores, canvas, _: {"output0": _v8(boxes, scores).transpose(0, 2, 1)},
    "yolov8 rows": lambda boxes, scores, canvas, _: {"output0": _v8(boxes, scores)},
    "yolox": _yolox,
    "yolox decoded": lambda boxes, scores, canvas, _: {"output": _with_objectness(boxes, scores)},
    "yolov6": lambda boxes, scores, canvas, _: {"outputs": _with_objectness(boxes, scores)},
    "end2end": _end_to_end,
    "rtdetr rows": lambda boxes, scores, canvas, _: {
        "output0": np.concatenate([_fractions(boxes, canvas), scores], -1)[None]
    },
    "rtdetr": _rtdetr,
    "detr": _detr,
    "candidates": lambda boxes, scores, canvas, _: {"boxes": boxes[None], "scores": scores[None]},
}
"""Outputs of exporters by what they are called, made of boxes and scores."""


def _network(outputs: dict[str, _Array], canvas: tuple[int, int], metadata: dict[str, str]) -> onnx.ModelProto:
    """Return a network with outputs that do not depend on the picture."""
    nodes = [helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0)]
    nodes.append(helper.make_node("Mul", ["mean", "zero"], ["nil"]))
    stored = [numpy_helper.from_array(np.zeros((), np.float32), "zero")]
    infos = []
    for name, values in outputs.items():
        stored.append(numpy_helper.from_array(np.ascontiguousarray(values, np.float32), f"{name} values"))
        nodes.append(helper.make_node("Add", [f"{name} values", "nil"], [name]))
        infos.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, list(values.shape)))
    inputs = [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, canvas[1], canvas[0]])]
    model = helper.make_model(
        helper.make_graph(nodes, "graph", inputs, infos, stored),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=8,
    )
    for key, value in metadata.items():
        model.metadata_props.add(key=key, value=value)
    return model

"""ONNX files of detectors: checks before memory is allocated, their settings, and copies with another input size."""

import ast
import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from semfov.detection.feature_maps import NetworkStep, stride_of
from semfov.detection.onnx_heads import STRIDES, cells
from semfov.detection.weights import cache_folder
from semfov.errors import DataError, check
from semfov.io.files import check_regular, inside, read_text, sha256, write_bytes
from semfov.io.schema import excerpt, is_number, is_plain

_MOST_ELEMENTS = 2**28
"""Largest number of elements of a tensor in a model; 1 GiB as float32."""
_MOST_METADATA = 2**20
"""Largest number of characters of a model's metadata."""
_MOST_PIXELS = 89_478_485
"""Largest number of pixels of a canvas, the same as for pictures that are read."""
_USUAL_SIDE = 640
"""Side of a picture with which open sizes are tried out."""
_WITH_GRAPHS = {"Loop", "Scan", "If"}
"""Operations with graphs of their own, whose steps are not counted."""
_COARSEST = 32  # pixels; maps of this stride are doubled and added to finer ones

METADATA_KEY = "semfov"
"""Key of the settings, as JSON, in the metadata of models that semfov exports."""

_KEYS: dict[str, tuple[type, ...]] = {
    "name": (str,),
    "head": (str,),
    "classes": (list,),
    "input_size": (int, list),
    "stride": (int, type(None)),
    "background": (str,),
    "logits": (bool,),
    "preprocessing": (dict,),
    "licence": (str,),
    "source": (str,),
}
"""Keys of a settings file, with the types of their values; `licence` and `source` are for people."""


def check_file(path: Path) -> bool:
    """Check that tensors are not too large and that weights lie in the model's folder, by shape inference alone."""
    import onnx

    check_regular(path, f"ONNX model {str(path)!r}")
    if not path.is_file():
        raise DataError(f"ONNX model {str(path)!r}: no such file; check the path")
    try:
        model = onnx.load(path, load_external_data=False)
        stored = [*model.graph.initializer]
        for tensor in stored:
            for entry in tensor.external_data:
                if entry.key == "location":
                    check_regular(inside(path.parent, entry.value))
        _check_sizes(path, ((tensor.name, tensor.dims) for tensor in stored))
        if sum(len(entry.key) + len(entry.value) for entry in model.metadata_props) > _MOST_METADATA:
            raise DataError(f"ONNX model {str(path)!r}: expected at most {_MOST_METADATA:,} characters of metadata")
        slim = _without_weights(model)
        for value in slim.graph.input:  # sizes that a model leaves open follow from those of the picture
            for place, side in enumerate(value.type.tensor_type.shape.dim):
                if not side.dim_value:
                    side.dim_value = _USUAL_SIDE if place > 1 else 1
        inferred = onnx.shape_inference.infer_shapes(slim, data_prop=True).graph
    except DataError:
        raise
    except Exception as error:  # protobuf's and ONNX's own exceptions share no base class
        reason = " ".join(str(error).split())[-400:]
        raise DataError(f"cannot load the ONNX model {str(path)!r}: {reason}") from None
    values = [*inferred.value_info, *inferred.input, *inferred.output]
    _check_sizes(path, ((value.name, _dims(value)) for value in values))
    known = {
        value.name for value in values if all(each.HasField("dim_value") for each in value.type.tensor_type.shape.dim)
    }
    steps = {node.op_type for node in model.graph.node}
    made = {name for node in model.graph.node for name in node.output if name}
    return not made <= known or bool(steps & _WITH_GRAPHS) or bool(model.functions)


def check_elements(name: str, sizes: Iterable[int]) -> None:
    """Raise `DataError` for a tensor of more than `_MOST_ELEMENTS` numbers."""
    sizes = list(sizes)
    if min(sizes, default=0) < 0 or math.prod(sizes) > _MOST_ELEMENTS:
        raise DataError(f"{name}: expected at most {_MOST_ELEMENTS:,} numbers, got sizes {excerpt(sizes)}")


def check_canvas(name: str, size: tuple[int, int]) -> None:
    """Raise `DataError` for a canvas `(width, height)` of more than `_MOST_PIXELS` pixels."""
    if size[0] * size[1] > _MOST_PIXELS:
        raise DataError(f"{name}: expected a canvas of at most {_MOST_PIXELS:,} pixels, got {size[0]} x {size[1]}")


def _check_sizes(path: Path, tensors: Iterable[tuple[str, Iterable[int]]]) -> None:
    for name, dims in tensors:
        check_elements(f"ONNX model {str(path)!r}: tensor {excerpt(name)}", dims)


def _dims(value: Any) -> list[int]:
    """Sizes of a value; unknown sizes count as 1."""
    return [d.dim_value if d.HasField("dim_value") else 1 for d in value.type.tensor_type.shape.dim]


def _without_weights(model: Any) -> Any:
    """The model without its large tensors: shapes may depend on values of small tensors only."""
    import onnx

    slim = onnx.ModelProto()
    slim.CopyFrom(model)
    for tensor in slim.graph.initializer:
        if math.prod(tensor.dims) > 1024:
            slim.graph.input.append(
                onnx.helper.make_tensor_value_info(tensor.name, tensor.data_type, list(tensor.dims))
            )
    small = [tensor for tensor in slim.graph.initializer if math.prod(tensor.dims) <= 1024]
    del slim.graph.initializer[:]
    slim.graph.initializer.extend(small)
    return slim


def read_settings(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Read the settings of a model.

    Settings in `model.json` in the folder of `model.onnx` override settings in the model's metadata. The metadata of
    models that semfov or Ultralytics (class names, input size) have exported are understood.
    """
    beside = path.with_suffix(".json")
    inside = _parse(metadata[METADATA_KEY], f"metadata of {path.name}") if METADATA_KEY in metadata else {}
    outside = _parse(_read(beside), str(beside)) if beside.exists() else {}
    preprocessing = {**inside.get("preprocessing", {}), **outside.get("preprocessing", {})}
    return {**_ultralytics(metadata), **inside, **outside, "preprocessing": preprocessing}


def _read(path: Path) -> str:
    check_regular(path)
    if path.stat().st_size > _MOST_METADATA:
        raise DataError(f"{path}: expected at most {_MOST_METADATA:,} bytes, got {path.stat().st_size:,}")
    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path}: {error}") from error


def _parse(text: str, where: str) -> dict[str, Any]:
    try:
        settings = json.loads(text)
    except json.JSONDecodeError as error:
        raise DataError(f"{where}: expected JSON, got an error in line {error.lineno}: {error.msg}") from error
    except (ValueError, RecursionError):  # integers too long, lists too deep
        raise DataError(f"{where}: expected JSON, got numbers that are too long or lists that are too deep") from None
    if not isinstance(settings, dict):
        raise DataError(f"{where}: expected an object, got {excerpt(settings)}")
    unknown = sorted(set(settings) - set(_KEYS))
    if unknown:
        raise DataError(f"{where}: unknown key {', '.join(unknown)[:80]!a}; known: {', '.join(_KEYS)}")
    for key, value in settings.items():
        if not isinstance(value, _KEYS[key]):
            kinds = " or ".join(kind.__name__ for kind in _KEYS[key])
            raise DataError(f"{where}: {key}: expected {kinds}, got {excerpt(value)}")
    names, size = settings.get("classes", []), settings.get("input_size", 1)
    if not all(isinstance(name, str) and is_plain(name) for name in names):
        raise DataError(f"{where}: classes: expected names without control characters, got {excerpt(names)}")
    for number in size if isinstance(size, list) else [size]:
        if not is_number(number, whole=True):
            raise DataError(f"{where}: input_size: expected whole numbers, got {excerpt(size)}")
    return settings


def _ultralytics(metadata: Mapping[str, str]) -> dict[str, Any]:
    """Class names `{0: 'person', ...}` and input size `[height, width]` from Ultralytics' metadata."""
    settings: dict[str, Any] = {}
    try:
        if "names" in metadata:
            names = ast.literal_eval(metadata["names"])
            settings["classes"] = [names[i] for i in range(len(names))]
            if isinstance(names, str) or not all(is_plain(str(name)) for name in settings["classes"]):
                return {}
        if "imgsz" in metadata:
            height, width = ast.literal_eval(metadata["imgsz"])
            settings["input_size"] = [int(width), int(height)]
    except (ValueError, SyntaxError, TypeError, KeyError, IndexError, RecursionError, MemoryError, OverflowError):
        return {}  # keys of the same name from another exporter
    return settings


def with_input_size(path: Path, canvas: tuple[int, int]) -> Path:
    """Find a model with another input size in the cache, and make it if it is missing; canvas `(width, height)`.

    A fully convolutional network knows its input size in two places: the shape of its input, and the shapes that its
    `Reshape` nodes ask for, which end with the rows and columns of the feature maps. Both are replaced.
    """
    import onnx

    check_canvas("input_size", canvas)
    check(all(side % _COARSEST == 0 for side in canvas), "input_size", f"multiples of {_COARSEST} pixels", canvas)
    check_file(path)
    model = onnx.load(path)
    sides = model.graph.input[0].type.tensor_type.shape.dim[2:4]
    size = sides[1].dim_value, sides[0].dim_value
    if size == canvas:
        return path
    _resize(model.graph, size, canvas)
    content = model.SerializeToString()
    digest = hashlib.sha256(content).hexdigest()
    new = cache_folder() / "resized" / f"{path.stem}-{canvas[0]}x{canvas[1]}-{digest[:16]}.onnx"
    if not new.is_file() or sha256(new) != digest:
        write_bytes(new, content)
    return new


def _resize(graph: Any, size: tuple[int, int], canvas: tuple[int, int]) -> None:
    """Replace the sizes that a graph has in constants."""
    from onnx import numpy_helper

    maps = {cells(size, stride): cells(canvas, stride) for stride in STRIDES}
    shape_names = {node.input[1] for node in graph.node if node.op_type == "Reshape"}
    constants = {tensor.name: tensor for tensor in graph.initializer}
    constants |= {node.output[0]: node.attribute[0].t for node in graph.node if node.op_type == "Constant"}
    for name in shape_names & constants.keys():
        shape = numpy_helper.to_array(constants[name]).copy()
        if len(shape) > 2 and (int(shape[-1]), int(shape[-2])) in maps:
            shape[-2:] = maps[int(shape[-1]), int(shape[-2])][::-1]
            constants[name].CopyFrom(numpy_helper.from_array(shape, constants[name].name))
    sides = graph.input[0].type.tensor_type.shape.dim[2:4]
    sides[0].dim_value, sides[1].dim_value = canvas[1], canvas[0]
    del graph.value_info[:]
    for output in graph.output:
        for side in output.type.tensor_type.shape.dim[1:2]:
            side.Clear()


def network_steps(path: Path, image: str, canvas: tuple[int, int]) -> list[NetworkStep]:
    """The steps of a model in order, with the strides of the maps that follow from `image`, of `(width, height)`."""
    import onnx

    model = _without_weights(onnx.load(path, load_external_data=False))
    sides = next(value for value in model.graph.input if value.name == image).type.tensor_type.shape.dim
    for side, size in zip(sides, (1, 3, canvas[1], canvas[0]), strict=True):
        side.dim_value = size
    graph = onnx.shape_inference.infer_shapes(model, data_prop=True).graph
    shapes = {value.name: _dims(value) for value in [*graph.value_info, *graph.output]}
    steps, reached = [], {image}  # stored weights are no maps
    for node in graph.node:
        reached.update(node.output if reached.intersection(node.input) else ())
        for output in node.output:
            shape = shapes.get(output, [])
            is_map = output in reached and len(shape) == 4 and min(shape[2:]) > 1
            stride = stride_of(canvas[0], shape[3]) if is_map else None
            steps.append(NetworkStep(output, stride, tuple(node.input), node.op_type == "Conv"))
    return steps

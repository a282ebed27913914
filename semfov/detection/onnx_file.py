"""ONNX files of detectors: their settings, and copies with another input size."""

import ast
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from semfov.detection.onnx_cells import STRIDES, cells
from semfov.detection.onnx_check import check_file
from semfov.detection.weights import cache_folder
from semfov.errors import DataError, check
from semfov.io.files import read_text, sha256, write_bytes
from semfov.io.schema import Array, Flag, Json, Maybe, Number, Object, Text, check_content, is_plain

_MOST_BYTES = 2**20  # largest number of bytes of a settings file
_MOST_PIXELS = 89_478_485  # largest number of pixels of a canvas, the same as for pictures that are read
_COARSEST = 32  # pixels; maps of this stride are doubled and added to finer ones
_NAMES = "class_names", "labels", "character", "names"  # keys of metadata with names of classes, as exporters have them
METADATA_KEY = "semfov"  # key of the settings, as JSON, in the metadata of models that semfov exports

_SETTINGS = Object(
    {
        **dict.fromkeys(("name", "head", "background"), Text()),
        "classes": Array(Text()),
        "input_size": Array(Number(whole=True)),
        "stride": Maybe(Number(whole=True)),
        "logits": Flag(),
        "per_class": Flag(),
        "preprocessing": Object(others=Json()),
        **dict.fromkeys(("licence", "source"), Json()),  # for people, of any length and in lines
    }
)


def check_canvas(name: str, size: tuple[int, int]) -> None:
    """Raise `DataError` for a canvas `(width, height)` of more than `_MOST_PIXELS` pixels."""
    if size[0] * size[1] > _MOST_PIXELS:
        raise DataError(f"{name}: expected a canvas of at most {_MOST_PIXELS:,} pixels, got {size[0]} x {size[1]}")


def read_settings(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Settings in a model's metadata, by semfov or Ultralytics, overridden by those in `model.json` beside it."""
    texts = {f"metadata of {path.name}": metadata[METADATA_KEY]} if METADATA_KEY in metadata else {}
    if (beside := path.with_suffix(".json")).exists():
        texts[str(beside)] = read_text(beside, most=_MOST_BYTES)
    found, preprocessing = {**_names_in(metadata), **_ultralytics(metadata)}, dict[str, Any]()
    for where, text in texts.items():
        try:
            settings = json.loads(text)
        except (ValueError, RecursionError) as error:  # also numbers too long and lists too deep
            raise DataError(f"{where}: cannot be read as JSON ({error}); correct it") from None
        if isinstance(settings, dict) and isinstance(side := settings.get("input_size"), int):
            settings["input_size"] = [side, side]
        check_content(where, settings, _SETTINGS)
        preprocessing |= settings.get("preprocessing", {})
        found |= settings
    return {**found, "preprocessing": preprocessing}


def write_settings(path: Path, options: Mapping[str, Any]) -> Path:
    """Add options of `load_detector` to the settings in `model.json` beside an ONNX file.

    Args:
        path: the ONNX file.
        options: the options; others than the settings of such a file are left out.

    Returns:
        The file of the settings.
    """
    beside = path.with_suffix(".json")
    stored: dict[str, Any] = json.loads(read_text(beside, most=_MOST_BYTES)) if beside.exists() else {}
    chosen = {name: value for name, value in options.items() if name in _SETTINGS.keys}
    settings = {**stored, **chosen}
    if isinstance(side := settings.get("input_size"), int):
        settings["input_size"] = [side, side]
    if "preprocessing" in settings:
        settings["preprocessing"] = {**stored.get("preprocessing", {}), **chosen.get("preprocessing", {})}
    check_content(str(beside), settings, _SETTINGS)
    write_bytes(beside, f"{json.dumps(settings, indent=1, ensure_ascii=False)}\n".encode())
    return beside


def names_beside(path: Path) -> tuple[str, list[str]] | None:
    """The file beside a model that has names of classes, and the names; None where there is none.

    Args:
        path: the ONNX file, beside which there may be `data.yaml`, as of a data set for YOLO, or `classes.txt`.
    """
    for name in ("data.yaml", "classes.txt"):
        beside = path.with_name(name)
        if beside.is_file():
            text = read_text(beside, most=_MOST_BYTES)
            names = _data_names(text) if name == "data.yaml" else text.splitlines()
            names = [str(each).strip() for each in names if str(each).strip()]
            if names and all(map(is_plain, names)):
                return name, names
    return None


def _data_names(text: str) -> list[Any]:
    """The names of classes in `data.yaml`: a list, or by their numbers."""
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError):
        return []
    return _listed(content.get("names") if isinstance(content, Mapping) else None)


def _listed(names: Any) -> list[Any]:
    """Names in a list, or by numbers from 0; none where they are neither."""
    if isinstance(names, Mapping):
        by_number = {str(number): name for number, name in names.items()}
        numbers = [str(number) for number in range(len(by_number))]
        names = [by_number[number] for number in numbers] if {*numbers} == {*by_number} else []
    listed = isinstance(names, list | tuple) and all(isinstance(name, str | int) for name in names)
    return list(names) if listed else []


def _names_in(metadata: Mapping[str, str]) -> dict[str, Any]:
    """Class names in metadata under other keys than Ultralytics': a list, by numbers, or a name a line."""
    for key in _NAMES:
        text = metadata.get(key, "")
        try:
            names = _listed(ast.literal_eval(text))
        except (ValueError, SyntaxError, RecursionError, MemoryError):
            names = text.split("\n" if "\n" in text.strip() else ",")
        names = [str(name).strip() for name in names if str(name).strip()]
        if len(names) > 1 and all(map(is_plain, names)):
            return {"classes": names}
    return {}


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
    """Find a model with another input size in the cache, and make it if it is missing; canvas `(width, height)`."""
    # A fully convolutional network knows its size in the shape of its input, and in those that its `Reshape` nodes ask
    # for.
    import onnx
    from onnx import numpy_helper

    check_canvas("input_size", canvas)
    check(all(side % _COARSEST == 0 for side in canvas), "input_size", f"multiples of {_COARSEST} pixels", canvas)
    check_file(path)
    model = onnx.load(path)
    sides = model.graph.input[0].type.tensor_type.shape.dim[2:4]
    size = sides[1].dim_value, sides[0].dim_value
    if size == canvas:
        return path
    graph, maps = model.graph, {cells(size, stride): cells(canvas, stride) for stride in STRIDES}
    shape_names = {node.input[1] for node in graph.node if node.op_type == "Reshape"}
    constants = {tensor.name: tensor for tensor in graph.initializer}
    constants |= {node.output[0]: node.attribute[0].t for node in graph.node if node.op_type == "Constant"}
    for name in shape_names & constants.keys():
        shape = numpy_helper.to_array(constants[name]).copy()
        if len(shape) > 2 and (int(shape[-1]), int(shape[-2])) in maps:
            shape[-2:] = maps[int(shape[-1]), int(shape[-2])][::-1]
            constants[name].CopyFrom(numpy_helper.from_array(shape, constants[name].name))
    sides[0].dim_value, sides[1].dim_value = canvas[1], canvas[0]
    del graph.value_info[:]
    for output in graph.output:
        for side in output.type.tensor_type.shape.dim[1:2]:
            side.Clear()
    content = model.SerializeToString()
    digest = hashlib.sha256(content).hexdigest()
    new = cache_folder() / "resized" / f"{path.stem}-{canvas[0]}x{canvas[1]}-{digest[:16]}.onnx"
    if not new.is_file() or sha256(new) != digest:
        write_bytes(new, content)
    return new

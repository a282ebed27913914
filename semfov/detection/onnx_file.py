"""ONNX files of detectors: their settings, and copies with another input size."""

from __future__ import annotations

import ast
import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import yaml

from semfov.data.images import MAX_PIXELS
from semfov.detection.class_names import names_in_order
from semfov.detection.onnx_cells import STRIDES, Canvas, cells
from semfov.detection.onnx_check import check_file
from semfov.detection.scores import BackgroundPolicy
from semfov.errors import DataError, check, check_data
from semfov.io.files import JsonObject, cache_folder, read_text, sha256, write_bytes
from semfov.io.schema import Array, Flag, Json, Maybe, Number, Object, Text, check_content, is_plain

if TYPE_CHECKING:
    import onnx

_MOST_BYTES = 2**20  # largest number of bytes of a settings file
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


class OnnxSettings(TypedDict, total=False):
    """Settings of a model, each of them missing where nothing says it; they are the options of `load_onnx`."""

    name: str
    head: str
    background: BackgroundPolicy
    classes: Sequence[str]
    input_size: int | Sequence[int]
    stride: int | None
    logits: bool
    per_class: bool
    preprocessing: JsonObject
    licence: object
    source: object


def check_canvas(name: str, size: Canvas) -> None:
    """Refuse a canvas that would fill the memory.

    Args:
        name: what asks for the canvas, for the message.
        size: `(width, height)` in pixels.

    Raises:
        DataError: it has more than `MAX_PIXELS` pixels.
    """
    width, height = size
    expected = f"a canvas of at most {MAX_PIXELS:,} pixels"
    check_data(width * height <= MAX_PIXELS, name, expected, f"{width} x {height}")


def read_settings(path: Path, metadata: Mapping[str, str]) -> OnnxSettings:
    """Read the settings of a model: those of its exporter, overridden by semfov's, and these by a file beside it.

    Args:
        path: the ONNX file, beside which there may be settings in `model.json`.
        metadata: the metadata of the model: semfov's settings, or those of Ultralytics and other exporters.

    Returns:
        The settings that are there; `preprocessing` always is.

    Raises:
        DataError: semfov's settings are no JSON, or have another form.
    """
    texts = {}
    if METADATA_KEY in metadata:
        texts[f"metadata of {path.name}"] = metadata[METADATA_KEY]
    settings_file = path.with_suffix(".json")
    if settings_file.exists():
        texts[str(settings_file)] = read_text(settings_file, most=_MOST_BYTES)
    settings: OnnxSettings = {**_names_of_exporter(metadata), **_ultralytics(metadata)}
    preprocessing: JsonObject = {}
    for place, text in texts.items():
        stated = _parsed(place, text)
        preprocessing |= stated.get("preprocessing", {})
        settings |= stated
    return {**settings, "preprocessing": preprocessing}


def _parsed(place: str, text: str) -> OnnxSettings:
    """Parse and check settings in JSON; `place` is where they come from."""
    try:
        settings = json.loads(text)
    except (ValueError, RecursionError) as error:  # also numbers too long and lists too deep
        raise DataError(f"{place}: cannot be read as JSON ({error}); correct it") from None
    if isinstance(settings, dict):
        _state_both_sides(settings)
    check_content(place, settings, _SETTINGS)
    return settings


def _state_both_sides(settings: JsonObject) -> None:
    """Replace an `input_size` that is one number, as people write it, by width and height."""
    side = settings.get("input_size")
    if isinstance(side, int):
        settings["input_size"] = [side, side]


def write_settings(path: Path, options: JsonObject) -> Path:
    """Add options of `load_detector` to the settings in `model.json` beside an ONNX file.

    Args:
        path: the ONNX file.
        options: the options; others than the settings of such a file are left out.

    Returns:
        The file of the settings.
    """
    settings_file = path.with_suffix(".json")
    stored: JsonObject = {}
    if settings_file.exists():
        stored = json.loads(read_text(settings_file, most=_MOST_BYTES))
    chosen = {name: value for name, value in options.items() if name in _SETTINGS.keys}
    settings = {**stored, **chosen}
    _state_both_sides(settings)
    if "preprocessing" in settings:
        settings["preprocessing"] = {**stored.get("preprocessing", {}), **chosen.get("preprocessing", {})}
    check_content(str(settings_file), settings, _SETTINGS)
    write_bytes(settings_file, f"{json.dumps(settings, indent=1, ensure_ascii=False)}\n".encode())
    return settings_file


def names_beside(path: Path) -> list[str] | None:
    """Read names of classes from a file beside a model.

    Args:
        path: the ONNX file, beside which there may be `data.yaml`, as of a data set for YOLO, a list of names such as
            `classes.txt`, or `config.json` of `transformers`.

    Returns:
        The names; None where there is no such file.
    """
    for name, read_names in _NAMES_BESIDE.items():
        names_file = path.with_name(name)
        if not names_file.is_file():
            continue
        text = read_text(names_file, most=_MOST_BYTES)
        names = _texts(read_names(text))
        if names and all(map(is_plain, names)):
            return names
    return None


class _TextsAndNull(yaml.BaseLoader):
    """Loader of YAML that makes texts alone, of `no` and `on`, too, but for what is null: `~`, `null` and nothing."""


_NULL = "tag:yaml.org,2002:null"
_TextsAndNull.add_implicit_resolver(_NULL, re.compile("(~|null|Null|NULL|)$"), ["~", "n", "N", ""])
_TextsAndNull.add_constructor(_NULL, lambda _loader, _node: None)


def _names_in_yaml(text: str) -> list[str | int]:
    """List the names of a data set for YOLO, which are a list, or by their numbers."""
    try:
        content = yaml.load(text, _TextsAndNull)  # noqa: S506 (it makes texts alone)
    except (yaml.YAMLError, RecursionError, ValueError):
        return []
    return _names_under("names", content)


def _names_in_config(text: str) -> list[str | int]:
    """List the names of a model of `transformers`, which are by their numbers."""
    try:
        content = json.loads(text)
    except (RecursionError, ValueError):
        return []
    return _names_under("id2label", content)


def _names_under(key: str, content: object) -> list[str | int]:
    """List the names under a key of a file's content; none where it is no mapping."""
    return _listed(content.get(key)) if isinstance(content, Mapping) else []


def _names_in_lines(text: str) -> list[str]:
    """List the names of a file with a name a line, which may begin with the number of the line.

    `0: cat` is a name with its number. `1 cat` may also be a name that begins with a number, as `1 euro` does: it is
    one unless three lines or more are counted, and their names differ without the numbers, too.
    """
    lines = _texts(text.splitlines())
    numbered = list(filter(None, map(_NUMBERED.fullmatch, lines)))
    numbers = [int(match["number"]) for match in numbered]
    from_zero = list(range(len(lines)))
    from_one = list(range(1, len(lines) + 1))
    if numbers not in (from_zero, from_one):
        return lines
    marks = [match["mark"] for match in numbered]
    names = [match["name"] for match in numbered]
    are_distinct = len(set(names)) == len(names) >= _COUNTED
    return names if all(marks) or are_distinct else lines


_COUNTED = 3  # least number of lines whose numbers, with blanks after them, are those of the lines
_NUMBERED = re.compile(r"(?P<number>\d{1,6})(?:\s*(?P<mark>[:,=])|\s)\s*(?P<name>.+)")  # a name with its number

_NAMES_BESIDE: dict[str, Callable[[str], list[str | int] | list[str]]] = {
    **dict.fromkeys(("data.yaml", "data.yml"), _names_in_yaml),
    **dict.fromkeys(("classes.txt", "labels.txt", "obj.names"), _names_in_lines),
    "config.json": _names_in_config,
}
"""Files beside a model with the names of classes, in the order in which they are looked for, and how they are read."""


def _listed(names: object) -> list[str | int]:
    """List names that are in a list, or by numbers from 0; none where they are neither."""
    if isinstance(names, Mapping):
        names = names_in_order(names)
    if not isinstance(names, list | tuple):
        return []
    are_names = all(isinstance(name, str | int) for name in names)
    return list(names) if are_names else []


def _texts(names: list[str | int] | list[str]) -> list[str]:
    """Strip names, and leave out empty ones."""
    stripped = [str(name).strip() for name in names]
    return [name for name in stripped if name]


def _names_of_exporter(metadata: Mapping[str, str]) -> OnnxSettings:
    """Find class names in metadata under other keys than Ultralytics': a list, by numbers, or a name a line."""
    for key in _NAMES:
        names = _texts(_names_in_value(metadata.get(key, "")))
        # One name alone may be any text under such a key, which says nothing of classes.
        if len(names) > 1 and all(map(is_plain, names)):
            return {"classes": names}
    return {}


def _names_in_value(text: str) -> list[str | int] | list[str]:
    """List the names in a value of metadata: Python's list or dict, or names in lines or with commas."""
    try:
        return _listed(ast.literal_eval(text))
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        separator = "\n" if "\n" in text.strip() else ","
        return text.split(separator)


def _ultralytics(metadata: Mapping[str, str]) -> OnnxSettings:
    """Find class names `{0: 'person', ...}` and input size `[height, width]` in Ultralytics' metadata."""
    settings: OnnxSettings = {}
    try:
        if "names" in metadata:
            settings["classes"] = _numbered_names(metadata["names"])
        if "imgsz" in metadata:
            height, width = ast.literal_eval(metadata["imgsz"])
            settings["input_size"] = [int(width), int(height)]
    except (ValueError, SyntaxError, TypeError, KeyError, IndexError, RecursionError, MemoryError, OverflowError):
        return {}  # keys of the same name from another exporter
    return settings


def _numbered_names(text: str) -> list[str]:
    """Read a dict of names by number, or a list; raises `ValueError` and others for any other value."""
    names = ast.literal_eval(text)
    listed = [names[number] for number in range(len(names))]
    are_names = all(is_plain(str(name)) for name in listed)
    if isinstance(names, str) or not are_names:
        raise ValueError("expected names by number")
    return listed


def with_input_size(path: Path, canvas: Canvas) -> Path:
    """Find a model with another input size in the cache, and make it if it is missing.

    A fully convolutional network knows its size in the shape of its input, and in those that its `Reshape` nodes ask
    for.

    Args:
        path: the ONNX file of such a network, with a fixed input size.
        canvas: the new `(width, height)` in pixels.

    Returns:
        The file of the network with this size; `path` where it has it already.

    Raises:
        InputError: the coarsest maps of the canvas would not be whole.
        DataError: the canvas is too large, or the file is damaged.
    """
    import onnx

    check_canvas("input_size", canvas)
    check(all(side % _COARSEST == 0 for side in canvas), "input_size", f"multiples of {_COARSEST} pixels", canvas)
    # Before all of its weights are read, which may be more than the memory holds.
    check_file(path)
    model = onnx.load(path)
    rows, columns = model.graph.input[0].type.tensor_type.shape.dim[2:4]  # of (B, 3, H, W)
    size = columns.dim_value, rows.dim_value
    if size == canvas:
        return path
    _resize_shapes(model.graph, size, canvas)
    columns.dim_value, rows.dim_value = canvas
    _forget_sizes(model.graph)
    content = model.SerializeToString()
    digest = hashlib.sha256(content).hexdigest()
    copy = cache_folder() / "resized" / f"{path.stem}-{canvas[0]}x{canvas[1]}-{digest[:16]}.onnx"
    if not copy.is_file() or sha256(copy) != digest:
        write_bytes(copy, content)
    return copy


def _forget_sizes(graph: onnx.GraphProto) -> None:
    """Delete what a model says of the sizes inside it, and of the number of boxes: they follow from its input."""
    del graph.value_info[:]
    for output in graph.output:
        for boxes in output.type.tensor_type.shape.dim[1:2]:  # of (B, N, …), if it is stated
            boxes.Clear()


def _resize_shapes(graph: onnx.GraphProto, size: Canvas, canvas: Canvas) -> None:
    """Replace the sizes of maps of one canvas by those of another in the constants that `Reshape` nodes read."""
    from onnx import numpy_helper

    new_sizes = {cells(size, stride): cells(canvas, stride) for stride in STRIDES}
    for tensor in _shapes_asked_for(graph):
        shape = numpy_helper.to_array(tensor).copy()
        if len(shape) <= 2:
            continue  # no map, which is `(…, rows, columns)`
        old_size = int(shape[-1]), int(shape[-2])
        if old_size in new_sizes:
            columns, rows = new_sizes[old_size]
            shape[-2:] = rows, columns
            tensor.CopyFrom(numpy_helper.from_array(shape, tensor.name))


def _shapes_asked_for(graph: onnx.GraphProto) -> list[onnx.TensorProto]:
    """List the constants that `Reshape` nodes read as the shapes of their outputs."""
    constants = {tensor.name: tensor for tensor in graph.initializer}
    shape_names: set[str] = set()
    for node in graph.node:
        if node.op_type == "Constant":
            constants[node.output[0]] = node.attribute[0].t
        if node.op_type == "Reshape":
            shape_names.add(node.input[1])
    return [constants[name] for name in shape_names & constants.keys()]

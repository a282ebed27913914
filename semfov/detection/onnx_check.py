"""Checks of ONNX files before onnxruntime opens them: their files, their functions, and what a pass takes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from os.path import getsize
from pathlib import Path
from typing import TYPE_CHECKING

from semfov.detection.onnx_budget import Budget, check_elements, graphs
from semfov.errors import DataError, check_data, reason_of
from semfov.io.files import inside, reading
from semfov.io.schema import excerpt

if TYPE_CHECKING:
    from google.protobuf.message import Message
    from onnx import ModelProto, NodeProto, TensorProto

_MOST_METADATA = 2**20  # largest number of characters of a model's metadata
_MOST_TENSORS = 2**16  # stored in a model, also in its nodes; detectors have thousands
_MOST_FUNCTIONS = 2**12  # of a model's own; exporters write one for each kind of layer
_MOST_PORTS = 2**10  # inputs and outputs, beside inputs that are stored as older models have them
_MOST_NODES = 2**14  # after functions of the model are put where they are called
_MOST_REASON = 400  # largest number of characters of a reason that a message has
_HOLDERS = {f"{kind}Proto" for kind in ("Graph", "Function", "Node", "Attribute", "SparseTensor", "Tensor")}
"""Messages of protobuf that hold tensors, perhaps at some depth."""

USUAL = 640, 640  # sides of a picture with which open sizes are tried out

_Function = tuple[str, str]  # domain and name


def check_file(path: Path, canvas: tuple[int, int] = USUAL) -> bool:
    """Check a model without computing any of it.

    Args:
        path: the ONNX file.
        canvas: `(width, height)` of the image that a pass is tried out for, if the model takes any.

    Returns:
        Whether a pass is open-ended: nothing in the file says that it ends soon.

    Raises:
        DataError: the file cannot be read, or a pass takes more than a model of its size may.
    """
    import onnx

    name = f"ONNX model {str(path)!r}"
    with reading(path, name):
        path.stat()
    try:
        return _check_model(onnx.load(path, load_external_data=False), path, canvas, name)
    except DataError:
        raise
    except Exception as error:  # protobuf's and ONNX's own exceptions share no base class
        reason = reason_of(error)[-_MOST_REASON:]
        raise DataError(f"cannot load the {name}: {reason}") from None


def _check_model(model: ModelProto, path: Path, canvas: tuple[int, int], name: str) -> bool:
    """Check what `check_file` has read; what later steps go through is counted by earlier ones."""
    _check_count(name, len(model.functions), _MOST_FUNCTIONS, "functions")
    stored = [*_tensors(model)]
    _check_count(name, len(stored), _MOST_TENSORS, "stored tensors")
    ports = len(model.graph.input) + len(model.graph.output)
    _check_count(name, ports, _MOST_PORTS + len(stored), "inputs and outputs")
    # A set, as many tensors may lie in one file, whose bytes count once.
    files = {path, *_files_of_weights(path.parent, stored)}
    for tensor in stored:
        check_elements(f"{name}: tensor {excerpt(tensor.name)}", tensor.dims)
    length = sum(len(entry.key) + len(entry.value) for entry in model.metadata_props)
    _check_count(name, length, _MOST_METADATA, "characters of metadata")

    budget = Budget.of(_without_functions(model, name), canvas, name)
    on_disk = sum(map(getsize, files))
    budget.check(on_disk)
    return budget.is_open(on_disk)


def _check_count(name: str, count: int, most: int, what: str) -> None:
    """Raise `DataError` if a model has too many of something."""
    check_data(count <= most, name, f"at most {most:,} {what}", f"{count:,}")


def stored_bytes(path: Path) -> int:
    """Sum the bytes of a model's files.

    Args:
        path: the ONNX file, which was checked.

    Returns:
        The bytes, with those of files of weights beside it.
    """
    import onnx

    stored = _tensors(onnx.load(path, load_external_data=False))
    return sum(map(getsize, {path, *_files_of_weights(path.parent, stored)}))


def _tensors(message: Message) -> Iterator[TensorProto]:
    """List the stored tensors in a part of a model, at any depth; a sparse one also with its whole size."""
    import onnx

    if isinstance(message, onnx.TensorProto):
        yield message
        return
    if isinstance(message, onnx.SparseTensorProto):
        yield onnx.TensorProto(name=message.values.name, dims=message.dims)
    for part in _parts(message):
        yield from _tensors(part)


def _parts(message: Message) -> Iterator[Message]:
    """List the parts of a part of a model that hold tensors."""
    for field, value in message.ListFields():
        if field.message_type is None or field.message_type.name not in _HOLDERS:
            continue
        if hasattr(value, "ListFields"):
            yield value
        else:  # the field is repeated
            yield from value


def places_of_weights(tensors: Iterable[TensorProto]) -> set[str]:
    """Name the files, relative to that of the model, which hold weights that are not in the model's own.

    Args:
        tensors: the stored tensors of the model.

    Returns:
        The names.
    """
    places: set[str] = set()
    for tensor in tensors:
        # Where, at which offset and how long: entries by key (ONNX IR, external tensor data).
        places.update(entry.value for entry in tensor.external_data if entry.key == "location")
    return places


def _files_of_weights(folder: Path, stored: Iterable[TensorProto]) -> Iterator[Path]:
    """List the files of weights beside a model, which must lie in its folder."""
    for place in places_of_weights(stored):
        file = inside(folder, place)
        with reading(file):
            file.stat()
        # With a star in its name, onnxruntime takes the place in the file for one in its memory.
        check_data("*" not in place, folder, "a name without * for a file of weights", excerpt(place))
        yield file


def _without_functions(model: ModelProto, name: str) -> ModelProto:
    """Put the functions of a model where they are called, unless these would be too many nodes."""
    import onnx.inliner

    nodes = _NodeCounter(model, name).count(model.graph.node)
    _check_count(name, nodes, _MOST_NODES, "nodes")
    return onnx.inliner.inline_local_functions(model) if model.functions else model


class _NodeCounter:
    """A counter of the nodes that a model has once its functions are put where they are called.

    Private attributes: `_bodies` has the nodes of each function, and `_counts` how many they become. Each function is
    counted once, as functions that call each other twice grow exponentially.
    """

    def __init__(self, model: ModelProto, name: str) -> None:
        self._name = name
        self._bodies = {(function.domain, function.name): function.node for function in model.functions}
        self._counts: dict[_Function, int] = {}

    def count(self, nodes: Iterable[NodeProto], callers: tuple[_Function, ...] = ()) -> int:
        """Count what nodes become in functions that call each other; raises `DataError` for one that calls itself."""
        total = 0
        for node in nodes:
            function = node.domain, node.op_type
            got = f"{excerpt(node.op_type)}, which calls itself"
            check_data(function not in callers, self._name, "functions that end", got)
            # One call of Python for each function in another: its depth is limited.
            if function in self._bodies and function not in self._counts:
                self._counts[function] = self.count(self._bodies[function], (*callers, function))
            total += self._counts.get(function, 1)  # an operation of ONNX itself stays one node
            total += sum(self.count(graph.node, callers) for graph in graphs(node))
        return total

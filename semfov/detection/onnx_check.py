"""Checks of ONNX files before onnxruntime opens them: their files, their functions, and what a pass takes."""

from collections.abc import Iterable, Iterator
from os.path import getsize
from pathlib import Path
from typing import Any

from semfov.detection.onnx_budget import Budget, check_elements, graphs
from semfov.errors import DataError, check_data
from semfov.io.files import inside, reading
from semfov.io.schema import excerpt

_MOST_METADATA = 2**20  # largest number of characters of a model's metadata
_MOST_NODES = 2**16  # after functions of the model are put where they are called
_HOLDERS = {f"{kind}Proto" for kind in ("Graph", "Function", "Node", "Attribute", "SparseTensor", "Tensor")}
USUAL = 640, 640  # sides of a picture with which open sizes are tried out


def check_file(path: Path, canvas: tuple[int, int] = USUAL) -> bool:
    """Check a model without computing any of it, for one image of a canvas `(width, height)` if it takes any.

    Returns:
        whether its sizes or its work remain open, as they depend on values.
    """
    import onnx

    name = f"ONNX model {str(path)!r}"
    with reading(path, name):
        path.stat()
    try:
        model = onnx.load(path, load_external_data=False)
        stored = [*_tensors(model)]
        others = {*_other_files(path.parent, stored)}
        for tensor in stored:
            check_elements(f"{name}: tensor {excerpt(tensor.name)}", tensor.dims)
        length = sum(len(entry.key) + len(entry.value) for entry in model.metadata_props)
        check_data(length <= _MOST_METADATA, name, f"at most {_MOST_METADATA:,} characters of metadata", f"{length:,}")
        budget = Budget.of(_without_functions(model, name), canvas, name)
        budget.check(sum(map(getsize, {path, *others})))
        return budget.is_open()
    except DataError:
        raise
    except Exception as error:  # protobuf's and ONNX's own exceptions share no base class
        reason = " ".join(str(error).split())[-400:]
        raise DataError(f"cannot load the {name}: {reason}") from None


def _tensors(message: Any) -> Iterator[Any]:
    """All stored tensors in a part of a model, at any depth; a sparse one also with its whole size."""
    import onnx

    if isinstance(message, onnx.TensorProto):
        yield message
        return
    if isinstance(message, onnx.SparseTensorProto):
        yield onnx.TensorProto(name=message.values.name, dims=message.dims)
    for field, value in message.ListFields():
        if field.message_type is not None and field.message_type.name in _HOLDERS:
            for part in [value] if hasattr(value, "ListFields") else value:
                yield from _tensors(part)


def _other_files(folder: Path, stored: Iterable[Any]) -> Iterator[Path]:
    """The files of weights beside a model, which must lie in its folder."""
    for place in {entry.value for tensor in stored for entry in tensor.external_data if entry.key == "location"}:
        file = inside(folder, place)
        with reading(file):
            file.stat()
        # With a star in its name, onnxruntime takes the place in the file for one in its memory.
        check_data("*" not in place, folder, "a name without * for a file of weights", excerpt(place))
        yield file


def _without_functions(model: Any, name: str) -> Any:
    """The model with its own functions put where they are called, unless these would be too many nodes."""
    import onnx
    import onnx.inliner

    bodies = {(each.domain, each.name): each.node for each in model.functions}
    counts: dict[tuple[str, str], int] = {}

    def count(nodes: Iterable[Any], calling: tuple[tuple[str, str], ...] = ()) -> int:
        total = 0
        for node in nodes:
            key = node.domain, node.op_type
            check_data(key not in calling, name, "functions that end", f"{excerpt(node.op_type)}, which calls itself")
            if key in bodies and key not in counts:
                counts[key] = count(bodies[key], (*calling, key))
            total += counts.get(key, 1) + sum(count(graph.node, calling) for graph in graphs(node))
        return total

    nodes = count(model.graph.node)
    check_data(nodes <= _MOST_NODES, name, f"at most {_MOST_NODES:,} nodes", f"{nodes:,}")
    return onnx.inliner.inline_local_functions(model) if model.functions else model

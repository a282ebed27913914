"""Checks of an ONNX file before memory is allocated for it."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from semfov.errors import DataError
from semfov.io.files import check_regular, inside
from semfov.io.schema import excerpt

MOST_ELEMENTS = 2**28
"""Largest number of elements of a tensor in a model; 1 GiB as float32."""
MOST_METADATA = 2**20
"""Largest number of characters of a model's metadata."""
MOST_BATCH = 1024
"""Largest fixed batch size of a model."""
MOST_PIXELS = 89_478_485
"""Largest number of pixels of a canvas, the same as for pictures that are read."""


def check_file(path: Path) -> None:
    """Check that a model's tensors are not too large, and that files with weights are inside its folder.

    The sizes are read from the file and inferred by ONNX's shape inference; nothing is run.

    Args:
        path: the file.

    Raises:
        DataError: a tensor is too large, a file with weights is outside the folder, or the file is damaged.
    """
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
        if sum(len(entry.key) + len(entry.value) for entry in model.metadata_props) > MOST_METADATA:
            raise DataError(f"ONNX model {str(path)!r}: expected at most {MOST_METADATA:,} characters of metadata")
        inferred = onnx.shape_inference.infer_shapes(_without_weights(model), data_prop=True).graph
    except DataError:
        raise
    except Exception as error:  # protobuf's and ONNX's own exceptions share no base class
        reason = " ".join(str(error).split())[:200]
        raise DataError(f"cannot load the ONNX model {str(path)!r}: {reason}") from None
    values = [*inferred.value_info, *inferred.input, *inferred.output]
    _check_sizes(path, ((value.name, _dims(value)) for value in values))


def check_elements(name: str, sizes: Iterable[int]) -> None:
    """Raise `DataError` for a tensor of more than `MOST_ELEMENTS` numbers."""
    sizes = list(sizes)
    if min(sizes, default=0) < 0 or math.prod(sizes) > MOST_ELEMENTS:
        raise DataError(f"{name}: expected at most {MOST_ELEMENTS:,} numbers, got sizes {excerpt(sizes)}")


def check_canvas(name: str, size: tuple[int, int]) -> None:
    """Raise `DataError` for a canvas `(width, height)` of more than `MOST_PIXELS` pixels."""
    if size[0] * size[1] > MOST_PIXELS:
        raise DataError(f"{name}: expected a canvas of at most {MOST_PIXELS:,} pixels, got {size[0]} x {size[1]}")


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

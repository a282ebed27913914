"""Another input size for an ONNX model that was exported with a fixed one."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semfov.detection.onnx_file import check_canvas, check_file
from semfov.detection.onnx_heads import cells
from semfov.detection.weights import cache_folder
from semfov.errors import check
from semfov.io.files import replacing, sha256

_COARSEST = 32  # pixels; maps of this stride are doubled and added to finer ones


def with_input_size(path: Path, canvas: tuple[int, int], strides: Sequence[int]) -> Path:
    """Find a model with another input size in the cache, and make it if it is missing.

    A fully convolutional network knows its input size in two places: the shape of its input, and the shapes that its
    `Reshape` nodes ask for, which end with the rows and columns of the feature maps. Both are replaced.

    Args:
        path: the model.
        canvas: `(width, height)` of the new input, in pixels.
        strides: pixels per cell of each level of feature maps.

    Returns:
        The path of the model with this size; `path` itself if it has this size already.

    Raises:
        InputError: a side is not a multiple of 32 pixels.
        DataError: the model is damaged, or the new one cannot be written.
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
    _resize(model.graph, size, canvas, strides)
    content = model.SerializeToString()
    digest = hashlib.sha256(content).hexdigest()
    new = cache_folder() / "resized" / f"{path.stem}-{canvas[0]}x{canvas[1]}-{digest[:16]}.onnx"
    if not new.is_file() or sha256(new) != digest:
        with replacing(new) as temporary:
            temporary.write_bytes(content)
    return new


def _resize(graph: Any, size: tuple[int, int], canvas: tuple[int, int], strides: Sequence[int]) -> None:
    """Replace the sizes that a graph has in constants."""
    from onnx import numpy_helper

    maps = {cells(size, stride): cells(canvas, stride) for stride in strides}
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

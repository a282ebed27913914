"""What a pass of an ONNX model takes, told from sizes alone: the bytes of its tensors together, and its work."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeVar, cast

from semfov.errors import check_data
from semfov.io.schema import excerpt

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, NodeProto, ValueInfoProto

_MOST_ELEMENTS = 2**28  # largest number of elements of a tensor in a model; 1 GiB as float32
_MOST_LENGTH = 2**12  # largest length of a shape that is computed from others
_SMALL = 2**10  # elements of a tensor on whose values shapes may depend

_USUAL = frozenset(
    (
        *("Abs", "Add", "And", "ArgMax", "ArgMin", "AveragePool", "BatchNormalization", "Cast", "Ceil", "Clip"),
        *("Concat", "Constant", "ConstantOfShape", "Conv", "ConvInteger", "ConvTranspose", "Cos", "CumSum"),
        *("DepthToSpace", "DequantizeLinear", "Div", "Dropout", "DynamicQuantizeLinear", "Einsum", "Elu", "Equal"),
        *("Erf", "Exp", "Expand", "Flatten", "Floor", "Gather", "GatherElements", "GatherND", "Gelu", "Gemm"),
        *("GlobalAveragePool", "GlobalMaxPool", "Greater", "GreaterOrEqual", "GridSample", "GRU", "HardSigmoid"),
        *("HardSwish", "Identity", "InstanceNormalization", "LayerNormalization", "LeakyRelu", "Less", "LessOrEqual"),
        *("Log", "LogSoftmax", "LSTM", "MatMul", "MatMulInteger", "Max", "MaxPool", "Mean", "Min", "Mish", "Mod"),
        *("Mul", "Neg", "Not", "OneHot", "Or", "Pad", "Pow", "PRelu", "QLinearConv", "QLinearMatMul"),
        *("QuantizeLinear", "Range", "Reciprocal", "ReduceL2", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceProd"),
        *("ReduceSum", "ReduceSumSquare", "Relu", "Reshape", "Resize", "RNN", "Round", "ScatterElements"),
        *("ScatterND", "Selu", "Shape", "Sigmoid", "Sign", "Sin", "Size", "Slice", "Softmax", "Softplus"),
        *("SpaceToDepth", "Split", "Sqrt", "Squeeze", "Sub", "Sum", "Tanh", "Tile", "TopK", "Transpose", "Trilu"),
        *("Unsqueeze", "Upsample", "Where", "Xor"),
    )
)
"""Operations of networks whose time follows from sizes.

Each takes at most about 25 ns for a number that it reads or writes, and less than one for each multiplication that is
counted, on one core. Others, such as those with inner graphs, of text, or with a search in them, are open-ended.
"""

_OF_SHAPES = frozenset(
    ("Concat", "Gather", "Slice", "Cast", "Squeeze", "Unsqueeze", "Identity", "Add", "Sub", "Mul", "Div", "Neg")
)
"""Operations through which shape inference follows the values of shapes."""

_LENGTHS = {"Shape": 8, "Constant": _SMALL, "Range": math.inf}  # of what such operations make

_Sizes = tuple[int, ...]
_Value = TypeVar("_Value")


class _Limit(NamedTuple):
    """The most that a model may take: of any model, and more for each byte of its files."""

    base: int
    per_byte: int

    def of(self, stored: int) -> int:
        """Compute the limit of a model with so many bytes in its files."""
        return self.base + self.per_byte * stored


_MOST_BYTES = _Limit(2**27, 2**8)  # of tensors that are not stored
_SURE_PRODUCTS = _Limit(2**32, 2**12)  # multiplications of a pass that surely ends in seconds
_SURE_NUMBERS = _Limit(2**28, 2**4)  # that such a pass reads or writes
_SURE_NODES = 2**12  # that onnxruntime surely arranges in seconds


@dataclass(frozen=True)
class Budget:
    """The nodes of a model without functions, and the sizes of its tensors as far as they are known.

    Attributes:
        name: what messages call the model.
        graph: the nodes, and what is stored.
        sizes: shapes by name, of the tensors whose sizes do not depend on values.
        widths: bytes of an element, of the same tensors.
    """

    name: str
    graph: GraphProto
    sizes: Mapping[str, _Sizes]
    widths: Mapping[str, int]

    @staticmethod
    def of(model: ModelProto, canvas: tuple[int, int], name: str) -> Budget:
        """Infer the sizes of tensors for one image.

        Args:
            model: a model without functions.
            canvas: `(width, height)` of the image, where the model takes any.
            name: what messages call the model.

        Returns:
            The sizes. What the model states itself is not believed.

        Raises:
            DataError: a tensor is too large.
        """
        import onnx

        slim = without_weights(model)
        _forget_stated_sizes(slim.graph, canvas)
        # Inference follows the values of shapes one by one, also where a model lets them grow without an end.
        is_short = _longest_shape(slim.graph, {}) <= _MOST_LENGTH
        inferred = onnx.shape_inference.infer_shapes(slim, data_prop=is_short).graph
        sizes: dict[str, _Sizes] = {}
        widths: dict[str, int] = {}
        for value in (*inferred.value_info, *inferred.input, *inferred.output):
            stated = dims(value)
            check_elements(f"{name}: tensor {excerpt(value.name)}", stated)
            if _has_known_sizes(value):
                sizes[value.name] = tuple(stated)
                widths[value.name] = _width(value.type.tensor_type.elem_type)
        for tensor in inferred.initializer:
            sizes[tensor.name] = tuple(tensor.dims)
            widths[tensor.name] = _width(tensor.data_type)
        for sparse in model.graph.sparse_initializer:
            # Its values are those that are not 0; a node that reads it reads them all.
            sizes[sparse.values.name] = tuple(sparse.dims)
            widths[sparse.values.name] = _width(sparse.values.data_type)
        return Budget(name, model.graph, sizes, widths)

    def check(self, stored: int) -> None:
        """Check the memory that a pass takes.

        Args:
            stored: bytes of the model's files.

        Raises:
            DataError: it takes more than a model with such files may.
        """
        most, got = _MOST_BYTES.of(stored), self.bytes()
        expected = f"at most {most:,} bytes of tensors together, for {stored:,} stored"
        check_data(got <= most, self.name, expected, f"{got:,}; give a smaller input_size, or replace the file")

    def is_open(self, stored: int) -> bool:
        """Tell whether nothing in the file says that a pass ends soon.

        Args:
            stored: bytes of the model's files.

        Returns:
            Whether sizes depend on values, time on other things than sizes, or a pass is long.
        """
        if len(self.graph.node) > _SURE_NODES:
            return True
        for node in self.graph.node:
            if not self._is_usual(node) or any(output and output not in self.sizes for output in node.output):
                return True
        products = sum(map(self._products, self.graph.node))
        numbers = sum(map(self._numbers, self.graph.node))
        return products > _SURE_PRODUCTS.of(stored) or numbers > _SURE_NUMBERS.of(stored)

    def _is_usual(self, node: NodeProto) -> bool:
        """Tell whether the time of an operation follows from sizes."""
        import onnx

        if node.op_type not in _USUAL or node.domain not in ("", "ai.onnx"):
            return False
        if node.op_type == "Cast":
            return _attribute(node, "to", onnx.TensorProto.FLOAT) != onnx.TensorProto.STRING
        if node.op_type == "Resize":
            return _attribute(node, "mode", b"nearest") != b"cubic"
        # Of more than two, results between them may be larger than all that is known.
        return node.op_type != "Einsum" or len(node.input) <= 2

    def bytes(self) -> int:
        """Sum the bytes of all tensors that follow from stored ones, and the most bytes of the others at any one time.

        onnxruntime computes the former once, and keeps them all until it has done so.
        """
        last_readers = self._last_readers()
        stored = {tensor.name for tensor in self.graph.initializer}
        sparse = {tensor.values.name for tensor in self.graph.sparse_initializer}
        of_image = {value.name for value in self.graph.input} - stored - sparse
        constant = sum(map(self._bytes, sparse))
        now = sum(map(self._bytes, of_image))
        most = now
        released: Counter[int] = Counter()  # bytes by the place of the node after which nothing reads them
        for place, node in enumerate(self.graph.node):
            new = sum(map(self._bytes, node.output))
            if of_image.isdisjoint(_read(node)):
                constant += new
                continue
            of_image.update(node.output)
            for output in node.output:
                end = last_readers.get(output, place)
                released[end] += self._bytes(output)
            now += new
            most = max(most, now + self._workspace(node))
            now -= released[place]
        return constant + most

    def _last_readers(self) -> dict[str, int]:
        """Find the place of the last node that reads each tensor; outputs of the model are read after all nodes."""
        nodes = self.graph.node
        last_readers: dict[str, int] = {}
        for place, node in enumerate(nodes):
            last_readers.update(dict.fromkeys(_read(node), place))
        last_readers.update({output.name: len(nodes) for output in self.graph.output})
        return last_readers

    def _bytes(self, name: str) -> int:
        """Compute the bytes of a tensor; 0 where its sizes are unknown."""
        return math.prod(self.sizes[name]) * self.widths[name] if name in self.sizes else 0

    def _workspace(self, node: NodeProto) -> int:
        """Compute the bytes that a transposed convolution makes of its input before it sums: all weights a place."""
        inputs = node.input[:2]
        are_known = self.sizes.keys() >= {*inputs}
        if node.op_type != "ConvTranspose" or not are_known:
            return 0
        # Image `(B, C, H, W)`, weights `(C, M, h, w)`.
        image, weights = (self.sizes[name] for name in inputs)
        places = math.prod(image[2:])
        numbers_a_place = math.prod(weights[1:])
        return places * numbers_a_place * self.widths[inputs[0]]

    def _products(self, node: NodeProto) -> int:
        """Count the multiplications of a node with products of matrices, those of numbers of 8 bytes eight times."""
        products = _PRODUCTS.get(node.op_type)
        names = [name for name in (*node.input, *node.output) if name]
        if products is None or not self.sizes.keys() >= {*names}:
            return 0
        inputs = [self.sizes.get(name, ()) for name in node.input]
        slowness = 8 if self.widths[node.input[0]] == 8 else 1
        return slowness * products(node, inputs, self.sizes[node.output[0]])

    def _numbers(self, node: NodeProto) -> int:
        """Count the numbers that a node reads and writes, also those of a pool's kernel and between two steps."""
        names = [name for name in (*node.input, *node.output) if name in self.sizes]
        numbers = sum(math.prod(self.sizes[name]) for name in names)
        if node.op_type in ("MaxPool", "AveragePool") and node.output[0] in self.sizes:
            kernel = math.prod(_attribute(node, "kernel_shape", ()))
            comparisons = math.prod(self.sizes[node.output[0]]) * kernel
            numbers += comparisons // 16  # each takes less time than a number
        workspace = self._workspace(node)
        if workspace:
            numbers += workspace // self.widths[node.input[0]]
        return numbers


def _forget_stated_sizes(graph: GraphProto, canvas: tuple[int, int]) -> None:
    """Give inputs the sizes of one image `(width, height)` where they are open, and delete those of all else."""
    for value in graph.input:
        kind = value.type.tensor_type
        rank = len(kind.shape.dim)
        usual = (1, 3, canvas[1], canvas[0]) if rank == 4 else (1,) * rank
        for side, size in zip(kind.shape.dim, usual, strict=True):
            side.dim_value = side.dim_value or size
    for value in graph.output:
        if value.type.HasField("tensor_type"):
            value.type.tensor_type.ClearField("shape")
    del graph.value_info[:]


# Multiplications of a node, by its attributes, the sizes of its inputs and those of its output.
_Products = Callable[["NodeProto", list[_Sizes], _Sizes], int]


def _of_matrices(_: NodeProto, inputs: list[_Sizes], output: _Sizes) -> int:
    """Count a column of the second matrix for each element of the result."""
    second = inputs[1]
    columns = output[-1] if len(second) > 1 and output else 1
    return math.prod(output) * math.prod(second[-2:]) // max(columns, 1)


def _of_quantised_matrices(node: NodeProto, inputs: list[_Sizes], output: _Sizes) -> int:
    """Count as for matrices; after each of them stand its scale and its zero."""
    return _of_matrices(node, [inputs[0], inputs[3]], output)


def _of_convolution(_: NodeProto, inputs: list[_Sizes], output: _Sizes) -> int:
    """Count the weights of a filter for each element of the result."""
    return math.prod(output) * math.prod(inputs[1][1:])


def _of_quantised_convolution(_: NodeProto, inputs: list[_Sizes], output: _Sizes) -> int:
    """Count as for a convolution; its weights come after the scale and the zero of the input."""
    return math.prod(output) * math.prod(inputs[3][1:])


def _of_transposed_convolution(_: NodeProto, inputs: list[_Sizes], output: _Sizes) -> int:
    """Count the weights of a filter for each element of the input."""
    return math.prod(inputs[0]) * math.prod(inputs[1][1:])


def _of_steps(_: NodeProto, inputs: list[_Sizes], output: _Sizes) -> int:
    """Count all weights of a recurrent layer for each step of each item."""
    return math.prod(inputs[0][:2]) * (math.prod(inputs[1]) + math.prod(inputs[2]))


def _of_sums(node: NodeProto, inputs: list[_Sizes], output: _Sizes) -> int:
    """Multiply the sides that the letters of an `Einsum` stand for; all sides where it has an ellipsis."""
    equation = _attribute(node, "equation", b"").decode().replace(" ", "")
    if "." in equation:
        return math.prod(map(math.prod, inputs))
    terms = equation.partition("->")[0].split(",")
    sides: dict[str, int] = {}
    for term, sizes in zip(terms, inputs, strict=True):
        for letter, size in zip(term, sizes, strict=True):
            sides[letter] = max(size, sides.get(letter, size))  # a side of 1 is repeated
    return math.prod(sides.values())


_PRODUCTS: dict[str, _Products] = {
    **dict.fromkeys(("MatMul", "Gemm", "MatMulInteger"), _of_matrices),
    "QLinearMatMul": _of_quantised_matrices,
    **dict.fromkeys(("Conv", "ConvInteger"), _of_convolution),
    "QLinearConv": _of_quantised_convolution,
    "ConvTranspose": _of_transposed_convolution,
    **dict.fromkeys(("RNN", "GRU", "LSTM"), _of_steps),
    "Einsum": _of_sums,
}
"""Multiplications of the operations with products of matrices."""


def _attribute(node: NodeProto, name: str, otherwise: _Value) -> _Value:
    """Read an attribute of a node, or a value of the same type for nodes without it."""
    import onnx

    for attribute in node.attribute:
        if attribute.name == name:
            return cast(_Value, onnx.helper.get_attribute_value(attribute))
    return otherwise


def graphs(node: NodeProto) -> Iterator[GraphProto]:
    """List the graphs that a node has of its own, such as the branches of an `If`.

    Args:
        node: the node.

    Returns:
        The graphs.
    """
    for attribute in node.attribute:
        if attribute.HasField("g"):
            yield attribute.g
        yield from attribute.graphs


def _read(node: NodeProto) -> Iterator[str]:
    """List the names that a node reads, also in its own graphs."""
    yield from (name for name in node.input if name)
    for graph in graphs(node):
        for inner in graph.node:
            yield from _read(inner)


def _longest_shape(graph: GraphProto, lengths: dict[str, float]) -> float:
    """Find the largest length of a shape that inference may follow; `lengths` has those of tensors around the graph."""
    # Shapes that are joined to themselves again and again grow without an end, and a `Range` is computed one by one.
    lengths |= {tensor.name: math.prod(tensor.dims) for tensor in graph.initializer}
    longest = 0.0
    for node in graph.node:
        inputs = [lengths.get(name, 0) for name in node.input]
        length = _LENGTHS.get(node.op_type, 0.0)
        if node.op_type in _OF_SHAPES:
            length = sum(inputs) if node.op_type == "Concat" else max(inputs, default=0)
        lengths |= dict.fromkeys(node.output, length)
        longest = max(longest, length, *(_longest_shape(inner, lengths) for inner in graphs(node)))
    return longest


def check_elements(name: str, sizes: Iterable[int]) -> None:
    """Refuse a tensor that would fill the memory.

    Args:
        name: what messages call the tensor.
        sizes: its shape.

    Raises:
        DataError: it has more than `_MOST_ELEMENTS` numbers.
    """
    sizes = list(sizes)
    valid = min(sizes, default=0) >= 0 and math.prod(sizes) <= _MOST_ELEMENTS
    check_data(valid, name, f"at most {_MOST_ELEMENTS:,} numbers", f"sizes {excerpt(sizes)}")


def dims(value: ValueInfoProto) -> list[int]:
    """List the sizes of a value.

    Args:
        value: what a model says of one of its tensors.

    Returns:
        The sizes; unknown ones count as 1.
    """
    return [side.dim_value if side.HasField("dim_value") else 1 for side in value.type.tensor_type.shape.dim]


def _has_known_sizes(value: ValueInfoProto) -> bool:
    """Tell whether a tensor has a shape, and all its sizes are numbers."""
    kind = value.type.tensor_type
    return kind.HasField("shape") and all(side.HasField("dim_value") for side in kind.shape.dim)


def _width(kind: int) -> int:
    """Find the bytes of an element; of a text, those of an empty one, and of an unknown kind, the most of a number."""
    import onnx

    if kind == onnx.TensorProto.UNDEFINED:
        return 16
    if kind == onnx.TensorProto.STRING:
        return 32
    return onnx.helper.tensor_dtype_to_np_dtype(kind).itemsize


def without_weights(model: ModelProto) -> ModelProto:
    """Copy a model without its large tensors, as shapes may depend on values of small tensors only.

    Args:
        model: the model.

    Returns:
        The copy, with inputs instead of the large tensors.
    """
    import onnx

    slim = onnx.ModelProto()
    slim.CopyFrom(model)
    stored = [*slim.graph.initializer]
    del slim.graph.initializer[:]
    for tensor in stored:
        if math.prod(tensor.dims) <= _SMALL:
            slim.graph.initializer.append(tensor)
        else:
            shape = onnx.helper.make_tensor_value_info(tensor.name, tensor.data_type, list(tensor.dims))
            slim.graph.input.append(shape)
    return slim

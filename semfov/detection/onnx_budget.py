"""Memory and work of a pass of an ONNX model, estimated from the sizes of its tensors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeVar, cast

from semfov.detection.onnx_input import layout_of, sizes_of_image
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


class _Tensor(NamedTuple):
    """A tensor whose sizes are known: its shape, and the bytes of an element."""

    sizes: _Sizes
    width: int

    @staticmethod
    def of(sizes: Iterable[int], kind: int) -> _Tensor:
        """Describe a tensor by its shape and its kind in ONNX."""
        return _Tensor(tuple(sizes), _width(kind))

    @property
    def numbers(self) -> int:
        """Number of its elements."""
        return math.prod(self.sizes)

    @property
    def bytes(self) -> int:
        """Bytes of all its elements."""
        return self.numbers * self.width


@dataclass(frozen=True)
class Budget:
    """The nodes of a model without functions, and the sizes of its tensors as far as they are known.

    Attributes:
        name: what messages call the model.
        graph: the nodes, and what is stored.
        tensors: by name, the tensors whose sizes do not depend on values.
    """

    name: str
    graph: GraphProto
    tensors: Mapping[str, _Tensor]

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
        _fix_input_sizes(slim.graph, canvas)
        _forget_stated_sizes(slim.graph)
        # Inference follows the values of shapes one by one, also where a model lets them grow without an end.
        is_short = _longest_shape(slim.graph, {}) <= _MOST_LENGTH
        inferred = onnx.shape_inference.infer_shapes(slim, data_prop=is_short).graph
        tensors: dict[str, _Tensor] = {}
        for value in (*inferred.value_info, *inferred.input, *inferred.output):
            sizes = dims(value)
            check_elements(f"{name}: tensor {excerpt(value.name)}", sizes)
            if _has_known_sizes(value):
                tensors[value.name] = _Tensor.of(sizes, value.type.tensor_type.elem_type)
        for stored in inferred.initializer:
            tensors[stored.name] = _Tensor.of(stored.dims, stored.data_type)
        for sparse in model.graph.sparse_initializer:
            # Its values are those that are not 0; a node that reads it reads them all.
            tensors[sparse.values.name] = _Tensor.of(sparse.dims, sparse.values.data_type)
        return Budget(name, model.graph, tensors)

    def check(self, stored: int) -> None:
        """Check the memory that a pass takes.

        Args:
            stored: bytes of the model's files.

        Raises:
            DataError: it takes more than a model with such files may.
        """
        most = _MOST_BYTES.of(stored)
        needed = self.bytes()
        expected = f"at most {most:,} bytes of tensors together, for {stored:,} stored"
        check_data(needed <= most, self.name, expected, f"{needed:,}; give a smaller input_size, or replace the file")

    def is_open(self, stored: int) -> bool:
        """Tell whether the file sets no limit to the time of a pass, for instance because of loops.

        Args:
            stored: bytes of the model's files.

        Returns:
            Whether sizes depend on values, time on other things than sizes, or a pass is long.
        """
        nodes = self.graph.node
        # The first two come before the sums, which take longer.
        if len(nodes) > _SURE_NODES or not all(map(self._is_bounded, nodes)):
            return True
        products = sum(map(self._products, nodes))
        numbers = sum(map(self._numbers, nodes))
        return products > _SURE_PRODUCTS.of(stored) or numbers > _SURE_NUMBERS.of(stored)

    def _is_bounded(self, node: NodeProto) -> bool:
        """Tell whether the time of a node follows from sizes, and all that it makes has known ones."""
        return _is_usual(node) and self._knows(node.output)

    def _knows(self, names: Iterable[str]) -> bool:
        """Tell whether the sizes of all tensors are known; the empty name stands for one that is left out."""
        return self.tensors.keys() >= set(filter(None, names))

    def _known(self, names: Iterable[str]) -> list[_Tensor]:
        """List the tensors of known sizes among some."""
        return [self.tensors[name] for name in names if name in self.tensors]

    def bytes(self) -> int:
        """Sum the bytes of all tensors that follow from stored ones, and the most bytes of the others at any one time.

        onnxruntime computes the former once, and keeps them all until it has done so.
        """
        last_readers = self._last_readers()
        stored = {tensor.name for tensor in self.graph.initializer}
        sparse = {tensor.values.name for tensor in self.graph.sparse_initializer}
        of_image = {value.name for value in self.graph.input} - stored - sparse
        constant = self._bytes(sparse)
        now = self._bytes(of_image)
        most = now
        released: Counter[int] = Counter()  # bytes by the place of the node after which nothing reads them
        for place, node in enumerate(self.graph.node):
            new = self._bytes(node.output)
            if of_image.isdisjoint(_read(node)):
                constant += new
                continue
            of_image.update(node.output)
            for output in node.output:
                end = last_readers.get(output, place)
                released[end] += self._bytes([output])
            # A node has all that it makes before what it reads is released.
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

    def _bytes(self, names: Iterable[str]) -> int:
        """Sum the bytes of tensors; those of unknown sizes count as 0."""
        return sum(tensor.bytes for tensor in self._known(names))

    def _workspace(self, node: NodeProto) -> int:
        """Compute the bytes that a transposed convolution makes of its input before it sums: all weights a place."""
        tensors = self._known(node.input[:2])
        if node.op_type != "ConvTranspose" or len(tensors) < 2:
            return 0
        image, weights = tensors  # `(B, C, H, W)` and `(C, M, h, w)`
        places = math.prod(image.sizes[2:])
        numbers_a_place = math.prod(weights.sizes[1:])
        return places * numbers_a_place * image.width

    def _products(self, node: NodeProto) -> int:
        """Count the multiplications of a node with products of matrices, those of numbers of 8 bytes eight times."""
        if node.op_type not in _PRODUCTS or not self._knows([*node.input, *node.output]):
            return 0
        left_out = _Tensor((), 0)  # an input without a name, such as a bias
        inputs = [self.tensors.get(name, left_out) for name in node.input]
        sizes = [tensor.sizes for tensor in inputs]
        products = _PRODUCTS[node.op_type](node, sizes, self.tensors[node.output[0]].sizes)
        slowness = 8 if inputs[0].width == 8 else 1
        return slowness * products

    def _numbers(self, node: NodeProto) -> int:
        """Count the numbers that a node reads and writes, also those of a pool's kernel and between two steps."""
        tensors = self._known([*node.input, *node.output])
        numbers = sum(tensor.numbers for tensor in tensors)
        if node.op_type in ("MaxPool", "AveragePool") and node.output[0] in self.tensors:
            kernel = math.prod(_attribute(node, "kernel_shape", ()))
            comparisons = self.tensors[node.output[0]].numbers * kernel
            numbers += comparisons // 16  # each takes less time than a number
        workspace = self._workspace(node)
        if workspace:
            numbers += workspace // self.tensors[node.input[0]].width
        return numbers


def _fix_input_sizes(graph: GraphProto, canvas: tuple[int, int]) -> None:
    """Give inputs the sizes of one image `(width, height)` where they are open."""
    for value in graph.input:
        sides = value.type.tensor_type.shape.dim
        layout = layout_of([side.dim_value for side in sides])
        usual = (1,) * len(sides) if layout is None else sizes_of_image(layout, canvas)
        for side, size in zip(sides, usual, strict=True):
            side.dim_value = side.dim_value or size


def _forget_stated_sizes(graph: GraphProto) -> None:
    """Delete what a model states of the sizes of all but its inputs, so that they are inferred."""
    for value in graph.output:
        if value.type.HasField("tensor_type"):
            value.type.tensor_type.ClearField("shape")
    del graph.value_info[:]


# Multiplications of a node, by its attributes, the sizes of its inputs and those of its output.
_Products = Callable[["NodeProto", list[_Sizes], _Sizes], int]


def _of_matrices(_: NodeProto, inputs: list[_Sizes], output: _Sizes) -> int:
    """Count a column of the second matrix for each element of the result."""
    second = inputs[1]
    # A vector is one column; of a matrix, the columns are the last side of the result.
    is_matrix = len(second) > 1 and len(output) > 0
    columns = output[-1] if is_matrix else 1
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
    sequences, weights, recurrent_weights = inputs[:3]
    items_and_steps = math.prod(sequences[:2])
    return items_and_steps * (math.prod(weights) + math.prod(recurrent_weights))


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


def _is_usual(node: NodeProto) -> bool:
    """Tell whether the time of an operation follows from sizes."""
    if node.op_type not in _USUAL or node.domain not in ("", "ai.onnx"):
        return False
    has_usual_form = _FORMS.get(node.op_type)
    return has_usual_form is None or has_usual_form(node)


def _makes_numbers(node: NodeProto) -> bool:
    """Tell whether a `Cast` makes numbers; the length of texts is unknown."""
    import onnx

    return _attribute(node, "to", onnx.TensorProto.FLOAT) != onnx.TensorProto.STRING


def _reads_few_pixels(node: NodeProto) -> bool:
    """Tell whether a `Resize` reads a few pixels for one of its own; cubic weights take far longer."""
    return _attribute(node, "mode", b"nearest") != b"cubic"


def _multiplies_two(node: NodeProto) -> bool:
    """Tell whether an `Einsum` has at most two inputs; of more, results between them may exceed all that is known."""
    return len(node.input) <= 2


_FORMS: dict[str, Callable[[NodeProto], bool]] = {
    "Cast": _makes_numbers,
    "Resize": _reads_few_pixels,
    "Einsum": _multiplies_two,
}
"""Operations of which only one form is usual, with what tells it."""


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


def _longest(inputs: list[float]) -> float:
    """Find the length of the longest shape that a node reads."""
    return max(inputs, default=0.0)


_LENGTHS: dict[str, Callable[[list[float]], float]] = {
    "Shape": lambda _: 8.0,  # one for each side of a tensor, of which networks have fewer
    "Constant": lambda _: float(_SMALL),
    "Range": lambda _: math.inf,  # is computed one by one
    "Concat": sum,  # joined to itself again and again, a shape grows without an end
    **dict.fromkeys(
        ("Gather", "Slice", "Cast", "Squeeze", "Unsqueeze", "Identity", "Add", "Sub", "Mul", "Div", "Neg"), _longest
    ),
}
"""Lengths of what operations make that shape inference follows by its values, from the lengths of what they read."""


def _longest_shape(graph: GraphProto, lengths: dict[str, float]) -> float:
    """Find the largest length of a shape that inference may follow; `lengths` has those of tensors around the graph."""
    lengths |= {tensor.name: math.prod(tensor.dims) for tensor in graph.initializer}
    longest = 0.0
    for node in graph.node:
        length = 0.0  # of what is no shape
        if node.op_type in _LENGTHS:
            inputs = [lengths.get(name, 0) for name in node.input]
            length = _LENGTHS[node.op_type](inputs)
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

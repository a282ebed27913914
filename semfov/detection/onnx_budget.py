"""What a pass of an ONNX model takes, told from sizes alone: the bytes of its tensors together, and its work."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from semfov.errors import DataError, check_data
from semfov.io.schema import excerpt

_MOST_ELEMENTS = 2**28  # largest number of elements of a tensor in a model; 1 GiB as float32
_MOST_BYTES = 2**27, 2**8  # of tensors that are not stored: of any model, and more for each byte of its files
_MOST_WORK = 2**34, 2**16  # multiplications of a pass, likewise
_MOST_LENGTH = 2**12  # largest length of a shape that is computed from others
_SMALL = 2**10  # elements of a tensor on whose values shapes may depend

_OPEN = frozenset(
    (
        *("Loop", "Scan", "If"),  # with graphs of their own, whose steps are not counted
        *("NonMaxSuppression", "RoiAlign", "MaxRoiPool", "Attention", "Det", "DFT", "STFT", "MelWeightMatrix"),
    )
)
"""Operations whose work does not follow from sizes."""

_OF_SHAPES = frozenset(
    ("Concat", "Gather", "Slice", "Cast", "Squeeze", "Unsqueeze", "Identity", "Add", "Sub", "Mul", "Div", "Neg")
)
"""Operations through which shape inference follows the values of shapes."""

_LENGTHS = {"Shape": 8, "Constant": _SMALL, "Range": math.inf}  # of what such operations make

_Sizes = tuple[int, ...]


@dataclass(frozen=True)
class Budget:
    """The nodes of a model without functions, and the sizes of its tensors as far as they are known."""

    name: str
    graph: Any
    sizes: Mapping[str, _Sizes]
    widths: Mapping[str, int]  # bytes of an element

    @staticmethod
    def of(model: Any, canvas: tuple[int, int], name: str) -> "Budget":
        """Infer the sizes for one image of a canvas `(width, height)`; what the model states itself is not believed."""
        import onnx

        slim = without_weights(model)
        for value in slim.graph.input:
            kind = value.type.tensor_type
            usual = (1, 3, canvas[1], canvas[0]) if len(kind.shape.dim) == 4 else (1,) * len(kind.shape.dim)
            for side, size in zip(kind.shape.dim, usual, strict=True):
                side.dim_value = side.dim_value or size
        for value in slim.graph.output:
            if value.type.HasField("tensor_type"):
                value.type.tensor_type.ClearField("shape")
        del slim.graph.value_info[:]
        short = _longest_shape(slim.graph, {}) <= _MOST_LENGTH
        inferred = onnx.shape_inference.infer_shapes(slim, data_prop=short).graph
        sizes, kinds = {}, {}
        for value in (*inferred.value_info, *inferred.input, *inferred.output):
            kind, stated = value.type.tensor_type, dims(value)
            check_elements(f"{name}: tensor {excerpt(value.name)}", stated)
            if kind.HasField("shape") and all(each.HasField("dim_value") for each in kind.shape.dim):
                sizes[value.name], kinds[value.name] = tuple(stated), kind.elem_type
        for tensor in inferred.initializer:
            sizes[tensor.name], kinds[tensor.name] = tuple(tensor.dims), tensor.data_type
        for sparse in model.graph.sparse_initializer:
            sizes[sparse.values.name], kinds[sparse.values.name] = tuple(sparse.dims), sparse.values.data_type
        return Budget(name, model.graph, sizes, {key: _width(kind) for key, kind in kinds.items()})

    def check(self, stored: int) -> None:
        """Raise `DataError` for more bytes or more work than a model with files of `stored` bytes may take."""
        remedy = "give a smaller input_size, or replace the file"
        for got, (base, more), unit in (
            (self.bytes(), _MOST_BYTES, "bytes of tensors together"),
            (sum(map(self._work, self.graph.node)), _MOST_WORK, "multiplications of a pass"),
        ):
            most = base + more * stored
            check_data(got <= most, self.name, f"at most {most:,} {unit}, for {stored:,} stored", f"{got:,}; {remedy}")

    def is_open(self) -> bool:
        """Whether sizes or work depend on values, or on operations that only onnxruntime knows."""
        nodes = self.graph.node
        made = {output for node in nodes for output in node.output if output}
        return not made <= self.sizes.keys() or any(
            n.op_type in _OPEN or n.domain not in ("", "ai.onnx") for n in nodes
        )

    def bytes(self) -> int:
        """Bytes of all tensors that follow from stored ones, and the most bytes of the others at any one time."""
        # onnxruntime computes the former once, and keeps them all until it has done so.
        nodes = self.graph.node
        last = {name: place for place, node in enumerate(nodes) for name in _read(node)}
        last |= {output.name: len(nodes) for output in self.graph.output}
        stored = {tensor.name for tensor in self.graph.initializer}
        sparse = {tensor.values.name for tensor in self.graph.sparse_initializer}
        open_names = {value.name for value in self.graph.input} - stored - sparse
        fixed = sum(map(self._bytes, sparse))
        now = sum(map(self._bytes, open_names))
        most = now
        ending: dict[int, int] = {}
        for place, node in enumerate(nodes):
            made = sum(map(self._bytes, node.output))
            if open_names.isdisjoint(_read(node)):
                fixed += made
                continue
            open_names.update(node.output)
            for output in node.output:
                end = last.get(output, place)
                ending[end] = ending.get(end, 0) + self._bytes(output)
            now += made
            most = max(most, now + self._columns(node))
            now -= ending.pop(place, 0)
        return fixed + most

    def _bytes(self, name: str) -> int:
        return math.prod(self.sizes[name]) * self.widths[name] if name in self.sizes else 0

    def _columns(self, node: Any) -> int:
        """Bytes of what a transposed convolution makes of its input before it sums: all weights for each place."""
        if node.op_type != "ConvTranspose" or not self.sizes.keys() >= {*node.input[:2]}:
            return 0
        image, weights = (self.sizes[name] for name in node.input[:2])
        return math.prod(image[2:]) * math.prod(weights[1:]) * self.widths[node.input[0]]

    def _work(self, node: Any) -> int:
        """Multiplications of a node, or the numbers that it reads and writes where these are more."""
        names = [name for name in (*node.input, *node.output) if name]
        moved = sum(math.prod(self.sizes[name]) for name in names if name in self.sizes)
        products = _PRODUCTS.get(node.op_type)
        if products is None or not self.sizes.keys() >= {*names}:
            return moved
        return max(moved, products(node, [self.sizes.get(name, ()) for name in node.input], self.sizes[node.output[0]]))


def _of_matrices(_: Any, inputs: list[_Sizes], output: _Sizes) -> int:
    """A column of the second matrix for each element of the result."""
    *_, second = inputs[:2]
    columns = output[-1] if len(second) > 1 and output else 1
    return math.prod(output) * math.prod(second[-2:]) // max(columns, 1)


def _of_pool(node: Any, _: list[_Sizes], output: _Sizes) -> int:
    return math.prod(output) * math.prod(_attribute(node, "kernel_shape", ()))


def _of_steps(_: Any, inputs: list[_Sizes], output: _Sizes) -> int:
    """All weights of a recurrent layer for each step of each item."""
    return math.prod(inputs[0][:2]) * (math.prod(inputs[1]) + math.prod(inputs[2]))


def _of_sums(node: Any, inputs: list[_Sizes], output: _Sizes) -> int:
    """The product of the sides that the letters of an `Einsum` stand for; of all sides where it has an ellipsis."""
    equation = _attribute(node, "equation", b"").decode().replace(" ", "")
    if "." in equation:
        return math.prod(map(math.prod, inputs))
    terms = equation.partition("->")[0].split(",")
    pairs = (pair for term, sizes in zip(terms, inputs, strict=True) for pair in zip(term, sizes, strict=True))
    return math.prod(dict(sorted(pairs, key=lambda pair: pair[1])).values())


_PRODUCTS: dict[str, Callable[[Any, list[_Sizes], _Sizes], int]] = {
    **dict.fromkeys(("MatMul", "Gemm", "MatMulInteger"), _of_matrices),
    "QLinearMatMul": lambda node, inputs, output: _of_matrices(node, [inputs[0], inputs[3]], output),
    **dict.fromkeys(
        ("Conv", "ConvInteger", "DeformConv"), lambda _, inputs, output: math.prod(output) * math.prod(inputs[1][1:])
    ),
    "QLinearConv": lambda _, inputs, output: math.prod(output) * math.prod(inputs[3][1:]),
    "ConvTranspose": lambda _, inputs, output: math.prod(inputs[0]) * math.prod(inputs[1][1:]),
    **dict.fromkeys(("MaxPool", "AveragePool", "LpPool"), _of_pool),
    "LRN": lambda node, _, output: math.prod(output) * _attribute(node, "size", 1),
    **dict.fromkeys(("RNN", "GRU", "LSTM"), _of_steps),
    "Einsum": _of_sums,
}
"""Multiplications of the operations that read their inputs more than once."""


def _attribute(node: Any, name: str, otherwise: Any) -> Any:
    import onnx

    return next((onnx.helper.get_attribute_value(each) for each in node.attribute if each.name == name), otherwise)


def graphs(node: Any) -> Iterator[Any]:
    """The graphs that a node has of its own."""
    for attribute in node.attribute:
        if attribute.HasField("g"):
            yield attribute.g
        yield from attribute.graphs


def _read(node: Any) -> Iterator[str]:
    """Names that a node reads, also in its own graphs."""
    yield from (name for name in node.input if name)
    for graph in graphs(node):
        for inner in graph.node:
            yield from _read(inner)


def _longest_shape(graph: Any, lengths: dict[str, float]) -> float:
    """The largest length of a shape that inference may follow; `lengths` has those of tensors around the graph."""
    # Shapes that are joined to themselves again and again grow without an end, and a `Range` is computed one by one.
    lengths |= {tensor.name: math.prod(tensor.dims) for tensor in graph.initializer}
    longest = 0.0
    for node in graph.node:
        own = [lengths.get(name, 0) for name in node.input]
        length = _LENGTHS.get(node.op_type, 0.0)
        if node.op_type in _OF_SHAPES:
            length = sum(own) if node.op_type == "Concat" else max(own, default=0)
        lengths |= dict.fromkeys(node.output, length)
        longest = max(longest, length, *(_longest_shape(inner, lengths) for inner in graphs(node)))
    return longest


def check_elements(name: str, sizes: Iterable[int]) -> None:
    """Raise `DataError` for a tensor of more than `_MOST_ELEMENTS` numbers."""
    sizes = list(sizes)
    if min(sizes, default=0) < 0 or math.prod(sizes) > _MOST_ELEMENTS:
        raise DataError(f"{name}: expected at most {_MOST_ELEMENTS:,} numbers, got sizes {excerpt(sizes)}")


def dims(value: Any) -> list[int]:
    """Sizes of a value; unknown sizes count as 1."""
    return [d.dim_value if d.HasField("dim_value") else 1 for d in value.type.tensor_type.shape.dim]


def _width(kind: int) -> int:
    """Bytes of an element; of a text, those of an empty one, and of a kind that is not known, the most of a number."""
    import onnx

    otherwise: dict[int, int] = {onnx.TensorProto.UNDEFINED: 16, onnx.TensorProto.STRING: 32}
    return otherwise.get(kind) or onnx.helper.tensor_dtype_to_np_dtype(kind).itemsize


def without_weights(model: Any) -> Any:
    """The model without its large tensors: shapes may depend on values of small tensors only."""
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

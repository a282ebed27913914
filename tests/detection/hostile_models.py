"""Small ONNX files that ask for much: each function gives the nodes of one, and its stored tensors."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from tests.small import write_network

FLOAT, INT64, BOOL = TensorProto.FLOAT, TensorProto.INT64, TensorProto.BOOL
IMAGE = {"images": [1, 3, 64, 64]}
ALL_ONES = numpy_helper.from_array(np.array([1e-4], np.float32))


def node(kind: str, inputs: str, outputs: str, **attributes: Any) -> Any:
    return helper.make_node(kind, inputs.split(), outputs.split(), **attributes)


def value(name: str, kind: int = FLOAT, shape: list[int] | None = None) -> Any:
    return helper.make_tensor_value_info(name, kind, shape)


def square(side: int) -> tuple[list[Any], dict[str, Any]]:
    """A matrix `big` that is made of its sides."""
    return [node("ConstantOfShape", "sides", "big", value=ALL_ONES)], {"sides": [side, side]}


def ending(name: str) -> list[Any]:
    """Nodes by which a tensor takes part in the boxes."""
    return [
        node("ReduceMax", name, "most", keepdims=0),
        node("ReduceMean", "images", "mean", keepdims=0),
        node("Add", "most mean", "sum"),
        node("Mul", "rows sum", "out"),
    ]


def products(side: int, count: int) -> tuple[list[Any], dict[str, Any]]:
    nodes, stored = square(side)
    nodes += [node("MatMul", f"{f'p{i - 1}' if i else 'big'} big", f"p{i}") for i in range(count)]
    return [*nodes, *ending(f"p{count - 1}")], stored


def copies(side: int, count: int) -> tuple[list[Any], dict[str, Any]]:
    """Constants that are small enough one by one, and are all needed at the end."""
    nodes, stored = square(side)
    nodes += [node("Sin" if i % 2 else "Cos", "big", f"c{i}") for i in range(count)]
    return [*nodes, node("Max", " ".join(f"c{i}" for i in range(count)), "all"), *ending("all")], stored


def tiled() -> tuple[list[Any], dict[str, Any]]:
    """A picture that is repeated, again and again."""
    nodes = [node("Tile", f"{f't{i - 1}' if i else 'images'} repeats", f"t{i}") for i in range(3)]
    return [*nodes, *ending("t2")], {"repeats": [1, 1, 14, 14]}


def enlarged() -> tuple[list[Any], dict[str, Any]]:
    nodes = [node("Resize", "images empty scales", "large", mode="nearest"), *ending("large")]
    return nodes, {"scales": np.array([1, 1, 1e5, 1e5], np.float32), "empty": np.zeros(0, np.float32)}


def padded() -> tuple[list[Any], dict[str, Any]]:
    return [node("Pad", "images pads", "large"), *ending("large")], {"pads": [0, 0, 7000, 0, 0, 0, 0, 7000]}


def ranged() -> tuple[list[Any], dict[str, Any]]:
    nodes = [node("Range", "zero end one", "numbers"), node("Cast", "numbers", "large", to=FLOAT)]
    return [*nodes, *ending("large")], {"zero": np.int64(0), "end": np.int64(10**9), "one": np.int64(1)}


def ranged_by_the_picture() -> tuple[list[Any], dict[str, Any]]:
    nodes = [node("ReduceMean", "images", "grey", keepdims=0), node("Cast", "grey", "whole", to=INT64)]
    nodes += [node("Add", "whole end", "last"), node("Range", "zero last one", "numbers")]
    nodes += [node("Cast", "numbers", "large", to=FLOAT), *ending("large")]
    return nodes, {"zero": np.int64(0), "end": np.int64(10**9), "one": np.int64(1)}


def dequantised() -> tuple[list[Any], dict[str, Any]]:
    nodes = [node("ConstantOfShape", "sides", "bytes", value=numpy_helper.from_array(np.array([3], np.int8)))]
    nodes += [node("DequantizeLinear", "bytes scale", "large"), *ending("large")]
    return nodes, {"sides": [16000, 16000], "scale": np.float32(0.1)}


def transposed_convolution() -> tuple[list[Any], dict[str, Any]]:
    """Weights of 4 MB for each of 4,096 places; the result is small."""
    nodes = [node("ConstantOfShape", "sides", "weights", value=ALL_ONES)]
    nodes += [node("ConvTranspose", "images weights", "large", strides=[1, 1]), *ending("large")]
    return nodes, {"sides": [3, 1, 1000, 1000]}


def wide_convolution() -> tuple[list[Any], dict[str, Any]]:
    """A convolution of few bytes with 10¹⁴ multiplications, which no clock can stop."""
    nodes = [node("ConstantOfShape", "sides", "weights", value=ALL_ONES), node("Pad", "images pads", "room")]
    nodes += [node("Conv", "room weights", "large"), *ending("large")]
    return nodes, {"sides": [1, 3, 1700, 1700], "pads": [0, 0, 1700, 1700, 0, 0, 1700, 1700]}


def pooled() -> tuple[list[Any], dict[str, Any]]:
    nodes = [node("Pad", "images pads", "room"), node("AveragePool", "room", "large", kernel_shape=[1500, 1500])]
    return [*nodes, *ending("large")], {"pads": [0, 0, 1500, 1500, 0, 0, 1500, 1500]}


def summed() -> tuple[list[Any], dict[str, Any]]:
    stored = {"line": np.ones(3000, np.float32)}
    return [node("Einsum", "line line line line", "large", equation="a,b,c,d->"), *ending("large")], stored


def recurrent() -> tuple[list[Any], dict[str, Any]]:
    nodes = [node("ConstantOfShape", f"{name}s", name, value=ALL_ONES) for name in ("x", "w", "r")]
    nodes += [node("LSTM", "x w r", "large", hidden_size=1000), *ending("large")]
    return nodes, {"xs": [20000, 1, 1], "ws": [1, 4000, 1], "rs": [1, 4000, 1000]}


def doubled_shape(count: int) -> tuple[list[Any], dict[str, Any]]:
    """A shape that is joined to itself: its values alone fill the memory of shape inference."""
    nodes = [node("Concat", f"s{i} s{i}", f"s{i + 1}", axis=0) for i in range(count)]
    nodes += [node("ConstantOfShape", f"s{count}", "large", value=ALL_ONES), *ending("large")]
    return nodes, {"s0": [1]}


def looped(body: list[Any], start: Any, steps: int, kind: int = FLOAT) -> tuple[list[Any], dict[str, Any]]:
    inputs = [value("step", INT64, []), value("go", BOOL, []), value("state", kind)]
    outputs = [value("on", BOOL, []), value("next", kind)]
    again = helper.make_graph([node("Identity", "go", "on"), *body], "body", inputs, outputs)
    nodes = [node("Loop", "steps yes start", "looped", body=again), node("Cast", "looped", "large", to=FLOAT)]
    return [*nodes, *ending("large")], {"steps": np.int64(steps), "yes": np.bool_(True), "start": start}


def doubled_in_a_loop() -> tuple[list[Any], dict[str, Any]]:
    body = [node("Concat", "state state", "next", axis=0)]
    return looped(body, np.ones(8, np.float32), 40)


def multiplied_in_a_loop() -> tuple[list[Any], dict[str, Any]]:
    body = [node("MatMul", "state state", "next")]
    return looped(body, np.full((300, 300), 1e-3, np.float32), 10**9)


def one_product_in_a_branch() -> tuple[list[Any], dict[str, Any]]:
    """Nodes of an inner graph depend on stored values alone: they would be folded."""
    nodes, stored = square(5000)
    nodes += [node("MatMul", f"{f'p{i - 1}' if i else 'big'} big", f"p{i}") for i in range(40)]
    branch = helper.make_graph(
        [*nodes, node("ReduceMax", "p39", "branch", keepdims=0)], "branch", [], [value("branch")]
    )
    other = helper.make_graph([node("Identity", "nothing", "other")], "other", [], [value("other")])
    nodes = [node("ReduceMin", "images", "least", keepdims=0), node("Cast", "least", "condition", to=BOOL)]
    nodes += [node("If", "condition", "large", then_branch=branch, else_branch=other), *ending("large")]
    return nodes, stored | {"nothing": np.float32(0)}


def sequences() -> tuple[list[Any], dict[str, Any]]:
    """A sequence with the same tensor again and again, joined at the end."""
    nodes, stored = square(4000)
    nodes += [node("SequenceConstruct", " ".join(["big"] * 40), "sequence")]
    nodes += [node("ConcatFromSequence", "sequence", "large", axis=0), *ending("large")]
    return nodes, stored


def suppressed() -> tuple[list[Any], dict[str, Any]]:
    """Suppression of a million equal boxes without a threshold."""
    nodes = [node("ConstantOfShape", "bs", "boxes"), node("ConstantOfShape", "ss", "scores", value=ALL_ONES)]
    nodes += [node("NonMaxSuppression", "boxes scores many one", "kept"), node("Cast", "kept", "large", to=FLOAT)]
    stored = {"bs": [1, 200000, 4], "ss": [1, 10, 200000], "many": np.int64(10**6), "one": np.float32(1)}
    return [*nodes, *ending("large")], stored


def chained(kind: str, side: int, count: int, **attributes: Any) -> tuple[list[Any], dict[str, Any]]:
    """Operations that take long for each number, one after the other; their bytes at any one time are few."""
    nodes = [node("Pad", "images pads", "c0"), node("Identity", "length", "k")]
    outputs = "c{0} i{0}" if kind == "TopK" else "c{0}"
    inputs = "c{0} k" if kind == "TopK" else "c{0}"
    nodes += [node(kind, inputs.format(i), outputs.format(i + 1), **attributes) for i in range(count)]
    return [*nodes, *ending(f"c{count}")], {"pads": [0, 0, side, side, 0, 0, 0, 0], "length": [side]}


def as_text() -> tuple[list[Any], dict[str, Any]]:
    """Numbers as texts, which no limit of tensors counts."""
    nodes = [node("Pad", "images pads", "room"), node("Cast", "room", "text", to=TensorProto.STRING)]
    nodes += [node("Concat", " ".join(["text"] * 20), "texts", axis=0), node("Cast", "texts", "large", to=FLOAT)]
    return [*nodes, *ending("large")], {"pads": [0, 0, 800, 800, 0, 0, 0, 0]}


def cubic() -> tuple[list[Any], dict[str, Any]]:
    nodes = [node("Resize", "images empty scales", "c0", mode="cubic")]
    nodes += [node("Resize", f"c{i} empty same", f"c{i + 1}", mode="cubic") for i in range(200)]
    numbers = {"scales": np.array([1, 1, 14, 14], np.float32), "same": np.array([1, 1, 1.001, 1], np.float32)}
    return [*nodes, *ending("c200")], {**numbers, "empty": np.zeros(0, np.float32)}


def functions(count: int) -> tuple[list[Any], dict[str, Any]]:
    """Each function calls the one before it twice: as many nodes as 2 to the power of their count."""
    return [node(f"F{count - 1}", "images", "large", domain="own"), *ending("large")], {}


def stated() -> tuple[list[Any], dict[str, Any]]:
    """A product of matrices whose sizes follow from values of the picture, and are stated as small."""
    nodes = [node("Sign", "images", "signs"), node("Shape", "signs", "shape"), node("NonZero", "shape", "places")]
    nodes += [node("Cast", "places", "float", to=FLOAT), node("ReduceMax", "float", "three", keepdims=0)]
    nodes += [node("Cast", "three", "whole", to=INT64), node("Mul", "whole side", "length")]
    nodes += [node("Concat", "length length", "sides", axis=0), *square(1)[0]]
    nodes += [node("MatMul", "big big", "large"), *ending("large")]
    return nodes, {"side": [2500]}


HOSTILE = {
    "products": lambda: products(8192, 40),
    "many small products": lambda: products(2000, 400),
    "copies": lambda: copies(5000, 30),
    "tiled": tiled,
    "enlarged": enlarged,
    "padded": padded,
    "ranged": ranged,
    "ranged by the picture": ranged_by_the_picture,
    "dequantised": dequantised,
    "transposed convolution": transposed_convolution,
    "wide convolution": wide_convolution,
    "pooled": pooled,
    "summed": summed,
    "recurrent": recurrent,
    "doubled shape": lambda: doubled_shape(27),
    "doubled in a loop": doubled_in_a_loop,
    "multiplied in a loop": multiplied_in_a_loop,
    "products in a branch": one_product_in_a_branch,
    "sequences": sequences,
    "suppressed": suppressed,
    "stated": stated,
    "powers": lambda: chained("Tan", 900, 1000),
    "sorted": lambda: chained("TopK", 900, 500, axis=2),
    "sums of exponentials": lambda: chained("Softmax", 900, 700, axis=1),
    "many nodes": lambda: chained("Relu", 1, 16_000),
    "texts": as_text,
    "cubic": cubic,
    "functions": lambda: functions(40),
    "functions that end": lambda: functions(3),
    "sparse": lambda: (ending("large"), {}),
}


def write(path: Path, name: str) -> Path:
    """Write a model whose rows of boxes and scores depend on what one of `HOSTILE` makes."""
    nodes, stored = HOSTILE[name]()
    rows = {"rows": np.full((1, 10, 6), 0.5, np.float32)}
    write_network(path, nodes, IMAGE, {"out": [1, 10, 6]}, stored | rows, metadata={"names": "{0: 'a', 1: 'b'}"})
    model = onnx.load(path)
    if name == "stated":
        model.graph.value_info.extend([value("big", FLOAT, [1, 1]), value("large", FLOAT, [1, 1])])
    if name == "sparse":
        one, place = np.ones(1, np.float32), np.zeros(1, np.int64)
        parts = numpy_helper.from_array(one, "large"), numpy_helper.from_array(place, "place")
        model.graph.sparse_initializer.append(helper.make_sparse_tensor(*parts, [2**14, 2**13]))
    if name.startswith("functions"):
        own = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
        model.opset_import.append(own[1])
        for i in range(int(nodes[0].op_type[1:]) + 1):
            before = {"domain": "own"} if i else {}
            kind = f"F{i - 1}" if i else "Relu"
            body = [node(kind, "x", "middle", **before), node(kind, "middle", "y", **before)]
            model.functions.append(helper.make_function("own", f"F{i}", ["x"], ["y"], body, own))
    onnx.save(model, str(path))
    return path

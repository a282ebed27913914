"""Darknet networks as ONNX models: their graph, and onnxruntime's twin of a network that torch holds."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import singledispatchmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from semfov.detection.darknet import Convolution, Darknet, Head, MaxPool, Route, Shortcut
from semfov.detection.onnx_session import OnnxSession
from semfov.detection.scores import Candidates
from semfov.errors import DataError, values_known
from semfov.io.files import cache_folder, sha256, write_bytes

if TYPE_CHECKING:
    from onnx import ModelProto, NodeProto, TensorProto

_VERSION = 1
"""Version of the exported graph; raise it with every change, so that an earlier export is not taken for a new one."""

_OPSET = 17
_IR_VERSION = 8  # IR version from the time of opset 17; some runtimes that could run the model refuse newer versions

_OUTPUTS = ("boxes", "objectness", "classes")

_Attribute = int | float | str | Sequence[int] | Sequence[float]


class Graph:
    """A graph under construction. Methods that add a node return the name of its output.

    Attributes:
        nodes: the nodes, in order.
        constants: the stored tensors by name.
    """

    def __init__(self) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: dict[str, TensorProto] = {}

    def add(self, op: str, *inputs: str, output: str | None = None, **attributes: _Attribute) -> str:
        """Add a node with one output.

        Args:
            op: its operation.
            *inputs: names of what it reads, `""` for an input that is left out.
            output: name of its output; None for one of its own.
            **attributes: attributes of the operation.

        Returns:
            The name of its output.
        """
        name = output or self._free_name(op)
        self._append(op, inputs, [name], attributes)
        return name

    def add_several(self, op: str, *inputs: str, outputs: int, **attributes: _Attribute) -> list[str]:
        """Add a node with several outputs.

        Args:
            op: its operation.
            *inputs: names of what it reads.
            outputs: number of its outputs.
            **attributes: attributes of the operation.

        Returns:
            The names of its outputs.
        """
        name = self._free_name(op)
        names = [f"{name}_{number}" for number in range(outputs)]
        self._append(op, inputs, names, attributes)
        return names

    def _free_name(self, op: str) -> str:
        """Make a name for the output of the next node."""
        return f"{op.lower()}_{len(self.nodes)}"

    def _append(self, op: str, inputs: Sequence[str], outputs: list[str], attributes: Mapping[str, Any]) -> None:
        from onnx import helper

        self.nodes.append(helper.make_node(op, list(inputs), outputs, **attributes))

    def constant(self, values: Tensor | list[int] | list[float] | int | float) -> str:
        """Add a constant; floating-point numbers become float32 unless they are a float64 tensor.

        Args:
            values: the numbers.

        Returns:
            The name of the constant.
        """
        from onnx import numpy_helper

        tensor = torch.as_tensor(values)
        python_floats = tensor.is_floating_point() and not isinstance(values, Tensor)
        if python_floats or tensor.dtype == torch.float16:
            tensor = tensor.float()
        name = f"constant_{len(self.constants)}"
        self.constants[name] = numpy_helper.from_array(tensor.detach().cpu().contiguous().numpy(), name)
        return name


_ACTIVATIONS: dict[str, Callable[[Graph, str], str]] = {
    "linear": lambda graph, x: x,
    "leaky": lambda graph, x: graph.add("LeakyRelu", x, alpha=0.1),
    "relu": lambda graph, x: graph.add("Relu", x),
    "mish": lambda graph, x: graph.add("Mul", x, graph.add("Tanh", graph.add("Softplus", x))),
    "swish": lambda graph, x: graph.add("Mul", x, graph.add("Sigmoid", x)),
    "logistic": lambda graph, x: graph.add("Sigmoid", x),
}
"""Nodes of activations by their Darknet name: `x tanh(ln(1 + e^x))` for mish, `x σ(x)` for swish."""


class _NetworkGraph(Graph):
    """The graph of a Darknet network, in float32."""

    @singledispatchmethod
    def layer(self, layer: nn.Module, *sources: str) -> str:
        """Add a layer that reads the outputs of others; heads are decoded apart, and dropout does nothing."""
        return sources[0]

    @layer.register
    def _convolution(self, layer: Convolution, source: str) -> str:
        vertical, horizontal = (int(side) for side in layer.padding)
        convolved = self.add(
            "Conv",
            source,
            self.constant(layer.weight.float()),
            self.constant(cast(Tensor, layer.bias).float()),
            strides=list(layer.stride),
            pads=[vertical, horizontal, vertical, horizontal],
            group=layer.groups,
        )
        return _ACTIVATIONS[layer.activation](self, convolved)

    @layer.register
    def _max_pool(self, layer: MaxPool, source: str) -> str:
        before = layer.padding // 2
        after = layer.padding - before
        return self.add(
            "MaxPool",
            source,
            kernel_shape=[layer.size] * 2,
            strides=[layer.stride] * 2,
            pads=[before, before, after, after],
        )

    @layer.register
    def _upsample(self, layer: nn.Upsample, source: str) -> str:
        scale = float(cast(float, layer.scale_factor))
        return self.add(
            "Resize",
            source,
            "",
            self.constant([1.0, 1.0, scale, scale]),
            # As PyTorch's `nearest`, which rounds places down; ONNX by itself counts from the centres of pixels.
            mode="nearest",
            nearest_mode="floor",
            coordinate_transformation_mode="asymmetric",
        )

    @layer.register
    def _route(self, layer: Route, *sources: str) -> str:
        chunks: Sequence[str] = sources
        if layer.groups > 1:
            parts = [self.add_several("Split", source, outputs=layer.groups, axis=1) for source in sources]
            chunks = [names[layer.group] for names in parts]
        return chunks[0] if len(chunks) == 1 else self.add("Concat", *chunks, axis=1)

    @layer.register
    def _shortcut(self, layer: Shortcut, *sources: str) -> str:
        total = self.add("Add", *sources)
        return _ACTIVATIONS[layer.activation](self, total)

    def decode(self, head: Head, source: str, step: float) -> tuple[str, str, str]:
        """Add `decode_yolo`: boxes `(B, h w A, 4)`, objectness `(B, h w A)` and classes `(B, h w A, K)`."""
        # Nodes and constants are named by their order, which is a part of the bytes of a model (`_VERSION`).
        # A 0 keeps the size of the batch. Cells are last, as their number is open.
        shape = self.constant([0, len(head.anchors), 5 + head.classes, -1])
        parts = self.add("Reshape", source, shape)
        cells = self.add("Transpose", parts, perm=[0, 3, 1, 2])
        lengths = self.constant([2, 2, 1, head.classes])
        shift, size, objectness, classes = self.add_several("Split", cells, lengths, outputs=4, axis=3)

        # The centre is (scale σ(t) - (scale - 1) / 2 + i) s, with the column or row i of the cell and its step s.
        share = self.add("Sigmoid", shift)
        place_in_cell = self.add("Mul", share, self.constant(float(head.scale)))
        cell = self._corners(source)
        corner = self.add("Sub", cell, self.constant((head.scale - 1) / 2))
        place = self.add("Add", place_in_cell, corner)
        centre = self.add("Mul", place, self.constant(step))

        # Half of the size is p exp(t) / 2, with the anchor p.
        half_anchors = (torch.tensor(head.anchors) / 2).float()
        growth = self.add("Exp", size)
        half = self.add("Mul", growth, self.constant(half_anchors))
        lower = self.add("Sub", centre, half)
        upper = self.add("Add", centre, half)
        boxes = self.add("Concat", lower, upper, axis=3)

        all_boxes = self.add("Reshape", boxes, self.constant([0, -1, 4]))
        objectness = self.add("Sigmoid", objectness)
        all_objectness = self.add("Reshape", objectness, self.constant([0, -1]))
        classes = self.add("Sigmoid", classes)
        all_classes = self.add("Reshape", classes, self.constant([0, -1, head.classes]))
        return all_boxes, all_objectness, all_classes

    def _corners(self, source: str) -> str:
        """Add the column and row of every cell of a map, `(h w, 1, 2)`, for maps of any size."""
        size = self.add("Shape", source)
        rows, columns = (self.add("Gather", size, self.constant(axis)) for axis in (2, 3))
        count = self.add("Mul", rows, columns)
        cell = self.add("Range", self.constant(0), count, self.constant(1))
        column = self.add("Mod", cell, columns)
        row = self.add("Div", cell, columns)
        axes = self.constant([1, 2])
        pair = [self.add("Unsqueeze", place, axes) for place in (column, row)]
        return self.add("Cast", self.add("Concat", *pair, axis=2), to=1)


def network_model(
    network: Darknet, name: str, size: tuple[int, int] | None = None, layers: Sequence[int] = ()
) -> ModelProto:
    """Make the ONNX model of a network, with decoded boxes.

    Args:
        network: the network.
        name: name of the model.
        size: `(width, height)` of the one image that it takes; None for any number of images of any size.
        layers: numbers of layers whose maps are further outputs, `layer_0`, ….

    Returns:
        The model, with outputs `boxes` `(B, N, 4)`, `objectness` `(B, N)` and `classes` `(B, N, K)`.
    """
    try:
        from onnx import TensorProto, helper
    except ImportError as error:
        raise ModuleNotFoundError("exporting to ONNX needs the package onnx: pip install onnx") from error
    graph = _network_graph(network, layers)

    # Words are names of sizes that are open.
    batch, columns, rows = ("batch", "width", "height") if size is None else (1, *size)
    boxes = "boxes" if size is None else None
    classes = network.heads[0].classes
    shapes = {"boxes": [batch, boxes, 4], "objectness": [batch, boxes], "classes": [batch, boxes, classes]}
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch, 3, rows, columns])
    outputs = [helper.make_tensor_value_info(output, TensorProto.FLOAT, shapes[output]) for output in _OUTPUTS]
    outputs += [helper.make_tensor_value_info(f"layer_{number}", TensorProto.FLOAT, None) for number in layers]
    constants = list(graph.constants.values())
    return helper.make_model(
        helper.make_graph(graph.nodes, name, [images], outputs, constants),
        producer_name="semfov",
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
    )


def _network_graph(network: Darknet, layers: Sequence[int]) -> _NetworkGraph:
    """Make the nodes of a network from its input `images` to `_OUTPUTS`, and to the maps of layers by number."""
    graph = _NetworkGraph()
    tensors = {-1: "images"}
    decoded_heads = []
    for index, layer in enumerate(network.layers):
        inputs = [tensors[source] for source in network.sources[index]]
        tensors[index] = graph.layer(layer, *inputs)
        if isinstance(layer, Head):
            step = float(network.steps[index])
            decoded_heads.append(graph.decode(layer, tensors[index], step))
    for output, levels in zip(_OUTPUTS, zip(*decoded_heads, strict=True), strict=True):
        graph.add("Concat", *levels, output=output, axis=1)
    for number in layers:
        graph.add("Identity", tensors[number], output=f"layer_{number}")
    return graph


def _has_gradients(tensors: Sequence[Tensor]) -> bool:
    """Tell whether derivatives of tensors are followed, backwards or forwards."""
    backwards = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    tangents = [forward_ad.unpack_dual(tensor).tangent for tensor in tensors]
    forwards = any(tangent is not None for tangent in tangents)
    return backwards or forwards


class _OpenSession(NamedTuple):
    """A session, and what it was opened for: a process, and a number of threads."""

    holder: tuple[int, int]
    session: OnnxSession


class OnnxTwin:
    """A Darknet network with decoded boxes, computed by onnxruntime on a CPU.

    A twin computes the network of one digest. Private attributes: `_versions` are those of the parameters when their
    digest was last compared, and `_same` is what the comparison gave. `_opened` has the sessions of this process by the
    layers whose maps they return.

    Invariant: torch raises the version of a parameter whenever it is written to, so that parameters of `_versions` have
    not changed since, and `_same` still holds. Sessions are of the twin's digest, never of the parameters' present one.
    """

    def __init__(self, digest: str, versions: tuple[object, ...] | None = None) -> None:
        self.digest = digest
        self._versions = versions
        self._same = versions is not None
        self._opened: dict[tuple[int, ...], _OpenSession] = {}

    def __reduce__(self) -> tuple[Callable[[str], OnnxTwin], tuple[str]]:
        # Without the versions, which hold addresses in the memory of this process.
        return OnnxTwin, (self.digest,)

    def obstacle(self, network: Darknet) -> str | None:
        """Find the reason why onnxruntime cannot run a network as it is now.

        Args:
            network: the network.

        Returns:
            The reason in words; None if it can.
        """
        parameters = list(network.parameters())
        dtype = parameters[0].dtype
        devices = {parameter.device.type for parameter in parameters}
        if devices != {"cpu"}:
            return f"a network on {', '.join(sorted(devices))}"
        if dtype != torch.float32:
            return f"a network of {dtype}"
        if network.channels != 3:
            return f"a network that takes {network.channels} channels"
        versions = parameter_versions(parameters)
        if versions != self._versions:
            self._versions = versions
            self._same = network_digest(network) == self.digest
        return None if self._same else "weights that were changed after loading"

    def obstacle_here(self, network: Darknet, canvas: Tensor) -> str | None:
        """Find the reason why onnxruntime cannot run a network on a canvas.

        Args:
            network: the network.
            canvas: `(B, 3, H, W)`.

        Returns:
            The reason in words; None if it can.
        """
        tensors = [canvas, *network.parameters()]
        if not values_known(*tensors) or torch.jit.is_tracing():  # type: ignore[attr-defined]
            return "graphs that are traced, and function transforms"
        if any(type(tensor) not in (Tensor, nn.Parameter) for tensor in tensors):
            return "subclasses of tensors"
        if _has_gradients(tensors):
            return "gradients"
        if canvas.device.type != "cpu":
            return f"a canvas on {canvas.device}"
        return self.obstacle(network)

    def __call__(
        self, network: Darknet, canvas: Tensor, layers: Mapping[str, int]
    ) -> tuple[Candidates, dict[str, Tensor]]:
        """Compute all boxes, and maps, in float32, without gradients.

        Args:
            network: the network of this twin.
            canvas: `(B, 3, H, W)`.
            layers: numbers of the layers whose maps are returned, by name.

        Returns:
            The boxes in canvas pixels, with their scores, and the maps by name.
        """
        network.check_image(canvas)
        numbers = tuple(sorted(set(layers.values())))
        run = self._session(network, numbers)
        outputs = run(canvas.float())
        candidates = Candidates(outputs["boxes"], outputs["classes"], outputs["objectness"])
        return candidates, {name: outputs[f"layer_{layer}"] for name, layer in layers.items()}

    def _session(self, network: Darknet, layers: tuple[int, ...]) -> OnnxSession:
        """Return the session of this process that returns the maps of layers; opened if there is none."""
        # A session that was opened before a process was forked has none of its threads.
        holder = os.getpid(), torch.get_num_threads()
        opened = self._opened.get(layers)
        if opened is None or opened.holder != holder:
            opened = self._opened[layers] = _OpenSession(holder, self._new_session(network, layers))
        return opened.session

    def _new_session(self, network: Darknet, layers: tuple[int, ...]) -> OnnxSession:
        # Not open-ended: the graph is made here, so that its work is known.
        try:
            return OnnxSession(_exported(network, self.digest, cache_folder() / "exported", layers), open_ended=False)
        except DataError:  # the cache cannot be written to
            with tempfile.TemporaryDirectory() as folder:
                return OnnxSession(_exported(network, self.digest, Path(folder), layers), open_ended=False)


def network_digest(network: Darknet) -> str:
    """Compute the sha256 of a network's cfg and of its parameters as float32.

    Args:
        network: the network.

    Returns:
        The digest in hexadecimal.
    """
    digest = hashlib.sha256(network.cfg_digest().encode())
    for parameter in network.parameters():
        digest.update(parameter.detach().float().cpu().contiguous().numpy().data)
    return digest.hexdigest()


def parameter_versions(parameters: Sequence[nn.Parameter]) -> tuple[object, ...]:
    """List the version counters of parameters, which change whenever a parameter changes.

    Args:
        parameters: the parameters.

    Returns:
        Where each of them is in memory, and how often it was written; None for tensors of inference, which are not
        counted.
    """
    return tuple(
        (parameter.data_ptr(), None if parameter.is_inference() else parameter._version) for parameter in parameters
    )


def _exported(network: Darknet, digest: str, folder: Path, layers: Sequence[int] = ()) -> Path:
    """Find the ONNX model of a network in a folder; exported if it is missing or damaged (sha256 in its name)."""
    # Two processes that export at the same time write the same bytes under the same name.
    source = json.dumps([digest, _VERSION, torch.__version__, *layers])
    key = hashlib.sha256(source.encode()).hexdigest()[:16]
    for path in sorted(folder.glob(f"{key}.*.onnx")):
        with suppress(OSError):
            if sha256(path) == path.name.split(".")[1]:
                return path
    content = network_model(network, "darknet", layers=layers).SerializeToString()
    path = folder / f"{key}.{hashlib.sha256(content).hexdigest()}.onnx"
    write_bytes(path, content)
    return path

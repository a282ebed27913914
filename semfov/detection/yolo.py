"""YOLOv3 (Redmon and Farhadi 2018) as a `Detector`, computed by torch or, as an ONNX model, by onnxruntime."""

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from semfov.detection.darknet import Convolution, Darknet, Head, MaxPool, Route, Shortcut
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import chosen, recorded
from semfov.detection.onnx_session import OnnxSession
from semfov.detection.scores import HALVES, Candidates
from semfov.detection.weights import cache_folder
from semfov.errors import DataError, check, values_known
from semfov.io.files import sha256, write_bytes
from semfov.sensor.lines import constant

Runtime = Literal["auto", "torch", "onnxruntime"]

_VERSION = 1
"""Version of the exported graph; raise it with every change, so that an earlier export is not taken for a new one."""

_OPSET = 17
_IR_VERSION = 8  # IR version from the time of opset 17; some runtimes that could run the model refuse newer versions

_OUTPUTS = ("boxes", "objectness", "classes")


class Graph:
    """A graph under construction: its nodes and constants. Methods that add a node return the name of its output."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def add(self, op: str, *inputs: str, outputs: int = 1, output: str | None = None, **attributes: Any) -> Any:
        """Add a node, and return the name of its output, or the list of names of several outputs."""
        from onnx import helper

        start = f"{op.lower()}_{len(self.nodes)}"
        names = [output or start] if outputs == 1 else [f"{start}_{index}" for index in range(outputs)]
        self.nodes.append(helper.make_node(op, list(inputs), names, **attributes))
        return names[0] if outputs == 1 else names

    def constant(self, values: Tensor | list[int] | list[float] | int | float) -> str:
        """Add a constant; floating-point numbers become float32 unless they are a float64 tensor."""
        from onnx import numpy_helper

        tensor = torch.as_tensor(values)
        single = tensor.is_floating_point() and not isinstance(values, Tensor)
        tensor = tensor.float() if single or tensor.dtype == torch.float16 else tensor
        name = f"constant_{len(self.constants)}"
        self.constants[name] = numpy_helper.from_array(tensor.detach().cpu().contiguous().numpy(), name)
        return name


class _NetworkGraph(Graph):
    """The graph of a Darknet network, in float32."""

    def activation(self, kind: str, source: str) -> str:
        if kind == "linear":
            return source
        if kind == "leaky":
            return self.add("LeakyRelu", source, alpha=0.1)
        if kind == "relu":
            return self.add("Relu", source)
        if kind == "mish":
            return self.add("Mul", source, self.add("Tanh", self.add("Softplus", source)))
        gate = self.add("Sigmoid", source)
        return self.add("Mul", source, gate) if kind == "swish" else gate

    def layer(self, layer: Any, *sources: str) -> str:
        if isinstance(layer, Convolution):
            vertical, horizontal = (int(side) for side in layer.padding)
            convolved = self.add(
                "Conv",
                sources[0],
                self.constant(layer.weight.float()),
                self.constant(layer.bias.float()),  # type: ignore[union-attr]
                strides=list(layer.stride),
                pads=[vertical, horizontal, vertical, horizontal],
                group=layer.groups,
            )
            return self.activation(layer.activation, convolved)
        if isinstance(layer, MaxPool):
            before, after = layer.padding // 2, layer.padding - layer.padding // 2
            return self.add(
                "MaxPool",
                sources[0],
                kernel_shape=[layer.size] * 2,
                strides=[layer.stride] * 2,
                pads=[before, before, after, after],
            )
        if isinstance(layer, nn.Upsample):
            scale = float(layer.scale_factor)  # type: ignore[arg-type]
            scales = self.constant([1.0, 1.0, scale, scale])
            return self.add("Resize", sources[0], "", scales, mode="nearest", nearest_mode="floor",
                            coordinate_transformation_mode="asymmetric")  # fmt: skip
        if isinstance(layer, Route):
            chunks = [
                source if layer.groups == 1 else self.add("Split", source, outputs=layer.groups, axis=1)[layer.group]
                for source in sources
            ]
            return chunks[0] if len(chunks) == 1 else self.add("Concat", *chunks, axis=1)
        if isinstance(layer, Shortcut):
            return self.activation(layer.activation, self.add("Add", *sources))
        return sources[0]

    def decode(self, head: Head, source: str, step: float) -> tuple[str, str, str]:
        """Add `decode_yolo`: boxes `(B, h w A, 4)`, objectness `(B, h w A)` and classes `(B, h w A, K)`."""
        anchors, channels = len(head.anchors), 5 + head.classes
        shape = self.constant([0, anchors, channels, -1])
        cells = self.add("Transpose", self.add("Reshape", source, shape), perm=[0, 3, 1, 2])
        lengths = self.constant([2, 2, 1, head.classes])
        shift, size, objectness, classes = self.add("Split", cells, lengths, outputs=4, axis=3)
        centre = self.add("Mul", self.add("Sigmoid", shift), self.constant(float(head.scale)))
        corner = self.add("Sub", self._corners(source), self.constant((head.scale - 1) / 2))
        centre = self.add("Mul", self.add("Add", centre, corner), self.constant(step))
        half = self.add("Mul", self.add("Exp", size), self.constant((torch.tensor(head.anchors) / 2).float()))
        boxes = self.add("Concat", self.add("Sub", centre, half), self.add("Add", centre, half), axis=3)
        return (
            self.add("Reshape", boxes, self.constant([0, -1, 4])),
            self.add("Reshape", self.add("Sigmoid", objectness), self.constant([0, -1])),
            self.add("Reshape", self.add("Sigmoid", classes), self.constant([0, -1, head.classes])),
        )

    def _corners(self, source: str) -> str:
        """Add the column and row of every cell of a map, `(h w, 1, 2)`, for maps of any size."""
        size = self.add("Shape", source)
        rows, columns = (self.add("Gather", size, self.constant(axis)) for axis in (2, 3))
        count = self.add("Mul", rows, columns)
        cell = self.add("Range", self.constant(0), count, self.constant(1))
        column, row = self.add("Mod", cell, columns), self.add("Div", cell, columns)
        axes = self.constant([1, 2])
        pair = [self.add("Unsqueeze", each, axes) for each in (column, row)]
        return self.add("Cast", self.add("Concat", *pair, axis=2), to=1)


def network_model(network: Darknet, name: str, size: tuple[int, int] | None = None, layers: Sequence[int] = ()) -> Any:
    """The `onnx.ModelProto` of a network for one image `(width, height)`, or any; `layer_0`, … are outputs, too."""
    try:
        from onnx import TensorProto, helper
    except ImportError as error:
        raise ModuleNotFoundError("exporting to ONNX needs the package onnx: pip install onnx") from error
    graph = _NetworkGraph()
    names = {-1: "images"}
    heads = []
    for index, (layer, sources) in enumerate(zip(network.layers, network.sources, strict=True)):
        names[index] = graph.layer(layer, *(names[source] for source in sources))
        if isinstance(layer, Head):
            heads.append(graph.decode(layer, names[index], float(network.steps[index])))
    for output, parts in zip(_OUTPUTS, zip(*heads, strict=True), strict=True):
        graph.add("Concat", *parts, output=output, axis=1)
    for number in layers:
        graph.add("Identity", names[number], output=f"layer_{number}")
    batch, columns, rows = ("batch", "width", "height") if size is None else (1, *size)
    boxes, classes = None if size else "boxes", network.heads[0].classes
    shapes = {"boxes": [batch, boxes, 4], "objectness": [batch, boxes], "classes": [batch, boxes, classes]}
    return helper.make_model(
        helper.make_graph(
            graph.nodes,
            name,
            [helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch, 3, rows, columns])],
            [
                *(helper.make_tensor_value_info(name, TensorProto.FLOAT, shapes[name]) for name in _OUTPUTS),
                *(helper.make_tensor_value_info(f"layer_{layer}", TensorProto.FLOAT, None) for layer in layers),
            ],
            list(graph.constants.values()),
        ),
        producer_name="semfov",
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
    )


class _OnnxTwin:
    """A Darknet network with decoded boxes, computed by onnxruntime on a CPU, in a session for each process."""

    def __init__(self, digest: str, versions: tuple[object, ...] | None = None) -> None:
        self.digest = digest
        self._versions, self._same = versions, versions is not None
        self._opened: dict[tuple[int, ...], tuple[tuple[int, int], OnnxSession]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return _OnnxTwin, (self.digest,)

    def obstacle(self, network: Darknet) -> str | None:
        """The reason, in words, why onnxruntime cannot run the network as it is now; None if it can."""
        parameters = list(network.parameters())
        dtype, devices = parameters[0].dtype, {parameter.device.type for parameter in parameters}
        if devices != {"cpu"}:
            return f"a network on {', '.join(sorted(devices))}"
        if dtype != torch.float32:
            return f"a network of {dtype}"
        if network.channels != 3:
            return f"a network that takes {network.channels} channels"
        versions = _versions(parameters)
        if versions != self._versions:
            self._versions, self._same = versions, _network_digest(network) == self.digest
        return None if self._same else "weights that were changed after loading"

    def obstacle_here(self, network: Darknet, canvas: Tensor) -> str | None:
        """The reason, in words, why onnxruntime cannot run the network on a canvas; None if it can."""
        if not values_known(canvas, *network.parameters()) or torch.jit.is_tracing():  # type: ignore[attr-defined]
            return "graphs that are traced, and function transforms"
        tensors = [canvas, *network.parameters()]
        if any(type(tensor) not in (Tensor, nn.Parameter) for tensor in tensors):
            return "subclasses of tensors"
        reverse = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
        if reverse or any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors):
            return "gradients"
        if canvas.device.type != "cpu":
            return f"a canvas on {canvas.device}"
        return self.obstacle(network)

    def __call__(
        self, network: Darknet, canvas: Tensor, layers: Mapping[str, int]
    ) -> tuple[Candidates, dict[str, Tensor]]:
        """All boxes on a canvas `(B, 3, H, W)`, and maps of layers by name, in float32, without gradients."""
        network.check_image(canvas)
        needed, key = tuple(sorted(set(layers.values()))), (os.getpid(), torch.get_num_threads())
        if needed not in self._opened or self._opened[needed][0] != key:
            try:
                folder = cache_folder() / "exported"
                session = OnnxSession(_exported(network, self.digest, folder, needed), open_ended=False)
            except DataError:  # the cache cannot be written to
                with tempfile.TemporaryDirectory() as own:
                    session = OnnxSession(_exported(network, self.digest, Path(own), needed), open_ended=False)
            self._opened[needed] = key, session
        outputs = self._opened[needed][1](canvas.float())
        candidates = Candidates(outputs["boxes"], outputs["classes"], outputs["objectness"])
        return candidates, {name: outputs[f"layer_{layer}"] for name, layer in layers.items()}


def _network_digest(network: Darknet) -> str:
    """Compute the sha256 of a network's cfg and of its parameters as float32."""
    digest = hashlib.sha256(network.cfg_digest().encode())
    for parameter in network.parameters():
        digest.update(parameter.detach().float().cpu().contiguous().numpy().data)
    return digest.hexdigest()


def _versions(parameters: Sequence[nn.Parameter]) -> tuple[object, ...]:
    """What changes with the parameters."""
    return tuple((p.data_ptr(), None if p.is_inference() else p._version) for p in parameters)


def _exported(network: Darknet, digest: str, folder: Path, layers: Sequence[int] = ()) -> Path:
    """Path of the ONNX model of a network in a folder; exported if it is missing or damaged (sha256 in its name)."""
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


@constant
def _cells(
    size: tuple[int, int],
    canvas: tuple[int, int],
    anchors: tuple[tuple[float, float], ...],
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[Tensor, Tensor, Tensor]:
    """Column and row of every cell `(h, w, 1, 2)`, its size in canvas pixels `(2,)`, and half the anchors `(A, 2)`."""
    axes = [torch.arange(length, device=device, dtype=dtype) for length in size]
    corner = torch.stack(torch.meshgrid(*axes, indexing="xy"), -1)[:, :, None]
    step = [pixels / length for pixels, length in zip(canvas, size, strict=True)]
    return (
        corner,
        torch.tensor(step, dtype=dtype, device=device),
        torch.tensor(anchors, dtype=dtype, device=device) / 2,
    )


def decode_yolo(
    raw: Tensor, anchors: Sequence[tuple[float, float]], canvas: tuple[int, int], scale: float = 1.0
) -> Candidates:
    r"""Decode the raw map of a YOLOv3 head to boxes and scores (Redmon and Farhadi 2018, section 2.1).

    For the cell in column i and row j, with `s` canvas pixels per cell and the anchor `(p_w, p_h)`:

        b_x = (σ(t_x) + i) s,   b_y = (σ(t_y) + j) s,   b_w = p_w exp(t_w),   b_h = p_h exp(t_h)

    Objectness and class scores are `σ(t)`.

    Shapes: raw `(B, A (5 + K), h, w)`.
    """
    batch, channels, rows, columns = raw.shape
    check(channels % len(anchors) == 0, "raw", f"a multiple of {len(anchors)} anchors as channels", tuple(raw.shape))
    cells = raw.permute(0, 2, 3, 1).reshape(batch, rows, columns, len(anchors), -1)
    sizes = tuple((width, height) for width, height in anchors)
    corner, step, halves = _cells((columns, rows), (canvas[0], canvas[1]), sizes, raw.dtype, raw.device)
    centre = (cells[..., 0:2].sigmoid() * scale - (scale - 1) / 2 + corner) * step
    half = cells[..., 2:4].exp() * halves
    boxes = torch.cat([centre - half, centre + half], -1)
    scores = cells[..., 4:].sigmoid()
    return Candidates(boxes.reshape(batch, -1, 4), scores[..., 1:].flatten(1, 3), scores[..., 0].flatten(1))


_RUNTIMES: tuple[Runtime, ...] = ("auto", "torch", "onnxruntime")


class YoloV3(Detector):
    """A Darknet network with YOLOv3 heads as a `Detector`; input_size `(width, height)`; it is differentiable."""

    # With runtime `auto`, onnxruntime computes it on a CPU where that is equal up to rounding, and torch in all other
    # cases.

    def __init__(
        self,
        network: Darknet,
        classes: tuple[str, ...],
        *,
        name: str = "yolov3",
        input_size: tuple[int, int] | None = None,
        stride: int | None = None,
        digest: str = "",
        runtime: Runtime = "torch",
    ) -> None:
        check(runtime in _RUNTIMES, "runtime", " or ".join(map(repr, _RUNTIMES)), repr(runtime))
        size = network.input_size if input_size is None else input_size
        multiple = f"a multiple of {network.stride}"
        whole = all(n > 0 and n % network.stride == 0 for n in size)
        check(whole, "input_size", f"{multiple} along both axes", size)
        fits = stride is None or (isinstance(stride, int) and stride > 0 and stride % network.stride == 0)
        check(fits, "stride", f"None or {multiple}", repr(stride))
        for head in network.heads:
            check(head.classes == len(classes), "classes", f"{head.classes} names", len(classes))
        super().__init__(name, classes, size, stride=stride, digest=digest)
        self.network = network
        self.runtime = runtime
        versions = _versions([*network.parameters()])
        self._twin = None if runtime == "torch" else _OnnxTwin(_network_digest(network), versions)

    def propose(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of all heads on a canvas `(B, 3, H, W)`, RGB in [0, 1]."""
        return self._computed(canvas, {})[0]

    def propose_with_features(
        self, canvas: Tensor, layers: Sequence[str] | None = None
    ) -> tuple[Candidates, dict[str, Tensor]]:
        """Compute all boxes and feature maps in one pass; layers are also named by their number in the cfg."""
        named = self.network.landmarks()
        numbers = {**{str(n): n for n in range(len(self.network.layers))}, **named}
        asked = [*named] if layers is None else layers
        return self._computed(canvas, {layer: numbers[layer] for layer in chosen(asked, [*numbers], self.name)})

    def _computed(self, canvas: Tensor, layers: Mapping[str, int]) -> tuple[Candidates, dict[str, Tensor]]:
        """All boxes of all heads, and the maps of layers by name, by the runtime that this canvas allows."""
        check(canvas.is_floating_point(), "canvas", "floating-point RGB in [0, 1]", canvas.dtype)
        twin = self._twin
        if twin is not None and self._chosen(twin.obstacle_here(self.network, canvas)) == "onnxruntime":
            return twin(self.network, canvas, layers)
        with recorded({layer: self.network.layers[number] for layer, number in layers.items()}) as found:
            maps = self.network(canvas.to(next(self.network.parameters()).dtype))
        maps = [raw.float() if raw.dtype in HALVES else raw for raw in maps]
        size = (canvas.shape[-1], canvas.shape[-2])
        heads = zip(maps, self.network.heads, strict=True)
        candidates = [decode_yolo(raw, head.anchors, size, head.scale) for raw, head in heads]
        whole = Candidates(
            torch.cat([some.boxes for some in candidates], 1),
            torch.cat([some.classes for some in candidates], 1),
            torch.cat([some.objectness for some in candidates if some.objectness is not None], 1),
        )
        return whole, {layer: each[0] for layer, each in found.items()}

    def head_input(self, canvas: Tensor) -> Tensor:
        """Compute the input of the last convolution before the first head, by torch with any runtime."""
        return self.network.features(canvas.to(next(self.network.parameters()).dtype))

    def _chosen(self, obstacle: str | None) -> Runtime:
        """The runtime to use; `obstacle` is the reason why onnxruntime cannot be used."""
        if obstacle is None:
            return "onnxruntime"
        check(self.runtime == "auto", "runtime", f"'auto' or 'torch' for {obstacle}", repr(self.runtime))
        return "torch"

    def settings(self) -> dict[str, object]:
        """List the settings that the detections depend on; `runtime` is the one that is used without gradients."""
        return super().settings() | {
            "cfg": self.network.cfg_digest(),
            "runtime": "torch" if self._twin is None else self._chosen(self._twin.obstacle(self.network)),
            "dtype": str(next(self.network.parameters()).dtype),
        }

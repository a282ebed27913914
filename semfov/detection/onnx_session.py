"""An ONNX model, checked before memory is allocated, in onnxruntime, called with torch tensors."""

import math
import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from semfov.detection.feature_maps import NetworkStep, stride_of
from semfov.errors import DataError, check, check_data
from semfov.io.files import check_regular, inside, reading
from semfov.io.schema import excerpt

_FLOATS = {"tensor(float)": torch.float32, "tensor(float16)": torch.float16, "tensor(double)": torch.float64}

# Further inputs of some exported detectors, made from the canvas: sizes and scales for mapping boxes.
_EXTRA_INPUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "orig_target_sizes": lambda canvas: torch.tensor([[canvas.shape[3], canvas.shape[2]]] * canvas.shape[0]),
    "im_shape": lambda canvas: canvas.new_tensor([[canvas.shape[2], canvas.shape[3]]] * canvas.shape[0]),
    "scale_factor": lambda canvas: canvas.new_ones(canvas.shape[0], 2),
}

_MOST_ELEMENTS = 2**28  # largest number of elements of a tensor in a model; 1 GiB as float32
_MOST_METADATA = 2**20  # largest number of characters of a model's metadata
_USUAL_SIDE = 640  # side of a picture with which open sizes are tried out
_WITH_GRAPHS = {"Loop", "Scan", "If"}  # operations with graphs of their own, whose steps are not counted
_MOST_MEMORY = 2**29  # bytes for the tensors of models whose sizes depend on values, all together
_MOST_SECONDS = 10.0  # longest pass of such a model for one image
_MOST_REASON = 400  # largest number of characters of onnxruntime's reasons that a message has

_Provider = str | tuple[str, Mapping[str, Any]]
"""An execution provider of onnxruntime: its name, alone or with its options."""

_MOST_BATCH = 1024  # largest fixed batch size of a model


class OnnxSession:
    """An inference session of one ONNX file; idle threads do not spin, which would slow down torch's next operation."""

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        threads: int | None = None,
        device: torch.device | str = "cpu",
        providers: Sequence[_Provider] | None = None,
        spinning: bool = False,
        open_ended: bool | None = None,
        further: Sequence[str] = (),
    ) -> None:
        import onnxruntime as ort

        ort.disable_telemetry_events()
        self.path = Path(path)
        self.threads = torch.get_num_threads() if threads is None else threads
        check(self.threads > 0, "threads", "at least one", self.threads)
        self.providers = None if providers is None else tuple(providers)
        options = ort.SessionOptions()
        options.intra_op_num_threads = self.threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # exceptions say all, and some exporters leave a warning for every initialiser
        options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spinning)))
        self.open_ended = check_file(self.path) if open_ended is None else open_ended
        # What makes a session of the same model with the same settings.
        shared: dict[str, Any] = {
            "threads": self.threads,
            "device": device,
            "providers": self.providers,
            "spinning": spinning,
        }
        self._again = partial(OnnxSession, self.path, **shared, open_ended=self.open_ended)
        self._further = tuple(further)
        if self.open_ended:
            _limit_memory()
            options.add_session_config_entry("session.use_env_allocators", "1")
        chosen = _providers(torch.device(device), self.providers)
        try:
            # onnxruntime's fallback would print messages and try the same again.
            model: str | bytes = fspath(path)
            if further:
                import onnx

                wider = onnx.load(self.path, load_external_data=False)  # weights in other files stay there
                have = {output.name for output in wider.graph.output}
                wider.graph.output.extend(onnx.ValueInfoProto(name=name) for name in further if name not in have)
                model = wider.SerializeToString()
                folder = "session.model_external_initializers_file_folder_path"
                options.add_session_config_entry(folder, fspath(self.path.parent))
            self._session = ort.InferenceSession(model, options, providers=chosen, disable_fallback=1)
        except Exception as error:  # onnxruntime's own exceptions share no base class
            raise DataError(f"cannot load the ONNX model {str(path)!r}: {_reason(error)}") from error
        try:
            meta = self._session.get_modelmeta()
            self.metadata: dict[str, str] = dict(meta.custom_metadata_map)
            self.producer: str = meta.producer_name
            for output in self._session.get_outputs():
                name = f"{self.path.name}: output {output.name!r}"
                check(output.type in _FLOATS, name, "floating-point numbers", output.type)
            self.outputs = tuple((o.name, _sizes(o.shape)) for o in self._session.get_outputs())
            self.image, self.shape, self._dtype, self._extra = self._inputs()
        except UnicodeDecodeError as error:
            raise DataError(f"cannot load the ONNX model {str(path)!r}: its names are not text ({error})") from None
        check((self.shape[0] or 1) <= _MOST_BATCH, "batch", f"at most {_MOST_BATCH} images at once", self.shape[0])

    def _inputs(self) -> tuple[str, tuple[int | None, ...], torch.dtype, list[str]]:
        """Name, shape and dtype of the image input, and the names of the other inputs."""
        inputs = self._session.get_inputs()
        images = [i for i in inputs if len(i.shape) == 4 and i.type in _FLOATS]
        description = ", ".join(f"{i.name} {i.shape} {i.type}" for i in inputs)
        fits = len(images) == 1 and _sizes(images[0].shape)[1] in (3, None)
        check(fits, self.path.name, "one floating-point input (B, 3, H, W)", description)
        extra = [i.name for i in inputs if i is not images[0]]
        known = f"no inputs but an image and {', '.join(_EXTRA_INPUTS)}"
        check(set(extra) <= set(_EXTRA_INPUTS), self.path.name, known, description)
        return images[0].name, _sizes(images[0].shape), _FLOATS[images[0].type], extra

    def __call__(self, image: Tensor) -> dict[str, Tensor]:
        """Run the model on images `(B, 3, H, W)`, without gradients, in parts where its batch size is fixed."""
        batch, fixed = image.shape[0], self.shape[0]
        check(batch > 0, "image", "at least one image", batch)
        size = batch if fixed is None else fixed
        source = image.detach().to(device="cpu", dtype=self._dtype)
        short = -batch % size
        if short:
            source = torch.cat([source, source[-1:].expand(short, -1, -1, -1)])
        size = 1 if self.open_ended and fixed is None else size  # each has all the memory
        runs = [self._run(part.contiguous()) for part in source.split(size)]
        joined = runs[0] if len(runs) == 1 else {name: torch.cat([run[name] for run in runs]) for name in runs[0]}
        return {name: joined[name][:batch].to(image) for name, _ in self.outputs}

    def _run(self, image: Tensor) -> dict[str, Tensor]:
        feed = {self.image: image.numpy()} | {name: _EXTRA_INPUTS[name](image).numpy() for name in self._extra}
        names = [name for name, _ in self.outputs]
        try:
            arrays = self._limited(names, feed) if self.open_ended else self._session.run(names, feed)
        except Exception as error:  # as above
            reason = _reason(error)
            if "terminate flag" in reason:
                reason = f"not done after {_MOST_SECONDS:.0f} s, as with a loop that does not end"
            elif "Available memory" in reason:
                reason = f"its tensors need more than {_MOST_MEMORY >> 20} MiB, as with too many boxes; {reason}"
            raise DataError(f"{self.path.name}: fails on images of shape {tuple(image.shape)}: {reason}") from error
        for name, array in zip(names, arrays, strict=True):
            expected, got = f"a row for each of {len(image)} images", f"shape {array.shape}"
            check(array.shape[:1] == (len(image),), f"{self.path.name}: output {name!r}", expected, got)
        return dict(zip(names, map(torch.from_numpy, arrays), strict=True))

    def _limited(self, names: list[str], feed: dict[str, Any]) -> Any:
        """The outputs of a run that is stopped after some time."""
        import onnxruntime as ort

        options = ort.RunOptions()
        options.log_severity_level = 4
        timer = threading.Timer(_MOST_SECONDS * len(feed[self.image]), setattr, (options, "terminate", True))
        timer.daemon = True
        timer.start()
        try:
            return self._session.run(names, feed, options)
        finally:
            timer.cancel()

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(self._again, further=self._further), ()

    def widened(self, further: Sequence[str]) -> "OnnxSession":
        """A session of the same model, with the same settings, that also returns tensors inside it."""
        return self._again(further=further)

    def probe(self, size: tuple[int, int]) -> dict[str, Tensor]:
        """Outputs in their shapes for one canvas: zeros where the model states all, else the outputs of a run."""
        stated = {name: [n for n in shape[1:] if n is not None] for name, shape in self.outputs}
        for name, sizes in stated.items():
            _check_elements(f"{self.path.name}: output {name!r}", sizes)
        if not self.open_ended and all(shape and len(stated[name]) == len(shape) - 1 for name, shape in self.outputs):
            return {name: torch.zeros(1, *sizes) for name, sizes in stated.items()}
        return self(torch.zeros(1, 3, size[1], size[0]))

    def steps(self, canvas: tuple[int, int]) -> list[NetworkStep]:
        """The steps of a model in order, with the strides of the maps of a canvas `(width, height)`."""
        import onnx

        model = _without_weights(onnx.load(self.path, load_external_data=False))
        sides = next(value for value in model.graph.input if value.name == self.image).type.tensor_type.shape.dim
        for side, size in zip(sides, (1, 3, canvas[1], canvas[0]), strict=True):
            side.dim_value = size
        graph = onnx.shape_inference.infer_shapes(model, data_prop=True).graph
        shapes = {value.name: _dims(value) for value in [*graph.value_info, *graph.output]}
        steps, reached = [], {self.image}  # stored weights are no maps
        for node in graph.node:
            reached.update(node.output if reached.intersection(node.input) else ())
            for output in node.output:
                shape = shapes.get(output, [])
                is_map = output in reached and len(shape) == 4 and min(shape[2:]) > 1
                stride = stride_of(canvas[0], shape[3]) if is_map else None
                steps.append(NetworkStep(output, stride, tuple(node.input), node.op_type == "Conv"))
        return steps


def check_file(path: Path) -> bool:
    """Check that tensors are not too large and that weights lie in the model's folder, by shape inference alone."""
    import onnx

    name = f"ONNX model {str(path)!r}"
    with reading(path, name):
        path.stat()
    try:
        model = onnx.load(path, load_external_data=False)
        stored = [*model.graph.initializer]
        for tensor in stored:
            for entry in tensor.external_data:
                if entry.key == "location":
                    check_regular(inside(path.parent, entry.value))
        for tensor in stored:
            _check_elements(f"{name}: tensor {excerpt(tensor.name)}", tensor.dims)
        length = sum(len(entry.key) + len(entry.value) for entry in model.metadata_props)
        check_data(length <= _MOST_METADATA, name, f"at most {_MOST_METADATA:,} characters of metadata", f"{length:,}")
        slim = _without_weights(model)
        for value in slim.graph.input:  # sizes that a model leaves open follow from those of the picture
            for place, side in enumerate(value.type.tensor_type.shape.dim):
                if not side.dim_value:
                    side.dim_value = _USUAL_SIDE if place > 1 else 1
        inferred = onnx.shape_inference.infer_shapes(slim, data_prop=True).graph
    except DataError:
        raise
    except Exception as error:  # protobuf's and ONNX's own exceptions share no base class
        reason = " ".join(str(error).split())[-400:]
        raise DataError(f"cannot load the {name}: {reason}") from None
    values = [*inferred.value_info, *inferred.input, *inferred.output]
    for value in values:
        _check_elements(f"{name}: tensor {excerpt(value.name)}", _dims(value))
    known = {
        value.name for value in values if all(each.HasField("dim_value") for each in value.type.tensor_type.shape.dim)
    }
    steps = {node.op_type for node in model.graph.node}
    made = {output for node in model.graph.node for output in node.output if output}
    return not made <= known or bool(steps & _WITH_GRAPHS) or bool(model.functions)


def _check_elements(name: str, sizes: Iterable[int]) -> None:
    """Raise `DataError` for a tensor of more than `_MOST_ELEMENTS` numbers."""
    sizes = list(sizes)
    fits = min(sizes, default=0) >= 0 and math.prod(sizes) <= _MOST_ELEMENTS
    check_data(fits, name, f"at most {_MOST_ELEMENTS:,} numbers", f"sizes {excerpt(sizes)}")


def _dims(value: Any) -> list[int]:
    """Sizes of a value; unknown sizes count as 1."""
    return [d.dim_value if d.HasField("dim_value") else 1 for d in value.type.tensor_type.shape.dim]


def _without_weights(model: Any) -> Any:
    """The model without its large tensors: shapes may depend on values of small tensors only."""
    import onnx

    slim = onnx.ModelProto()
    slim.CopyFrom(model)
    stored = [*slim.graph.initializer]
    del slim.graph.initializer[:]
    for tensor in stored:
        if math.prod(tensor.dims) <= 1024:
            slim.graph.initializer.append(tensor)
        else:
            shape = onnx.helper.make_tensor_value_info(tensor.name, tensor.data_type, list(tensor.dims))
            slim.graph.input.append(shape)
    return slim


@cache
def _limit_memory() -> None:
    """Register a limited allocator, which sessions use that ask for it."""
    import onnxruntime as ort

    kinds = ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT
    limits = ort.OrtArenaCfg({"max_mem": _MOST_MEMORY, "arena_extend_strategy": 1})
    ort.create_and_register_allocator(ort.OrtMemoryInfo("Cpu", *kinds), limits)


def _reason(error: Exception) -> str:
    """Onnxruntime's own words, whose end says most."""
    text = " ".join(str(error).split()).rpartition("Status Message: ")[2]
    text = re.sub(r"/\S+:\d+ .*?\) ", "", text, count=1)  # where in its source
    return text if len(text) <= _MOST_REASON else f"…{text[-_MOST_REASON:]}"


def _providers(device: torch.device, providers: Sequence[_Provider] | None) -> list[Any]:
    """The given execution providers; else those for a device, then the CPU's for what it does not support."""
    import onnxruntime as ort

    have = ort.get_available_providers()
    if providers is not None:
        names = [provider if isinstance(provider, str) else provider[0] for provider in providers]
        missing = [name for name in names if name not in have]
        check(bool(names) and not missing, "providers", f"some of {', '.join(have)}", ", ".join(missing) or "none")
        return list(providers)
    if device.type == "cpu":
        return ["CPUExecutionProvider"]
    provider = f"{device.type.upper()}ExecutionProvider"
    got = f"{device} (its providers: {', '.join(have)})"
    check(provider in have, "device", "a device that onnxruntime can use", got)
    return [(provider, {"device_id": device.index or 0}), "CPUExecutionProvider"]


def _sizes(shape: Sequence[int | str | None]) -> tuple[int | None, ...]:
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape)

"""An ONNX model, checked before memory is allocated, in onnxruntime, called with torch tensors."""

import atexit
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import cache, partial
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from semfov.detection.feature_maps import NetworkStep, stride_of
from semfov.detection.onnx_budget import check_elements, dims, without_weights
from semfov.detection.onnx_check import check_file
from semfov.errors import DataError, check

_WHOLE = "tensor(int64)", "tensor(int32)"  # of outputs that number classes and boxes
_FLOATS = {"tensor(float)": torch.float32, "tensor(float16)": torch.float16, "tensor(double)": torch.float64}

# Further inputs of some exported detectors, made from the canvas: sizes and scales for mapping boxes.
_EXTRA_INPUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "orig_target_sizes": lambda canvas: torch.tensor([[canvas.shape[3], canvas.shape[2]]] * canvas.shape[0]),
    "im_shape": lambda canvas: canvas.new_tensor([[canvas.shape[2], canvas.shape[3]]] * canvas.shape[0]),
    "scale_factor": lambda canvas: canvas.new_ones(canvas.shape[0], 2),
}

_MOST_MEMORY = 2**29  # bytes for the tensors of models whose sizes depend on values, all together
_MOST_SECONDS = 10.0  # longest pass of such a model for one image, and longest time until it is loaded
_LAST_SECONDS = 5.0  # for which the end of the process waits for an operation that was given up
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
            load = partial(ort.InferenceSession, model, options, providers=chosen, disable_fallback=1)
            # What it computes of stored values alone, when a model is loaded, is stopped by nothing.
            self._session = (
                _in_time(partial(load, disabled_optimizers=["ConstantFolding"])) if self.open_ended else load()
            )
        except Exception as error:  # onnxruntime's own exceptions share no base class
            raise DataError(f"cannot load the ONNX model {str(path)!r}: {_reason(error)}") from error
        try:
            meta = self._session.get_modelmeta()
            self.metadata: dict[str, str] = dict(meta.custom_metadata_map)
            self.producer: str = meta.producer_name
            for output in self._session.get_outputs():
                name = f"{self.path.name}: output {output.name!r}"
                check(output.type in (*_FLOATS, *_WHOLE), name, "numbers", output.type)
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
            if "Available memory" in reason:
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
        try:
            return _in_time(partial(self._session.run, names, feed, options), len(feed[self.image]))
        finally:
            options.terminate = True  # read between two operations; the last one goes on

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(self._again, further=self._further), ()

    def widened(self, further: Sequence[str]) -> "OnnxSession":
        """A session of the same model, with the same settings, that also returns tensors inside it."""
        return self._again(further=further)

    def probe(self, size: tuple[int, int]) -> dict[str, Tensor]:
        """Outputs in their shapes for one canvas: zeros where the model states all, else the outputs of a run."""
        stated = {name: [n for n in shape[1:] if n is not None] for name, shape in self.outputs}
        for name, sizes in stated.items():
            check_elements(f"{self.path.name}: output {name!r}", sizes)
        if not self.open_ended and all(shape and len(stated[name]) == len(shape) - 1 for name, shape in self.outputs):
            return {name: torch.zeros(1, *sizes) for name, sizes in stated.items()}
        return self(torch.zeros(1, 3, size[1], size[0]))

    def steps(self, canvas: tuple[int, int]) -> list[NetworkStep]:
        """The steps of a model in order, with the strides of the maps of a canvas `(width, height)`."""
        import onnx

        model = without_weights(onnx.load(self.path, load_external_data=False))
        sides = next(value for value in model.graph.input if value.name == self.image).type.tensor_type.shape.dim
        for side, size in zip(sides, (1, 3, canvas[1], canvas[0]), strict=True):
            side.dim_value = size
        graph = onnx.shape_inference.infer_shapes(model, data_prop=True).graph
        shapes = {value.name: dims(value) for value in [*graph.value_info, *graph.output]}
        steps, reached = [], {self.image}  # stored weights are no maps
        for node in graph.node:
            reached.update(node.output if reached.intersection(node.input) else ())
            for output in node.output:
                shape = shapes.get(output, [])
                is_map = output in reached and len(shape) == 4 and min(shape[2:]) > 1
                stride = stride_of(canvas[0], shape[3]) if is_map else None
                steps.append(NetworkStep(output, stride, tuple(node.input), node.op_type == "Conv"))
        return steps


def _in_time(call: Callable[[], Any], passes: int = 1) -> Any:
    """What a call returns, unless it takes longer than a number of passes may."""
    # No operation can be stopped from outside: one that does not end goes on in its thread, for which none waits.
    future: Future[Any] = Future()

    def work() -> None:
        try:
            future.set_result(call())
        except BaseException as error:  # raised again where the result is asked for
            future.set_exception(error)

    seconds = _MOST_SECONDS * passes
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        return future.result(seconds)
    except TimeoutError:
        atexit.register(thread.join, _LAST_SECONDS)  # one that returns while Python ends would abort the process
        raise DataError(f"not done after {seconds:.0f} s, as with a loop that does not end") from None


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

"""An ONNX model, checked before memory is allocated, in onnxruntime, called with torch tensors.

Models whose sizes or work depend on values are *open-ended*: no check of the file bounds what a pass takes. They run
with an allocator of limited memory, image by image, and in a thread that is given up after some time.
"""

from __future__ import annotations

import atexit
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import cache, partial
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.detection.feature_maps import NetworkStep, stride_of
from semfov.detection.onnx_budget import check_elements, dims, without_weights
from semfov.detection.onnx_cells import Canvas
from semfov.detection.onnx_check import check_file
from semfov.errors import DataError, check

if TYPE_CHECKING:
    from onnxruntime import InferenceSession, SessionOptions

_INTEGERS = "tensor(int64)", "tensor(int32)"  # of outputs that number classes and boxes
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
_MOST_BATCH = 1024  # largest fixed batch size of a model

Provider = str | tuple[str, Mapping[str, object]]
"""An execution provider of onnxruntime: its name, alone or with its options."""

_Sizes = tuple[int | None, ...]
"""A shape, with None for sizes that are open."""

_Result = TypeVar("_Result")
_Arrays = dict[str, NDArray[np.generic]]


class _Inputs(NamedTuple):
    """Inputs of a model: name, shape and dtype of the images, and the names of the others, all in `_EXTRA_INPUTS`."""

    image: str
    shape: _Sizes
    dtype: torch.dtype
    extra: tuple[str, ...]


class OnnxSession:
    """An inference session of one ONNX file; idle threads do not spin, which would slow down torch's next operation.

    Attributes:
        path: the ONNX file.
        threads: number of onnxruntime's threads.
        providers: the execution providers that were asked for, if any.
        open_ended: whether the sizes or the work of a pass depend on values.
        metadata: texts in the model by key.
        producer: the program that exported the model.
        outputs: name and shape of each output.
        image: name of the input for images.
        shape: shape of the input for images, `(B, 3, H, W)`.

    Private attributes: `_again` makes a session of the same model with the same settings, in another process, or with
    further outputs; `_further` names those of this session. `_session` is onnxruntime's, `_inputs` what it takes.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        threads: int | None = None,
        device: torch.device | str = "cpu",
        providers: Sequence[Provider] | None = None,
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
        self.open_ended = check_file(self.path) if open_ended is None else open_ended
        self._again = partial(
            OnnxSession,
            self.path,
            threads=self.threads,
            device=device,
            providers=self.providers,
            spinning=spinning,
            open_ended=self.open_ended,
        )
        self._further = tuple(further)
        chosen = _chosen_providers(torch.device(device), self.providers)
        options = self._options(spinning)
        try:
            self._session = self._opened(options, chosen)
        except Exception as error:  # onnxruntime's own exceptions share no base class
            raise DataError(f"cannot load the ONNX model {str(path)!r}: {_reason(error)}") from error
        try:
            self._read_model()
        except UnicodeDecodeError as error:
            raise DataError(f"cannot load the ONNX model {str(path)!r}: its names are not text ({error})") from None
        batch = self.shape[0]
        check(batch is None or batch <= _MOST_BATCH, "batch", f"at most {_MOST_BATCH} images at once", batch)

    def _options(self, spinning: bool) -> SessionOptions:
        """Make onnxruntime's options."""
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = self.threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # exceptions say all, and some exporters leave a warning for every initialiser
        options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spinning)))
        if self.open_ended:
            _limit_memory()
            options.add_session_config_entry("session.use_env_allocators", "1")
        if self._further:
            # Such a model is loaded from memory, while its weights may stay in other files.
            folder = "session.model_external_initializers_file_folder_path"
            options.add_session_config_entry(folder, fspath(self.path.parent))
        return options

    def _opened(self, options: SessionOptions, providers: Sequence[Provider]) -> InferenceSession:
        """Open the model in onnxruntime, in limited time where it is open-ended."""
        import onnxruntime as ort

        model = self._model_with_further_outputs() if self._further else fspath(self.path)
        # onnxruntime's fallback would print messages and try the same again.
        load = partial(ort.InferenceSession, model, options, providers=providers, disable_fallback=1)
        if not self.open_ended:
            return load()
        # What it computes of stored values alone, when a model is loaded, is stopped by nothing.
        return _in_time(partial(load, disabled_optimizers=["ConstantFolding"]))

    def _model_with_further_outputs(self) -> bytes:
        """Make the model that also returns the tensors inside it that are asked for."""
        import onnx

        model = onnx.load(self.path, load_external_data=False)
        names = {output.name for output in model.graph.output}
        model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in self._further if name not in names)
        return model.SerializeToString()

    def _read_model(self) -> None:
        """Read metadata, outputs and inputs; raises `InputError` for others than detectors have."""
        model = self._session.get_modelmeta()
        self.metadata: dict[str, str] = dict(model.custom_metadata_map)
        self.producer: str = model.producer_name
        outputs = self._session.get_outputs()
        for output in outputs:
            name = f"{self.path.name}: output {output.name!r}"
            check(output.type in (*_FLOATS, *_INTEGERS), name, "numbers", output.type)
        self.outputs: tuple[tuple[str, _Sizes], ...] = tuple((o.name, _sizes(o.shape)) for o in outputs)
        self._inputs = self._read_inputs()
        self.image = self._inputs.image
        self.shape = self._inputs.shape

    def _read_inputs(self) -> _Inputs:
        """Find the input for images, and the others."""
        inputs = self._session.get_inputs()
        images = [node for node in inputs if len(node.shape) == 4 and node.type in _FLOATS]
        description = ", ".join(f"{node.name} {node.shape} {node.type}" for node in inputs)
        takes_rgb = len(images) == 1 and _sizes(images[0].shape)[1] in (3, None)
        check(takes_rgb, self.path.name, "one floating-point input (B, 3, H, W)", description)
        image = images[0]
        others = tuple(node.name for node in inputs if node is not image)
        expected = f"no inputs but an image and {', '.join(_EXTRA_INPUTS)}"
        check(set(others) <= set(_EXTRA_INPUTS), self.path.name, expected, description)
        return _Inputs(image.name, _sizes(image.shape), _FLOATS[image.type], others)

    def __call__(self, image: Tensor) -> dict[str, Tensor]:
        """Run the model on images, without gradients, in parts where its batch size is fixed.

        Args:
            image: `(B, 3, H, W)`, as the network takes them.

        Returns:
            The outputs by name, each with a row for each image, in the dtype and on the device of the images.

        Raises:
            DataError: the model fails.
        """
        batch = image.shape[0]
        check(batch > 0, "image", "at least one image", batch)
        source = image.detach().to(device="cpu", dtype=self._inputs.dtype)
        size = self._images_a_run(batch)
        missing = -batch % size
        if missing:  # a fixed batch is filled up with the last image
            source = torch.cat([source, source[-1:].expand(missing, -1, -1, -1)])
        runs = [self._run(part.contiguous()) for part in source.split(size)]
        outputs = {}
        for name, _ in self.outputs:
            parts = [run[name] for run in runs]
            rows = parts[0] if len(parts) == 1 else torch.cat(parts)  # one part needs no copy
            outputs[name] = rows[:batch].to(image)
        return outputs

    def _images_a_run(self, batch: int) -> int:
        """Choose how many images of a batch run at once."""
        fixed = self.shape[0]
        if fixed is not None:
            return fixed
        return 1 if self.open_ended else batch  # of an open-ended model, an image has all the memory

    def _run(self, image: Tensor) -> dict[str, Tensor]:
        """Run the model once, on images `(B, 3, H, W)` on the CPU in the dtype of its input."""
        names = [name for name, _ in self.outputs]
        feed = {self.image: image.numpy()}
        for name in self._inputs.extra:
            feed[name] = _EXTRA_INPUTS[name](image).numpy()
        try:
            arrays = self._run_in_time(names, feed) if self.open_ended else self._session.run(names, feed)
        except Exception as error:  # onnxruntime's own exceptions share no base class
            reason = _reason(error)
            if "Available memory" in reason:
                reason = f"its tensors need more than {_MOST_MEMORY >> 20} MiB, as with too many boxes; {reason}"
            raise DataError(f"{self.path.name}: fails on images of shape {tuple(image.shape)}: {reason}") from error
        outputs = {}
        for name, array in zip(names, arrays, strict=True):
            rows = f"a row for each of {len(image)} images"
            check(array.shape[:1] == (len(image),), f"{self.path.name}: output {name!r}", rows, f"shape {array.shape}")
            outputs[name] = torch.from_numpy(array)
        return outputs

    def _run_in_time(self, names: list[str], feed: _Arrays) -> list[NDArray[np.generic]]:
        """Run the model, and stop it after some time."""
        import onnxruntime as ort

        options = ort.RunOptions()
        options.log_severity_level = 4
        try:
            return _in_time(partial(self._session.run, names, feed, options), len(feed[self.image]))
        finally:
            options.terminate = True  # read between two operations; the last one goes on

    def __reduce__(self) -> tuple[Callable[[], OnnxSession], tuple[()]]:
        return partial(self._again, further=self._further), ()

    def with_outputs(self, further: Sequence[str]) -> OnnxSession:
        """Open the model once more, with the same settings, so that it also returns tensors inside it.

        Args:
            further: names of the tensors.

        Returns:
            The session, with these outputs after those of the model.
        """
        return self._again(further=further)

    def probe(self, size: Canvas) -> dict[str, Tensor]:
        """Find the shapes of the outputs for one canvas.

        Args:
            size: `(width, height)` of the canvas.

        Returns:
            Outputs by name: zeros where the model states all shapes, else the outputs of a run.
        """
        shapes: dict[str, list[int]] = {}
        are_stated = True
        for name, shape in self.outputs:
            sizes = shape[1:]  # the first one is that of the batch
            shapes[name] = [size for size in sizes if size is not None]
            check_elements(f"{self.path.name}: output {name!r}", shapes[name])
            are_stated = are_stated and bool(shape) and None not in sizes
        if are_stated and not self.open_ended:
            return {name: torch.zeros(1, *sizes) for name, sizes in shapes.items()}
        width, height = size
        return self(torch.zeros(1, 3, height, width))

    def steps(self, canvas: Canvas) -> list[NetworkStep]:
        """List the steps of the model in order, with the strides of their maps.

        Args:
            canvas: `(width, height)` in pixels.

        Returns:
            A step for each tensor that is computed.
        """
        import onnx

        model = without_weights(onnx.load(self.path, load_external_data=False))
        image = next(value for value in model.graph.input if value.name == self.image)
        sizes = (1, 3, canvas[1], canvas[0])
        for side, size in zip(image.type.tensor_type.shape.dim, sizes, strict=True):
            side.dim_value = size
        graph = onnx.shape_inference.infer_shapes(model, data_prop=True).graph
        shapes = {value.name: dims(value) for value in [*graph.value_info, *graph.output]}
        steps = []
        of_image = {self.image}  # tensors that are computed from the image; others are stored weights, and no maps
        for node in graph.node:
            reads = tuple(node.input)
            if not of_image.isdisjoint(reads):
                of_image.update(node.output)
            for output in node.output:
                shape = shapes.get(output, [])
                is_map = output in of_image and len(shape) == 4 and min(shape[2:]) > 1
                stride = stride_of(canvas[0], shape[3]) if is_map else None
                steps.append(NetworkStep(output, stride, reads, node.op_type == "Conv"))
        return steps


def _in_time(call: Callable[[], _Result], passes: int = 1) -> _Result:
    """Return what a call returns, unless it takes longer than a number of passes may."""
    # No operation can be stopped from outside: one that does not end goes on in its thread, for which none waits.
    future: Future[_Result] = Future()

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

    memory = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
    limits = ort.OrtArenaCfg({"max_mem": _MOST_MEMORY, "arena_extend_strategy": 1})
    ort.create_and_register_allocator(memory, limits)


def _reason(error: Exception) -> str:
    """Shorten onnxruntime's own words to their end, which says most."""
    text = " ".join(str(error).split()).rpartition("Status Message: ")[2]
    text = re.sub(r"/\S+:\d+ .*?\) ", "", text, count=1)  # where in its source
    return text if len(text) <= _MOST_REASON else f"…{text[-_MOST_REASON:]}"


def _chosen_providers(device: torch.device, providers: Sequence[Provider] | None) -> list[Provider]:
    """Choose the providers asked for; else those for a device, and the CPU's for what it does not support."""
    import onnxruntime as ort

    available = ort.get_available_providers()
    if providers is not None:
        _check_providers(providers, available)
        return list(providers)
    if device.type == "cpu":
        return ["CPUExecutionProvider"]
    provider = f"{device.type.upper()}ExecutionProvider"  # as onnxruntime names them: CUDAExecutionProvider
    got = f"{device} (its providers: {', '.join(available)})"
    check(provider in available, "device", "a device that onnxruntime can use", got)
    return [(provider, {"device_id": device.index or 0}), "CPUExecutionProvider"]


def _check_providers(providers: Sequence[Provider], available: Sequence[str]) -> None:
    """Raise `InputError` for providers that onnxruntime does not have here."""
    names = [provider if isinstance(provider, str) else provider[0] for provider in providers]
    missing = [name for name in names if name not in available]
    got = ", ".join(missing) or "none"
    check(bool(names) and not missing, "providers", f"some of {', '.join(available)}", got)


def _sizes(shape: Sequence[int | str | None]) -> _Sizes:
    """Take the sizes of a shape that are numbers; onnxruntime has names for the others."""
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape)

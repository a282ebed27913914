"""An ONNX model in onnxruntime, called with torch tensors."""

import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from semfov.detection.onnx_file import check_file
from semfov.errors import DataError, InputError, check

_FLOATS = {"tensor(float)": torch.float32, "tensor(float16)": torch.float16, "tensor(double)": torch.float64}

# Further inputs of some exported detectors, made from the canvas: sizes and scales for mapping boxes.
_EXTRA_INPUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "orig_target_sizes": lambda canvas: _repeat(canvas, [canvas.shape[-1], canvas.shape[-2]]),
    "im_shape": lambda canvas: _repeat(canvas, [canvas.shape[-2], canvas.shape[-1]]).to(canvas.dtype),
    "scale_factor": lambda canvas: canvas.new_ones(canvas.shape[0], 2),
}

_MOST_MEMORY = 2**29
"""Bytes for the tensors of models whose sizes depend on values, all together."""
_MOST_SECONDS = 10.0
"""Longest pass of such a model for one image."""
_MOST_REASON = 400
"""Largest number of characters of onnxruntime's reasons that a message has."""

Provider = str | tuple[str, Mapping[str, Any]]
"""An execution provider of onnxruntime: its name, alone or with its options."""

_MOST_BATCH = 1024
"""Largest fixed batch size of a model."""


def _with_outputs(path: Path, names: Iterable[str]) -> bytes:
    """The content of a model with further tensors among its outputs; weights in other files stay there."""
    import onnx

    model = onnx.load(path, load_external_data=False)
    have = {output.name for output in model.graph.output}
    model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names if name not in have)
    return model.SerializeToString()


class OnnxSession:
    """An inference session of one ONNX file.

    Spinning is off, because idle threads that spin slow down the next torch operation by an order of magnitude.

    Shapes: . `further` names tensors inside the model that are outputs too; `open_ended`.
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
        options = ort.SessionOptions()
        options.intra_op_num_threads = self.threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # exceptions say all, and some exporters leave a warning for every initialiser
        options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spinning)))
        self.open_ended = check_file(self.path) if open_ended is None else open_ended
        self._settings: dict[str, Any] = {
            "threads": self.threads,
            "device": device,
            "providers": self.providers,
            "spinning": spinning,
        }
        self._settings |= {"open_ended": self.open_ended, "further": tuple(further)}
        if self.open_ended:
            _limit_memory()
            options.add_session_config_entry("session.use_env_allocators", "1")
        try:
            chosen = _providers(torch.device(device), self.providers)
            # onnxruntime's fallback would print messages and try the same again.
            model: str | bytes = fspath(path)
            if further:
                model = _with_outputs(self.path, further)
                folder = "session.model_external_initializers_file_folder_path"
                options.add_session_config_entry(folder, fspath(self.path.parent))
            self._session = ort.InferenceSession(model, options, providers=chosen, disable_fallback=1)
        except InputError:
            raise
        except Exception as error:  # onnxruntime's own exceptions share no base class
            raise DataError(f"cannot load the ONNX model {str(path)!r}: {_reason(error)}") from error
        try:
            meta = self._session.get_modelmeta()
            self.metadata: dict[str, str] = dict(meta.custom_metadata_map)
            self.producer: str = meta.producer_name
            for output in self._session.get_outputs():
                if output.type not in _FLOATS:
                    what = f"{self.path.name}: output {output.name!r}"
                    raise InputError(f"{what}: expected floating-point numbers, got {output.type}")
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
        if len(images) != 1 or _sizes(images[0].shape)[1] not in (3, None):
            raise InputError(f"{self.path.name}: expected one floating-point input (B, 3, H, W), got {description}")
        extra = [i.name for i in inputs if i is not images[0]]
        if not set(extra) <= set(_EXTRA_INPUTS):
            raise InputError(
                f"{self.path.name}: expected no inputs but an image and {', '.join(_EXTRA_INPUTS)}, got {description}"
            )
        return images[0].name, _sizes(images[0].shape), _FLOATS[images[0].type], extra

    def __call__(self, image: Tensor) -> dict[str, Tensor]:
        """Run the model on images, without gradients; a model with a fixed batch size runs several times if needed.

        Shapes: image `(B, 3, H, W)`.
        """
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
            if array.ndim < 1 or array.shape[0] != len(image):
                raise InputError(
                    f"{self.path.name}: output {name!r}: expected a row for each of {len(image)} images, got shape "
                    f"{tuple(array.shape)}"
                )
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
        return partial(OnnxSession, self.path, **self._settings), ()

    def widened(self, further: Sequence[str]) -> "OnnxSession":
        """A session of the same model, with the same settings, that also returns tensors inside it."""
        return OnnxSession(self.path, **{**self._settings, "further": further})


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


def _providers(device: torch.device, providers: Sequence[Provider] | None) -> list[Any]:
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
    if provider not in have:
        expected = "expected a device that onnxruntime can use"
        raise InputError(f"device: {expected}, got {device} (its providers: {', '.join(have)})")
    return [(provider, {"device_id": device.index or 0}), "CPUExecutionProvider"]


def _sizes(shape: Sequence[int | str | None]) -> tuple[int | None, ...]:
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape)


def _repeat(canvas: Tensor, row: list[int]) -> Tensor:
    return torch.tensor([row]).expand(canvas.shape[0], -1).contiguous()

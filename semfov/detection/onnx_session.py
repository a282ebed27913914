"""An ONNX model, checked before memory is allocated, in onnxruntime, called with torch tensors.

Models whose sizes or work depend on values are *open-ended*: no check of the file bounds what a pass takes. They run
image by image in a process of their own, with limited memory, which ends when a pass takes too long.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from semfov.detection.feature_maps import NetworkStep, stride_of
from semfov.detection.onnx_apart import ModelApart
from semfov.detection.onnx_budget import check_elements, dims, without_weights
from semfov.detection.onnx_cells import Canvas
from semfov.detection.onnx_check import check_file, stored_bytes
from semfov.detection.onnx_decoding import COLUMNS, rows_of_images
from semfov.detection.onnx_input import FLOATS, ImageInput, Sizes, open_sizes, sizes_of_image
from semfov.detection.onnx_program import Description, Opening, Port, describe, open_session, runtime
from semfov.errors import DataError, check, reason_of

if TYPE_CHECKING:
    from onnx import GraphProto
    from onnxruntime import InferenceSession

_INTEGERS = "tensor(int64)", "tensor(int32)"  # of outputs that number classes and boxes

# Further inputs of some exported detectors, made from the canvas: sizes and scales for mapping boxes.
_EXTRA_INPUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "orig_target_sizes": lambda canvas: torch.tensor([[canvas.shape[3], canvas.shape[2]]] * canvas.shape[0]),
    "im_shape": lambda canvas: canvas.new_tensor([[canvas.shape[2], canvas.shape[3]]] * canvas.shape[0]),
    "scale_factor": lambda canvas: canvas.new_ones(canvas.shape[0], 2),
}

_MOST_MEMORY = 2**29  # bytes for the tensors of models whose sizes depend on values, all together
_MOST_BESIDE = 2**28  # bytes that their process may need for onnxruntime itself, and a few copies of what is stored
_COPIES = 4
_A_THREAD = 2**24  # bytes that the system reserves for each thread
_MOST_SECONDS = 10.0  # longest pass of such a model for one image, and longest time until it is loaded
_MOST_REASON = 400  # largest number of characters of onnxruntime's reasons that a message has
_MOST_BATCH = 1024  # largest fixed batch size of a model

_IMAGES = "export it with such an input"
_WITHOUT_SELECTION = "export it without non-maximum suppression, or with a first dimension for the images"

Provider = str | tuple[str, Mapping[str, object]]
"""An execution provider of onnxruntime: its name, alone or with its options."""


class _Inputs(NamedTuple):
    """Inputs of a model: the one for images, and the names of the others, all in `_EXTRA_INPUTS`."""

    image: ImageInput
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
        shape: shape of the input for images, in the order `(B, 3, H, W)`.
        takes_bytes: whether the images are bytes, 255 for white.

    Private attributes: `_again` makes a session of the same model with the same settings, in another process, or with
    further outputs; `_further` names those of this session. `_session` runs the model, `_inputs` is what it takes.
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
        self.path = Path(path).absolute()  # is read again, maybe after a change of folder
        self.threads = torch.get_num_threads() if threads is None else threads
        check(self.threads > 0, "threads", "at least one", self.threads)
        self.providers = None if providers is None else tuple(providers)
        self.open_ended = check_file(Path(path)) if open_ended is None else open_ended
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
        opening = self._opening(_chosen_providers(torch.device(device), self.providers), spinning=spinning)
        try:
            self._session, description = self._open(opening)
        except UnicodeDecodeError as error:
            raise DataError(f"cannot load the ONNX model {str(path)!r}: its names are not text ({error})") from None
        except Exception as error:  # onnxruntime's own exceptions share no base class
            raise DataError(f"cannot load the ONNX model {str(path)!r}: {_reason(error)}") from error
        self.metadata = description["metadata"]
        self.producer = description["producer"]
        self.outputs = self._read_outputs(description["outputs"])
        self._inputs = self._read_inputs(description["inputs"])
        self.image = self._inputs.image.name
        self.shape = self._inputs.image.shape
        self.takes_bytes = self._inputs.image.takes_bytes
        batch = self.shape[0]
        check(batch is None or batch <= _MOST_BATCH, "batch", f"at most {_MOST_BATCH} images at once", batch)

    def _opening(self, providers: Sequence[Provider], *, spinning: bool) -> Opening:
        """Say how the model is opened: by its file, or from memory where it is given further outputs."""
        return {
            "path": None if self._further else fspath(self.path),
            "folder": fspath(self.path.parent),  # in which its weights may stay
            "threads": self.threads,
            "providers": providers,
            "spinning": spinning,
            "tensors": _MOST_MEMORY if self.open_ended else None,
            "process": None,
        }

    def _open(self, opening: Opening) -> tuple[InferenceSession | ModelApart, Description]:
        """Open the model, an open-ended one in a process of its own, and read what onnxruntime says of it."""
        model = self._model_with_further_outputs()
        if self.open_ended:
            apart = self._opened_apart(opening, model)
            return apart, apart.description
        session = open_session(opening, model)
        return session, describe(session)

    def _opened_apart(self, opening: Opening, model: bytes | None) -> ModelApart:
        """Open the model in a process of its own, whose memory is limited where it uses no other device."""
        if [*opening["providers"]] == ["CPUExecutionProvider"]:  # drivers of GPUs map more than they use
            beside = _MOST_BESIDE + self.threads * _A_THREAD
            opening["process"] = _MOST_MEMORY + beside + _COPIES * stored_bytes(self.path)
        return ModelApart(opening, model, _MOST_SECONDS)

    def _model_with_further_outputs(self) -> bytes | None:
        """Make the model that also returns the tensors inside it that are asked for; None where none are."""
        if not self._further:
            return None
        import onnx

        model = onnx.load(self.path, load_external_data=False)
        names = {output.name for output in model.graph.output}
        model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in self._further if name not in names)
        return model.SerializeToString()

    def _read_outputs(self, outputs: Sequence[Port]) -> tuple[tuple[str, Sizes], ...]:
        """List name and shape of each output; raises `InputError` for one that holds no numbers."""
        for output in outputs:
            name = f"{self.path.name}: output {output['name']!r}"
            check(output["type"] in (*FLOATS, *_INTEGERS), name, "numbers", output["type"])
        return tuple((output["name"], open_sizes(output["shape"])) for output in outputs)

    def _read_inputs(self, inputs: Sequence[Port]) -> _Inputs:
        """Find the input for images, and the others; raises `InputError` for others than detectors have."""
        descriptions = [f"{port['name']} {port['shape']} {port['type']}" for port in inputs]
        got = ", ".join(descriptions)
        images = [image for port in inputs if (image := ImageInput.of(port)) is not None]
        expected = "one input of floats or bytes, (B, 3, H, W) or (B, H, W, 3)"
        check(len(images) == 1, self.path.name, expected, f"{got}; {_IMAGES}")
        image = images[0]
        others = tuple(port["name"] for port in inputs if port["name"] != image.name)
        are_known = set(others) <= set(_EXTRA_INPUTS)
        check(are_known, self.path.name, f"no inputs but an image and {', '.join(_EXTRA_INPUTS)}", got)
        return _Inputs(image, others)

    def __call__(self, image: Tensor) -> dict[str, Tensor]:
        """Run the model on images, without gradients, in parts where its batch size is fixed.

        Args:
            image: `(B, 3, H, W)`, with the values that the network takes; bytes are rounded.

        Returns:
            The outputs by name, each with a row for each image, in the dtype and on the device of the images.

        Raises:
            DataError: the model fails.
        """
        batch = image.shape[0]
        check(batch > 0, "image", "at least one image", batch)
        source = image.detach().to(device="cpu", dtype=self._inputs.image.dtype)
        size = self._images_a_run(batch)
        missing = -batch % size
        if missing:  # a fixed batch is filled up with the last image
            source = torch.cat([source, source[-1:].expand(missing, -1, -1, -1)])
        runs = [self._run(part) for part in source.split(size)]
        outputs = {}
        for name, _ in self.outputs:
            rows = _joined([run[name] for run in runs])
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
        feed = {self.image: self._inputs.image.arranged(image)}
        for name in self._inputs.extra:
            feed[name] = _EXTRA_INPUTS[name](image).numpy()
        try:
            arrays = self._session.run(names, feed)
        except Exception as error:  # onnxruntime's own exceptions share no base class
            reason = _reason(error)
            if "Available memory" in reason:
                reason = f"its tensors need more than {_MOST_MEMORY >> 20} MiB, as with too many boxes; {reason}"
            raise DataError(f"{self.path.name}: fails on images of shape {tuple(image.shape)}: {reason}") from error
        outputs = {}
        for (name, sizes), array in zip(self.outputs, arrays, strict=True):
            rows = torch.from_numpy(array)
            if _is_flat(sizes):
                rows = rows_of_images(rows, len(image))
            has_rows = rows.shape[:1] == (len(image),)
            expected = f"a row for each of {len(image)} images"
            got = f"shape {array.shape}; {_WITHOUT_SELECTION}"
            check(has_rows, f"{self.path.name}: output {name!r}", expected, got)
            outputs[name] = rows
        return outputs

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
        are_open = self.open_ended
        stated_shapes: dict[str, list[int]] = {}
        for name, shape in self.outputs:
            sizes = shape[1:]  # the first one is that of the batch
            stated = [size for size in sizes if size is not None]
            check_elements(f"{self.path.name}: output {name!r}", stated)
            stated_shapes[name] = stated
            are_open |= not shape or None in sizes or _is_flat(shape)
        if are_open:
            width, height = size
            return self(torch.zeros(1, 3, height, width))
        return {name: torch.zeros(1, *sizes) for name, sizes in stated_shapes.items()}

    def steps(self, canvas: Canvas) -> list[NetworkStep]:
        """List the steps of the model in order, with the strides of their maps.

        Args:
            canvas: `(width, height)` in pixels.

        Returns:
            A step for each tensor that is computed.
        """
        graph = self._graph_for(canvas)
        shapes = {value.name: dims(value) for value in [*graph.value_info, *graph.output]}
        steps = []
        from_image = {self.image}  # tensors that are computed from the image; others are stored weights, and no maps
        for node in graph.node:
            inputs = tuple(node.input)
            if not from_image.isdisjoint(inputs):
                from_image.update(node.output)
            for output in node.output:
                stride = _stride(shapes.get(output, []), canvas) if output in from_image else None
                steps.append(NetworkStep(output, stride, inputs, node.op_type == "Conv"))
        return steps

    def _graph_for(self, canvas: Canvas) -> GraphProto:
        """Infer the shapes inside the model for one image of the size `(width, height)` of a canvas."""
        import onnx

        model = without_weights(onnx.load(self.path, load_external_data=False))
        image = next(value for value in model.graph.input if value.name == self.image)
        sizes = sizes_of_image(self._inputs.image.layout, canvas)
        for side, size in zip(image.type.tensor_type.shape.dim, sizes, strict=True):
            side.dim_value = size
        return onnx.shape_inference.infer_shapes(model, data_prop=True).graph


def _is_flat(sizes: Sizes) -> bool:
    """Tell whether an output has the rows of all images together (`rows_of_images`)."""
    return len(sizes) == 2 and sizes[1] == COLUMNS


def _joined(parts: list[Tensor]) -> Tensor:
    """Join the rows of several runs, which may have other numbers of boxes: zeros follow the fewer ones."""
    if len(parts) == 1:
        return parts[0]  # needs no copy
    longest = max(part.shape[1:2] for part in parts)
    if all(part.shape[1:2] == longest for part in parts):
        return torch.cat(parts)
    padded = []
    for part in parts:
        missing = longest[0] - part.shape[1]
        padded.append(pad(part, (*[0, 0] * (part.ndim - 2), 0, missing)))
    return torch.cat(padded)


def _stride(shape: Sequence[int], canvas: Canvas) -> int | None:
    """Find the stride of a map `(1, C, rows, columns)`; None for a tensor of another shape."""
    is_map = len(shape) == 4 and min(shape[2:]) > 1
    return stride_of(canvas[0], shape[3]) if is_map else None


def _reason(error: Exception) -> str:
    """Shorten onnxruntime's own words to their end, which says most."""
    text = reason_of(error).rpartition("Status Message: ")[2]
    text = re.sub(r"/\S+:\d+ .*?\) ", "", text, count=1)  # where in its source
    return text if len(text) <= _MOST_REASON else f"…{text[-_MOST_REASON:]}"


def _chosen_providers(device: torch.device, providers: Sequence[Provider] | None) -> list[Provider]:
    """Choose the providers asked for; else those for a device, and the CPU's for what it does not support."""
    available = runtime().get_available_providers()
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

"""The program that runs one ONNX model in a separate process, and its messages.

No operation of onnxruntime can be stopped from outside. A process can: a clock, started before each pass, ends it
however busy its operations are, and its memory is limited. The program is run by its file, and imports neither tensors
nor this package, so that it starts in a fraction of a second.

Both sides send messages: a line of JSON, with the types and shapes of the arrays whose bytes follow it.
"""

from __future__ import annotations

import faulthandler
import json
import math
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import IO, TYPE_CHECKING, TypedDict, cast

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from onnxruntime import InferenceSession, NodeArg

Message = Mapping[str, object]
"""What one side says, as JSON has it."""

Numbers = NDArray[np.generic]

_NUMBERS = "biufc"  # kinds of NumPy's types whose arrays are bytes
_SILENT = "ORT_DISABLE_TELEMETRY"  # read when onnxruntime is imported, which else stores a number for this machine


class Opening(TypedDict):
    """Settings for opening a model; as JSON, the first message to the program.

    Attributes:
        path: the file; None where the model itself is given.
        folder: where files of weights lie, for a model that is given.
        threads: number of onnxruntime's threads.
        providers: the execution providers, names or names with options.
        spinning: whether idle threads wait busily.
        tensors: the most bytes of the tensors of a pass; None where a check of the file bounds them.
        process: the most bytes of all that a process of its own allocates; None for no limit.
    """

    path: str | None
    folder: str
    threads: int
    providers: Sequence[str | Sequence[object]]
    spinning: bool
    tensors: int | None
    process: int | None


class Port(TypedDict):
    """An input or output of a model: its name, its shape with texts for open sizes, and its type in onnxruntime."""

    name: str
    shape: list[int | str | None]
    type: str


class Description(TypedDict):
    """What onnxruntime says of a model: texts by key, the program that exported it, and its inputs and outputs."""

    metadata: dict[str, str]
    producer: str
    inputs: list[Port]
    outputs: list[Port]


def runtime() -> ModuleType:
    """Import onnxruntime with its telemetry switched off.

    Returns:
        The module.
    """
    os.environ.setdefault(_SILENT, "1")
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    return onnxruntime


def open_session(opening: Opening, model: bytes | None = None) -> InferenceSession:
    """Open a model in onnxruntime.

    Args:
        opening: how; with a limit of `tensors`, nothing is computed when it is opened.
        model: the model, where `opening` has no path.

    Returns:
        The session.
    """
    ort = runtime()
    options = ort.SessionOptions()
    options.intra_op_num_threads = opening["threads"]
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # exceptions say all, and some exporters leave a warning for every initialiser
    options.add_session_config_entry("session.intra_op.allow_spinning", str(int(opening["spinning"])))
    further: dict[str, list[str]] = {}
    if opening["tensors"] is not None:
        _limit_tensors(opening["tensors"])
        options.add_session_config_entry("session.use_env_allocators", "1")
        # What follows from stored values alone would be computed, and kept, beside the limit.
        further["disabled_optimizers"] = ["ConstantFolding"]
    if model is not None:
        # Such a model is loaded from memory, while its weights may stay in other files.
        folder = "session.model_external_initializers_file_folder_path"
        options.add_session_config_entry(folder, opening["folder"])
    providers = [name if isinstance(name, str) else tuple(name) for name in opening["providers"]]
    source = opening["path"] if model is None else model
    # onnxruntime's fallback would print messages and try the same again.
    return ort.InferenceSession(source, options, providers=providers, disable_fallback=1, **further)


def _limit_tensors(most: int) -> None:
    """Register a limited allocator, which sessions use that ask for it; a process does it once."""
    ort = runtime()
    memory = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
    limits = ort.OrtArenaCfg({"max_mem": most, "arena_extend_strategy": 1})
    ort.create_and_register_allocator(memory, limits)


def describe(session: InferenceSession) -> Description:
    """Describe a model that is open.

    Args:
        session: onnxruntime's session.

    Returns:
        What it says of the model.
    """
    model = session.get_modelmeta()
    return {
        "metadata": dict(model.custom_metadata_map),
        "producer": model.producer_name,
        "inputs": _ports(session.get_inputs()),
        "outputs": _ports(session.get_outputs()),
    }


def _ports(nodes: Iterable[NodeArg]) -> list[Port]:
    """Describe inputs or outputs."""
    return [{"name": node.name, "shape": list(node.shape), "type": node.type} for node in nodes]


def send(stream: IO[bytes], message: Message, arrays: Sequence[Numbers] = ()) -> None:
    """Send a message.

    Args:
        stream: where it goes.
        message: what JSON can say.
        arrays: arrays of numbers, after it.
    """
    kinds = [[array.dtype.str, array.shape] for array in arrays]
    stream.write(json.dumps({**message, "arrays": kinds}).encode() + b"\n")
    for array in arrays:
        stream.write(np.ascontiguousarray(array).data)
    stream.flush()


def receive(stream: IO[bytes]) -> tuple[Message, list[Numbers]]:
    """Receive a message.

    Args:
        stream: where it comes from.

    Returns:
        The message, and its arrays.

    Raises:
        EOFError: the other side has ended.
    """
    line = stream.readline()
    if not line.endswith(b"\n"):
        raise EOFError
    message = json.loads(line)
    arrays: list[Numbers] = []
    for kind, shape in message["arrays"]:
        dtype = np.dtype(kind)
        if dtype.kind not in _NUMBERS:
            raise ValueError(f"arrays of numbers are sent, not {kind}")
        content = bytearray(math.prod(shape) * dtype.itemsize)
        if stream.readinto(content) < len(content):  # type: ignore[attr-defined]
            raise EOFError
        arrays.append(np.frombuffer(content, dtype).reshape(shape))
    return message, arrays


def main() -> None:
    """Open the model of the first message, and answer each further one with the outputs of a pass."""
    source = sys.stdin.buffer
    # What others print goes nowhere: only messages are read on the other side.
    sink = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the other side decides
    with suppress(EOFError, BrokenPipeError):
        first, arrays = receive(source)
        _limit_process(cast(Opening, first["opening"])["process"])
        runtime()  # takes long where it was never read from the disk, which is not the model's fault
        with _ending_late(first, nowhere):
            session = _answer_with_description(first, arrays, sink)
        while session is not None:
            request, arrays = receive(source)
            with _ending_late(request, nowhere):
                _answer_with_outputs(session, request, arrays, sink)


@contextmanager
def _ending_late(message: Message, nowhere: int) -> Iterator[None]:
    """End the process if a block takes longer than the `seconds` of a message."""
    # From a thread of its own, which waits for no operation.
    faulthandler.dump_traceback_later(cast(float, message["seconds"]), exit=True, file=nowhere)
    yield
    faulthandler.cancel_dump_traceback_later()


def _answer_with_description(message: Message, arrays: Sequence[Numbers], sink: IO[bytes]) -> InferenceSession | None:
    """Open the model of the first message, and send its description; None for one that cannot be opened."""
    try:
        model = arrays[0].tobytes() if arrays else None
        session = open_session(cast(Opening, message["opening"]), model)
        send(sink, {"description": describe(session)})
    except Exception as error:  # onnxruntime's own exceptions share no base class
        send(sink, {"error": _reason(error)})
        return None
    return session


def _answer_with_outputs(
    session: InferenceSession, message: Message, arrays: Sequence[Numbers], sink: IO[bytes]
) -> None:
    """Run the model on the inputs of a message, and send the outputs that it names."""
    names = cast(list[str], message["inputs"])
    try:
        outputs = session.run(cast(list[str], message["outputs"]), dict(zip(names, arrays, strict=True)))
    except Exception as error:
        send(sink, {"error": _reason(error)})
    else:
        send(sink, {}, [np.asarray(output) for output in outputs])


def _reason(error: Exception) -> str:
    """Write the message of an error, or its name where it has none, as a `MemoryError`."""
    return str(error) or type(error).__name__


def _limit_process(most: int | None) -> None:
    """Limit what this process allocates, where the system can."""
    if most is not None:
        with suppress(ImportError):  # Windows has no such limits
            import resource

            resource.setrlimit(resource.RLIMIT_DATA, (most, most))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    main()

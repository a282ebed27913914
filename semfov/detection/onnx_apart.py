"""ONNX models that may run without end, in a separate process that is stopped when a pass takes too long."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from io import BufferedReader, BufferedWriter
from multiprocessing.spawn import get_executable
from typing import cast

import numpy as np

from semfov.detection import onnx_program
from semfov.detection.onnx_program import Description, Message, Numbers, Opening, receive, send
from semfov.errors import DataError

# The program finds packages where this process does, but nothing of the folder that its own file lies in.
_START = "import runpy, sys; sys.path[:] = sys.argv[2:]; runpy.run_path(sys.argv[1], run_name='__main__')"

_MODELS: weakref.WeakSet[ModelApart] = weakref.WeakSet()  # all of this process, for its forks


class ModelApart:
    """A model in a separate process, which is started again after it was stopped, or after a fork.

    Attributes:
        description: what onnxruntime says of the model.

    Private attributes: `_opening` says how the model is opened, and `_model` is the model where it has no file.
    `_process` runs it, where there is one, and `_turn` lets threads take turns; a fork has neither of its parent's.
    """

    def __init__(self, opening: Opening, model: bytes | None, seconds: float) -> None:
        self._opening = opening
        self._seconds = seconds
        self._model = model
        self._turn = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        _MODELS.add(self)
        self.description = self._start()

    def run(self, names: Sequence[str], feed: Mapping[str, Numbers]) -> list[Numbers]:
        """Run the model once.

        Args:
            names: the outputs that are asked for.
            feed: the inputs by name, each with a row for each image; an image may take the whole time of a pass.

        Returns:
            The outputs.

        Raises:
            DataError: onnxruntime fails, or takes too long.
        """
        with self._turn:
            if self._process is None:
                self._start()
            images = max(len(rows) for rows in feed.values())
            request = {"inputs": [*feed], "outputs": [*names]}
            _, outputs = self._answer(request, [*feed.values()], images * self._seconds)
            return outputs

    def renew(self) -> None:
        """Release the parent's process and lock after a fork."""
        self._turn = threading.Lock()
        process = self._process
        self._process = None
        if process is not None:
            for pipe in (process.stdin, process.stdout):
                # The buffer may be locked for ever, and what it holds is for the parent to write.
                cast(BufferedReader | BufferedWriter, pipe).raw.close()

    def _start(self) -> Description:
        """Start the process, and open the model in it."""
        # Isolated (-I): until the paths are set, modules would be imported from the present folder, too.
        call = [os.fsdecode(get_executable()), "-I", "-c", _START, onnx_program.__file__, *sys.path]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(call, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL)
        weakref.finalize(self, _end, self._process, os.getpid())
        model = [] if self._model is None else [np.frombuffer(self._model, np.uint8)]
        answer, _ = self._answer({"opening": self._opening}, model, self._seconds)
        return cast(Description, answer["description"])

    def _answer(self, message: Message, arrays: Sequence[Numbers], most: float) -> tuple[Message, list[Numbers]]:
        """Send a message to the process, and wait for the answer, or until it has ended itself after `most` seconds."""
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        start = time.monotonic()
        try:
            send(process.stdin, {**message, "seconds": most}, arrays)
            answer, outputs = receive(process.stdout)
        except (EOFError, BrokenPipeError):
            self._process = None
            _end(process, os.getpid())
            raise DataError(_end_in_words(process.returncode, time.monotonic() - start, most)) from None
        except BaseException:  # such as Ctrl-C between the two: the answer would be taken for that of the next pass
            self._process = None
            _end(process, os.getpid())
            raise
        if "error" in answer:
            raise DataError(str(answer["error"]))
        return answer, outputs


def _renew_all() -> None:
    """Let go of all processes of the parent."""
    for model in [*_MODELS]:
        model.renew()


if hasattr(os, "register_at_fork"):  # Windows has no forks
    os.register_at_fork(after_in_child=_renew_all)


def _end_in_words(code: int, seconds: float, most: float) -> str:
    """Say why a process has ended, with a code and after some seconds, where it had `most`."""
    if seconds >= most:
        return f"not done after {most:.0f} s, as with a loop that does not end"
    return f"onnxruntime ended with code {code}, as where memory is short"


def _end(process: subprocess.Popen[bytes], owner: int) -> None:
    """End a process of this one, and wait for its end; a fork leaves those of its parent alone."""
    if owner != os.getpid():
        return
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(BrokenPipeError):
                pipe.close()

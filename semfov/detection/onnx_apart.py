"""An open-ended ONNX model in a process of its own, which is ended when a pass takes too long."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.spawn import get_executable
from typing import cast

import numpy as np

from semfov.detection import onnx_program
from semfov.detection.onnx_program import Description, Message, Numbers, Opening, receive, send
from semfov.errors import DataError

# The program finds packages where this process does, but nothing of the folder that its own file lies in.
_START = "import runpy, sys; sys.path[:] = sys.argv[2:]; runpy.run_path(sys.argv[1], run_name='__main__')"


class ModelApart:
    """A model that a process of its own runs; a new one is started after one that was ended, or after a fork.

    Attributes:
        description: what onnxruntime says of the model.

    Private attributes: `_first` is the message that opens the model, and `_model` the model where it has no file.
    `_process` runs it, and belongs to the process numbered `_owner`: a fork has a copy of the pipes of its parent, and
    must not speak through them. `_turn` lets threads take turns.
    """

    def __init__(self, opening: Opening, model: bytes | None, seconds: float) -> None:
        self._first = {"opening": opening, "seconds": seconds}
        self._seconds = seconds
        self._model = model
        self._turn = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0
        self.description = self._start()

    def run(self, names: Sequence[str], feed: Mapping[str, Numbers]) -> list[Numbers]:
        """Run the model once.

        Args:
            names: the outputs that are asked for.
            feed: the inputs by name.

        Returns:
            The outputs.

        Raises:
            DataError: onnxruntime fails, or takes too long.
        """
        with self._turn:
            if self._process is None or self._owner != os.getpid():
                self._start()
            request = {"inputs": [*feed], "outputs": [*names], "seconds": self._seconds}
            _, outputs = self._answer(request, [*feed.values()])
            return outputs

    def _start(self) -> Description:
        """Start the process, and open the model in it."""
        call = [os.fsdecode(get_executable()), "-I", "-c", _START, onnx_program.__file__, *sys.path]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(call, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL)
        self._owner = os.getpid()
        weakref.finalize(self, _end, self._process, self._owner)
        model = [] if self._model is None else [np.frombuffer(self._model, np.uint8)]
        answer, _ = self._answer(self._first, model)
        return cast(Description, answer["description"])

    def _answer(self, message: Message, arrays: Sequence[Numbers]) -> tuple[Message, list[Numbers]]:
        """Send a message to the process, and wait for the answer, or until it has ended itself."""
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        start = time.monotonic()
        try:
            send(process.stdin, message, arrays)
            answer, outputs = receive(process.stdout)
        except (EOFError, BrokenPipeError):
            self._process = None
            _end(process, self._owner)
            raise DataError(self._end_in_words(process.returncode, time.monotonic() - start)) from None
        except BaseException:  # such as Ctrl-C between the two: the answer would be taken for that of the next pass
            self._process = None
            _end(process, self._owner)
            raise
        if "error" in answer:
            raise DataError(str(answer["error"]))
        return answer, outputs

    def _end_in_words(self, code: int, seconds: float) -> str:
        """Say why the process has ended."""
        if seconds >= self._seconds:
            return f"not done after {self._seconds:.0f} s, as with a loop that does not end"
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

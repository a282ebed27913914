"""What a call does to the machine: memory, time, processes, sockets, and the files that it opens."""

import contextlib
import ctypes
import json
import os
import resource
import signal
import socket
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from semfov.errors import SemfovError

MOST_SECONDS = 20  # of the processor, for any picture
_OPENED = 0x20 | 0x1  # inotify: IN_OPEN, IN_ACCESS
_PROCESSES = ("subprocess.Popen", "os.fork", "os.forkpty", "os.exec", "os.posix_spawn", "os.system")
_RESERVED = 1 << 28  # bytes that may be reserved and never used, as by allocators of threads
_MOST_WAIT = 10  # seconds for a request of one that has connected
_EVENT = struct.Struct("iIII")


class Outcome(NamedTuple):
    """What a call did, as the process that made it tells.

    Attributes:
        refused: semfov's words of refusal; None where there were none.
        fault: an error that is none of semfov's, or the signal that ended the process; None where there was none.
        bytes: memory that it took, beside that of the process before.
        seconds: of the processor.
        forbidden: sockets and processes that it asked for.
    """

    refused: str | None
    fault: str | None
    bytes: int
    seconds: float
    forbidden: list[str]


def watched(call: Callable[[], object], most: int) -> Outcome:
    """Make a call in a fork of this process, with limits of memory and time.

    Args:
        call: what is called.
        most: bytes that it may take.

    Returns:
        What it did.
    """
    source, sink = os.pipe()
    child = os.fork()
    if not child:
        os.close(source)
        _tell(call, sink, most)
    os.close(sink)
    with os.fdopen(source, "rb") as stream:
        text = stream.read()
    _, status, usage = os.wait4(child, 0)
    seconds = usage.ru_utime + usage.ru_stime
    if not text:
        return Outcome(None, f"ended by signal {os.WTERMSIG(status)}", 0, seconds, [])
    return Outcome(seconds=seconds, **json.loads(text))


def _tell(call: Callable[[], object], sink: int, most: int) -> None:
    """Make a call in this process, write to a pipe what it did, and end."""
    before = _status("VmRSS")
    data = _status("VmData") + most + _RESERVED
    resource.setrlimit(resource.RLIMIT_DATA, (data, data))
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_SECONDS + 5, MOST_SECONDS + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.alarm(20 * MOST_SECONDS)  # for what waits and does not work
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    forbidden: list[str] = []
    sys.addaudithook(lambda event, given: forbidden.append(f"{event} {given[:1]}") if _is_forbidden(event) else None)
    refused = None
    fault = None
    try:
        call()
    except SemfovError as error:
        refused = str(error)
    except BaseException as error:
        fault = f"{type(error).__name__}: {error}"[:2000]
    told = {"refused": refused, "fault": fault, "bytes": _status("VmHWM") - before, "forbidden": forbidden}
    os.write(sink, json.dumps(told).encode())
    os._exit(0)


def _is_forbidden(event: str) -> bool:
    """Tell whether an event of Python is about sockets or processes."""
    return event in _PROCESSES or (event.startswith("socket.") and event != "socket.gethostname")


def _status(name: str) -> int:
    """Read an entry of this process's status, in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    raise KeyError(name)


@contextlib.contextmanager
def opened_files(*folders: Path) -> Iterator[set[str]]:
    """Find the names of files of some folders that any process opens, or reads, in the block (inotify).

    Args:
        folders: the folders.

    Yields:
        The names, which are there after the block.
    """
    libc = ctypes.CDLL(None)
    names: set[str] = set()
    events = b""
    watch = libc.inotify_init1(os.O_NONBLOCK)
    try:
        for folder in folders:
            assert libc.inotify_add_watch(watch, os.fsencode(folder), _OPENED) > 0
        yield names
        with contextlib.suppress(BlockingIOError):
            while more := os.read(watch, 1 << 16):
                events += more
    finally:
        os.close(watch)
    place = 0
    while place < len(events):
        *_, length = _EVENT.unpack_from(events, place)
        place += _EVENT.size
        names.add(events[place : place + length].rstrip(b"\0").decode())
        place += length
    names.discard("")  # the folder itself


@contextlib.contextmanager
def listener() -> Iterator[tuple[str, list[bytes]]]:
    """Listen on a port of this machine in the block.

    Yields:
        The address, and the requests that came.
    """
    requests: list[bytes] = []
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = server.accept()
                client.settimeout(_MOST_WAIT)
                with client, contextlib.suppress(OSError):
                    requests.append(client.recv(1000))
                    client.sendall(b"HTTP/1.0 404 Not Found\r\n\r\n")

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.getsockname()[1]}", requests
    finally:
        server.shutdown(socket.SHUT_RDWR)  # wakes the thread, as closing does not
        server.close()
        thread.join()

"""Limits on requests to the page of `semfov app`: its own addresses and files, and a limited size."""

import asyncio
import json
import os
from collections.abc import Iterator
from pathlib import Path
from time import time

from semfov.cli.doorkeeper import Application, Layer, Message, Receive, Send, header, refuse

# Gradio has dozens of other addresses, which fetch pages for a visitor, run functions past the queue or tell the state
# of the server. The page asks for none of them.
_READ = {
    *("/", "/config", "/theme.css", "/favicon.ico", "/manifest.json", "/robots.txt"),
    *("/gradio_api/info", "/gradio_api/startup-events", "/gradio_api/queue/data", "/gradio_api/upload_progress"),
}
_READ_BELOW = ("/static/", "/assets/", "/svelte/", "/gradio_api/heartbeat/")
_FILE = "/gradio_api/file="
_CALLS = ("/gradio_api/queue/join", "/gradio_api/run/predict")
_UPLOAD = "/gradio_api/upload"
_WRITTEN = {*_CALLS, _UPLOAD, "/gradio_api/cancel", "/gradio_api/reset"}

_ELSEWHERE = 404, "expected an address of this page\n"

_MOST_REQUEST = 2**18  # bytes of a request that is no upload
_FRAME = 2**16  # bytes around the file of an upload
_MOST_KEPT = 2**31  # bytes of all files of visitors, those that arrive among them
_LEAST_KEPT = 2**16  # bytes as which a file counts at least, so that their number is limited, too
_MOST_DIGITS = 20  # of a size


class RequestLimits(Layer):
    """A layer of the server that passes on only the requests of its own page.

    A request names only files in the folder of uploads, as the server would open, or fetch, any other.

    Args:
        app: the server behind it.
        folder: where the files of visitors are.
        most_bytes: the largest file.
        seconds_kept: how long a file is kept, at least.
    """

    def __init__(self, app: Application, folder: Path, most_bytes: int, seconds_kept: float) -> None:
        super().__init__(app)
        self._folder = folder.resolve()
        self._most_bytes = most_bytes
        self._seconds_kept = seconds_kept
        self._arriving = 0  # bytes of the uploads that are under way

    async def answer(self, scope: Message, receive: Receive, send: Send) -> None:
        refusal = self._refusal(scope)
        if refusal is None and scope["path"] in _CALLS:
            # The files that a call names are in its body, which is read here and replayed to the server.
            body = await _body(receive)
            receive = _replayed(body, receive)
            refusal = self._refusal_of_call(body)
        if refusal is not None:
            await refuse(scope, send, *refusal)
        elif scope["path"] == _UPLOAD:
            await self._upload(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _upload(self, scope: Message, receive: Receive, send: Send) -> None:
        """Pass an upload on, unless too much is kept or under way."""
        length = int(header(scope, "content-length") or 0)
        # Counted before it is here: uploads at the same time might exceed the limit together.
        self._arriving += length
        try:
            kept = await asyncio.to_thread(self._kept_bytes)
            if kept + self._arriving > _MOST_KEPT:
                await refuse(scope, send, 503, "too many pictures are kept; give yours in an hour\n")
            else:
                await self._app(scope, receive, send)
        finally:
            self._arriving -= length

    def _refusal(self, scope: Message) -> tuple[int, str] | None:
        """Say why a request may not pass, by its head, as a status and words; None for one that may."""
        path = scope["path"]
        method = scope.get("method", "")
        if method in ("GET", "HEAD"):
            return self._refusal_to_read(path)
        if method == "POST" and path in _WRITTEN:
            return self._refusal_by_size(scope)
        return _ELSEWHERE

    def _refusal_to_read(self, path: str) -> tuple[int, str] | None:
        """Say why an address may not be read."""
        if path.startswith(_FILE):
            return None if self._is_kept(path.removeprefix(_FILE)) else (403, "expected a file of this page\n")
        is_own = path in _READ or path.startswith(_READ_BELOW)
        return None if is_own else _ELSEWHERE

    def _refusal_by_size(self, scope: Message) -> tuple[int, str] | None:
        """Say why a request is too large, or of unknown size, which browsers never send."""
        length = header(scope, "content-length") or ""
        is_number = length.isascii() and length.isdigit() and len(length) <= _MOST_DIGITS
        if not is_number or header(scope, "transfer-encoding"):
            return 411, "expected the size of the request\n"
        most = self._most_bytes + _FRAME if scope["path"] == _UPLOAD else _MOST_REQUEST
        if int(length) > most:
            return 413, f"expected a maximum of {most:,} bytes\n"
        return None

    def _kept_bytes(self) -> int:
        """Remove old files of visitors, and add up the sizes of the others.

        Uploads that break off leave files behind, of which Gradio does not know.
        """
        total = 0
        for path in self._folder.rglob("*"):
            try:
                found = path.stat()
                if not path.is_file():
                    continue
                if found.st_mtime < time() - self._seconds_kept:
                    path.unlink()
                else:
                    total += max(found.st_size, _LEAST_KEPT)
            except FileNotFoundError:
                continue  # Gradio has removed or moved it since
        return total

    def _refusal_of_call(self, body: bytes) -> tuple[int, str] | None:
        """Say why a call of a function may not pass, by its arguments."""
        try:
            call = json.loads(body, parse_constant=_refuse_constant)
        except (ValueError, RecursionError):
            return 400, "expected JSON\n"
        if not isinstance(call, dict) or len(str(call.get("session_hash"))) > 64:
            return 400, "expected a call of a function\n"
        if not all(self._is_kept(path) for path in _paths(call)):
            return 403, "expected files that this page was given\n"
        return None

    def _is_kept(self, path: object) -> bool:
        """Tell whether a path is in the folder of uploads; None names no file."""
        if path is None:
            return True
        try:
            return isinstance(path, str) and Path(os.path.realpath(path)).is_relative_to(self._folder)
        except (OSError, ValueError):
            return False  # a name that no file can have


def _refuse_constant(name: str) -> float:
    """Refuse NaN and infinities, which are no JSON."""
    raise ValueError(name)


def _paths(value: object) -> Iterator[object]:
    """List what stands for paths of files in the arguments of a call, at any depth."""
    waiting = [value]
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict):
            if "path" in value:
                yield value["path"]
            waiting.extend(value.values())
        elif isinstance(value, list):
            waiting.extend(value)


async def _body(receive: Receive) -> bytes:
    """Read the body of a request, whose size has been checked."""
    parts = []
    while True:
        message = await receive()
        parts.append(message.get("body", b""))
        if not message.get("more_body"):
            return b"".join(parts)


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Hand over a body that has been read, and then what comes after it."""
    waiting = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return waiting.pop() if waiting else await receive()

    return replay

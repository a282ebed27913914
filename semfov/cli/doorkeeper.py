"""The doorkeeper of the page of `semfov app`: who may send requests, by address, page of origin, and token."""

import secrets
import socket
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, MutableMapping
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]
"""A server, or a layer of one, as ASGI has it."""

_STRANGER = "semfov app: expected the address that the command prints, and its own page\n"
_NO_TOKEN = "semfov app: expected the whole address that the command prints, with its token\n"
_COOKIE = "semfov_token"
_BEGIN = "/gradio_api/startup-events"  # Gradio itself asks for it once, before there is a visitor


def token_for(host: str) -> str | None:
    """Make a random token that visitors of a page need if other machines can reach it.

    Args:
        host: address that the page is served on.

    Returns:
        The token; None where only this machine reaches the page.

    >>> token_for("127.0.0.1") is None, len(token_for("0.0.0.0"))
    (True, 22)
    """
    try:
        is_here = host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        is_here = False
    return None if is_here else secrets.token_urlsafe(16)


class Layer(ABC):
    """Base of the layers of the server, which answer requests, or pass them on.

    Args:
        app: the server behind it.
    """

    def __init__(self, app: Application) -> None:
        self._app = app

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer a request; the messages with which the server itself begins and ends are no requests."""
        answer = self._app if scope["type"] == "lifespan" else self.answer
        await answer(scope, receive, send)

    @abstractmethod
    async def answer(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""


class Doorkeeper(Layer):
    """A layer of the server that rejects requests from other pages, or to other addresses.

    With a token, the first request has it in its address; the browser then keeps it in a cookie.

    Args:
        app: the server behind it.
        host: address that the page is served on.
        token: what visitors need; None for nothing.
    """

    # Another page in the same browser can send requests here, also under a name of its own for this address.

    def __init__(self, app: Application, host: str, token: str | None = None) -> None:
        super().__init__(app)
        self._host = host
        self._token = token

    async def answer(self, scope: Message, receive: Receive, send: Send) -> None:
        if not self.admits(header(scope, "host") or "", header(scope, "origin")):
            await refuse(scope, send, 403, _STRANGER)
        elif self._has_token(header(scope, "cookie") or "") or scope.get("path") == _BEGIN:
            await self._app(scope, receive, send)
        elif scope["type"] == "http" and self._is_token(_token_of(scope)):
            await self._welcome(send)
        else:
            await refuse(scope, send, 401, _NO_TOKEN)

    def admits(self, address: str, origin: str | None) -> bool:
        """Tell whether a request may enter, by the address that it was sent to and the page that it comes from."""
        try:
            name = urlsplit(f"//{address}").hostname or ""
            # Browsers name the page that a request comes from, where it is not this one alone.
            is_own_page = origin is None or urlsplit(origin).netloc.lower() == address.lower()
        except ValueError:
            return False
        return is_own_page and self._is_served_as(name)

    def _is_served_as(self, name: str) -> bool:
        """Tell whether the page is served under a name or a number of a machine."""
        if name in ("localhost", self._host.lower()):
            return True
        try:
            number = ip_address(name)
        except ValueError:
            # Any other name may be that of a stranger, who lets it lead to this address.
            return self._everywhere and name == socket.gethostname().lower()
        return number.is_loopback or self._everywhere

    @property
    def _everywhere(self) -> bool:
        """Whether the page is served under all addresses of this machine."""
        return self._host in ("0.0.0.0", "::")

    def _has_token(self, cookies: str) -> bool:
        """Tell whether the browser kept the token, or none is needed."""
        if self._token is None:
            return True
        for cookie in cookies.split(";"):
            name, _, value = cookie.strip().partition("=")
            if name == _COOKIE and self._is_token(value):
                return True
        return False

    def _is_token(self, text: str) -> bool:
        """Compare a text with the token, in a time that does not tell how much of it is right."""
        return self._token is not None and secrets.compare_digest(text.encode(), self._token.encode())

    async def _welcome(self, send: Send) -> None:
        """Let the browser keep the token, and open the page under an address without it."""
        cookie = f"{_COOKIE}={self._token}; Path=/; HttpOnly; SameSite=Lax"
        # A browser would name this address, which has the token, to the next page as its referrer.
        headers = [(b"location", b"/"), (b"set-cookie", cookie.encode()), (b"referrer-policy", b"no-referrer")]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


def _token_of(scope: Message) -> str:
    """Read the token in the address of a request; empty for none."""
    values = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])
    return values[0]


def header(scope: Message, name: str) -> str | None:
    """Read a header of a request.

    Args:
        scope: the request.
        name: in small letters.

    Returns:
        The last one of the name; None for none.
    """
    values = [value for key, value in scope.get("headers", ()) if key == name.encode()]
    return str(values[-1].decode("latin-1")) if values else None


async def refuse(scope: Message, send: Send, status: int, words: str) -> None:
    """Answer a request that may not enter.

    Args:
        scope: the request.
        send: sends the answer.
        status: the status of HTTP.
        words: the reason.
    """
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    kind = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": status, "headers": kind})
    await send({"type": "http.response.body", "body": words.encode()})

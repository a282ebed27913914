"""Ask a language model through the common chat-completions interface, one question at a time."""

import http.client
import json
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from semfov.errors import DataError, InputError, check

_MOST = 1 << 20  # bytes of a response
_AGAIN = (408, 409, 425, 429, 500, 502, 503, 504, 529)
_LONGEST_WAIT = 60.0


@dataclass(frozen=True)
class Reply:
    """A server's answer to one question.

    Attributes:
        text: the answer.
        model: name of the model that answered, according to the server.
        prompt_tokens: number of tokens in the question as the server counts them, 0 if it does not count.
        completion_tokens: number of tokens in the answer, likewise.
    """

    text: str
    model: str
    prompt_tokens: int
    completion_tokens: int


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Refuse redirects, so that the API key is never sent to another address."""

    def redirect_request(self, *args: Any) -> None:
        """Do not follow the redirect."""
        return


class ChatServer:
    """A client for a server with the chat-completions interface. It asks at temperature 0.

    Args:
        url: address of the interface up to and including `/v1`; `/chat/completions` is added to it.
        model: name of the model on the server.
        key: API key of the server (None: no key is sent).
        tokens: maximum number of tokens in an answer.
        timeout: seconds to wait for an answer.
        retries: how often a question is asked again when the server is busy, fails or cannot be reached.
        wait: seconds before the first retry. Each further wait is twice as long, unless the server names a time.
        sleep: function that waits for a number of seconds.

    Example::

        server = ChatServer("http://127.0.0.1:8080/v1", "my-model")
        print(server.ask("What is usually beside a fork?").text)
    """

    def __init__(
        self,
        url: str,
        model: str,
        key: str | None = None,
        *,
        tokens: int = 120,
        timeout: float = 60.0,
        retries: int = 5,
        wait: float = 1.0,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        parts = urlsplit(url)
        check(parts.scheme in ("http", "https") and bool(parts.netloc), "url", "http://… or https://…", repr(url))
        printable = key is None or (key.isascii() and key.isprintable())
        check(printable, "key", "one line of printable ASCII characters", "a key with other characters")
        self.url, self.model = f"{url.rstrip('/')}/chat/completions", model
        self.tokens, self.timeout, self.retries, self.wait = tokens, timeout, retries, wait
        self._sleep = sleep
        self._headers = {"Content-Type": "application/json"} | ({"Authorization": f"Bearer {key}"} if key else {})
        self._opener = urllib.request.build_opener(_NoRedirects)

    def request(self, prompt: str) -> dict[str, Any]:
        """Return the body of the request for a question."""
        messages = [{"role": "user", "content": prompt}]
        return {"model": self.model, "messages": messages, "temperature": 0, "max_tokens": self.tokens}

    def ask(self, prompt: str) -> Reply:
        """Ask one question and wait for the answer.

        Args:
            prompt: the question.

        Returns:
            The answer.

        Raises:
            InputError: the server refuses the key, or does not know the address or the model.
            DataError: the server cannot be reached, refuses the question, or its answer is not a chat completion.
        """
        body = json.dumps(self.request(prompt)).encode()
        for attempt in range(self.retries + 1):
            try:
                message = urllib.request.Request(self.url, body, self._headers)
                with self._opener.open(message, timeout=self.timeout) as response:
                    return _reply(response.read(_MOST), self.url, self.model)
            except urllib.error.HTTPError as error:
                reason = _error_message(error)
                if error.code not in _AGAIN:
                    refusal = _refusal(error.code, reason, self.url, self.model)
                    raise refusal from None
                failure, retry_after = f"HTTP {error.code}{reason}", error.headers.get("Retry-After", "")
            except (OSError, http.client.HTTPException) as error:
                failure, retry_after = str(getattr(error, "reason", None) or error or type(error).__name__), ""
            if attempt < self.retries:
                pause = float(retry_after) if retry_after.isdecimal() else self.wait * 2**attempt
                self._sleep(min(pause, _LONGEST_WAIT))
        raise DataError(
            f"{self.url}: no answer after {self.retries + 1} attempts (the last failed with: {failure}); check that "
            "the server is running, then repeat the command to continue where it stopped"
        )


def _reply(body: bytes, url: str, model: str) -> Reply:
    try:
        answer = json.loads(body)
        text = answer["choices"][0]["message"]["content"]
        usage = answer.get("usage") or {}
        counts = [int(usage.get(name) or 0) for name in ("prompt_tokens", "completion_tokens")]
        if not isinstance(text, str):
            raise TypeError("no text")
        return Reply(text, str(answer.get("model") or model), *counts)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        start = body[:120].decode(errors="replace")
        raise DataError(f"{url}: expected a chat completion with choices[0].message.content, got {start!r}") from None


def _error_message(error: urllib.error.HTTPError) -> str:
    """Return the server's own error message, in parentheses."""
    try:
        body = error.read(_MOST)
    except (OSError, http.client.HTTPException):
        return ""
    try:
        answer = json.loads(body)["error"]
        message = answer["message"] if isinstance(answer, dict) else answer
    except (ValueError, LookupError, TypeError, RecursionError):
        message = body.decode(errors="replace")
    plain = " ".join(str(message).split())
    return f" ({plain[:200]})" if plain else ""


def _refusal(code: int, reason: str, url: str, model: str) -> InputError | DataError:
    """Make the error for a request that the server refuses."""
    if code in (401, 403):
        return InputError(
            f"key: {url} refuses the API key with HTTP {code}{reason}; set the environment variable that `key` names"
        )
    if code == 404:
        return InputError(
            f"url, model: {url} answers HTTP 404{reason}; check the address, and whether the server has the model "
            f"{model!r}"
        )
    if 300 <= code < 400:
        return InputError(
            f"url: {url} redirects to another address with HTTP {code}; redirects are not followed, so give the final "
            "address"
        )
    return DataError(f"{url}: the server refuses the question with HTTP {code}{reason}")

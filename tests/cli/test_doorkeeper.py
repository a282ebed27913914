"""The doorkeeper of the page of `semfov app`: addresses, pages of origin, and the token."""

import asyncio
import socket

import pytest

from semfov.cli.doorkeeper import Doorkeeper, token_for


def sent_through(keeper, **scope):
    """Send a request through a doorkeeper; returns whether it entered, and what was answered before that."""
    entered, sent = [], []

    async def page(scope, receive, send):
        entered.append(scope)

    async def send(message):
        sent.append(message)

    asyncio.run(Doorkeeper(page, *keeper)({"type": "http", **scope}, None, send))
    return bool(entered), sent


@pytest.mark.parametrize(
    ("host", "address", "origin", "admitted"),
    [
        ("127.0.0.1", "127.0.0.1:7860", None, True),
        ("127.0.0.1", "localhost:7860", "http://localhost:7860", True),
        ("127.0.0.1", "[::1]:7860", None, True),
        ("127.0.0.1", "127.0.0.1:7860", "http://127.0.0.1:7861", False),
        ("127.0.0.1", "127.0.0.1:7860", "https://elsewhere.org", False),
        ("127.0.0.1", "127.0.0.1:7860", "null", False),
        ("127.0.0.1", "127.0.0.1:7860", "", False),
        ("127.0.0.1", "elsewhere.org:7860", "http://elsewhere.org:7860", False),
        ("127.0.0.1", "192.168.0.7:7860", None, False),
        ("127.0.0.1", "", None, False),
        ("127.0.0.1", "[", None, False),
        ("192.168.0.7", "192.168.0.7:7860", "http://192.168.0.7:7860", True),
        ("192.168.0.7", "192.168.0.8:7860", None, False),
        ("lab.example.org", "LAB.example.org:7860", "http://lab.example.org:7860", True),
        ("0.0.0.0", "192.168.0.8:7860", "http://192.168.0.8:7860", True),
        ("0.0.0.0", "elsewhere.org", "http://elsewhere.org", False),
        ("0.0.0.0", f"{socket.gethostname()}:7860", None, True),
    ],
)
@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_requests_enter_by_the_address_that_was_asked_for_and_from_its_own_page(host, address, origin, admitted, kind):
    """A page of another site may know the port, and may have a name of its own for this machine."""
    headers = [(b"host", address.encode()), *([(b"origin", origin.encode())] if origin is not None else [])]
    entered, sent = sent_through((host,), type=kind, headers=headers)
    assert entered == admitted
    assert bool(sent) != admitted
    assert admitted or sent[0].get("status", 403) == 403


HERE = (b"host", b"192.168.0.7:7860")
KEEPER = ("192.168.0.7", "sesame")


@pytest.mark.parametrize(
    ("cookie", "query", "status"),
    [
        (b"semfov_token=sesame", b"", None),
        (b'other={"a;b"}; semfov_token=sesame', b"", None),
        (b"", b"token=sesame", 303),
        (b"semfov_token=Sesame", b"token=sesame", 303),
        (b"", b"", 401),
        (b"semfov_token=", b"token=", 401),
        (b"semfov_token=sesam", b"token=sesames", 401),
        (b"token=sesame", b"semfov_token=sesame", 401),
        (b"semfov_token=\xff", b"token=%FF", 401),
    ],
)
def test_visitors_from_elsewhere_need_the_token(cookie, query, status):
    entered, sent = sent_through(KEEPER, path="/", query_string=query, headers=[HERE, (b"cookie", cookie)])
    assert entered == (status is None)
    assert (sent[0]["status"] if sent else None) == status
    if status == 303:
        headers = dict(sent[0]["headers"])
        assert headers[b"location"] == b"/"
        assert headers[b"set-cookie"].startswith(b"semfov_token=sesame; ")
        assert b"HttpOnly" in headers[b"set-cookie"]


def test_the_token_admits_no_strangers_and_opens_no_socket():
    strange = [(b"host", b"elsewhere.org"), (b"cookie", b"semfov_token=sesame")]
    assert sent_through(KEEPER, path="/", headers=strange)[1][0]["status"] == 403
    entered, sent = sent_through(KEEPER, type="websocket", query_string=b"token=sesame", headers=[HERE])
    assert not entered
    assert sent == [{"type": "websocket.close", "code": 1008}]


def test_the_server_itself_begins_without_a_token():
    assert sent_through(KEEPER, path="/gradio_api/startup-events", headers=[HERE])[0]
    assert not sent_through(KEEPER, path="/gradio_api/queue/join", headers=[HERE])[0]


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_no_token_is_asked_for_on_this_machine_alone(host):
    assert token_for(host) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "lab.example.org"])
def test_tokens_are_long_and_drawn_anew(host):
    tokens = {token_for(host) for _ in range(20)}
    assert len(tokens) == 20
    assert all(len(token) >= 22 for token in tokens)

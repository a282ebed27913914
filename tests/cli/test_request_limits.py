"""What the page of `semfov app` may be asked for: addresses, sizes, and files in the arguments of calls."""

import asyncio
import json
import os
import time

import pytest

from semfov.cli import request_limits
from semfov.cli.request_limits import RequestLimits

JOIN = "/gradio_api/queue/join"
UPLOAD = "/gradio_api/upload"


def answered(folder, path, method="POST", body=b"", headers=(), parts=1):
    """Send a request through the limits; returns the status of a refusal, or the body that has passed."""
    passed, sent = [], []
    step = -(-len(body) // parts) or 1
    pieces = [body[start : start + step] for start in range(0, len(body), step)] or [b""]
    waiting = [{"body": piece, "more_body": number + 1 < len(pieces)} for number, piece in enumerate(pieces)]

    async def page(scope, receive, send):
        passed.append((await receive())["body"])

    async def receive():
        return waiting.pop(0)

    async def send(message):
        sent.append(message)

    scope = {"type": "http", "method": method, "path": path, "headers": headers or sized(len(body))}
    asyncio.run(RequestLimits(page, folder, 1000, 60)(scope, receive, send))
    return passed[0] if passed else sent[0]["status"]


def sized(count):
    return [(b"content-length", str(count).encode())]


@pytest.mark.parametrize("path", ["/", "/config", "/assets/a.js", "/static/js/a.js", "/gradio_api/queue/data"])
def test_the_page_itself_is_given(tmp_path, path):
    assert answered(tmp_path, path, "GET") == b""


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/gradio_api/proxy=http://elsewhere.org/"),
        ("GET", "/gradio_api/deep_link"),
        ("GET", "/gradio_api/dev/reload"),
        ("GET", "/gradio_api/vibe-code"),
        ("GET", "/monitoring"),
        ("GET", "/gradio_api/file//etc/passwd"),
        ("POST", "/gradio_api/run/look"),
        ("POST", "/gradio_api/call/look"),
        ("POST", "/gradio_api/component_server"),
        ("POST", "/gradio_api/process_recording"),
        ("POST", "/"),
        ("PUT", UPLOAD),
    ],
)
def test_other_addresses_of_gradio_are_none_of_the_page(tmp_path, method, path):
    assert answered(tmp_path, path, method) == 404


def test_only_files_in_the_folder_of_uploads_are_given_and_looked_at(tmp_path):
    folder = tmp_path / "kept"
    folder.mkdir()
    inside = folder / "photo.png"
    inside.write_bytes(b"1")
    outside = tmp_path / "secret.png"
    outside.write_bytes(b"1")
    link = folder / "link.png"
    link.symlink_to(outside)
    foreign = [outside, link, folder / "../secret.png", "http://elsewhere.org/a.png", "\0", "\ud800", "a" * 5000]
    for path in foreign:
        assert answered(folder, f"/gradio_api/file={path}", "GET") == 403
    assert answered(folder, f"/gradio_api/file={inside}", "GET") == b""
    for path in [*foreign, 5, ["a"], {"path": str(inside)}]:
        named = {"path": path if isinstance(path, int | list | dict) else str(path)}
        for data in (named, [[named]], {"value": named}):
            call = json.dumps({"data": [data], "session_hash": "a"}).encode()
            assert answered(folder, JOIN, body=call) == 403
    call = json.dumps({"data": [{"path": str(inside)}, {"path": None}], "session_hash": "a"}).encode()
    for parts in (1, 7):
        assert answered(folder, JOIN, body=call, parts=parts) == call


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b"NaN", b'{"a": Infinity}', b"[" * 100_000, b"1" * 10_000, b"\xff"])
def test_calls_that_are_no_json_are_refused(tmp_path, body):
    assert answered(tmp_path, JOIN, body=body) == 400


def test_names_of_visitors_are_short(tmp_path):
    assert answered(tmp_path, JOIN, body=json.dumps({"session_hash": "a" * 65}).encode()) == 400


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        (JOIN, sized(2**18 + 1), 413),
        (UPLOAD, sized(1000 + 2**16 + 1), 413),
        (UPLOAD, sized(-1), 411),
        (UPLOAD, [(b"content-length", b"1e3")], 411),
        (UPLOAD, [(b"other", b"")], 411),
        (UPLOAD, [*sized(3), (b"transfer-encoding", b"chunked")], 411),
    ],
)
def test_sizes_are_limited_before_anything_is_read(tmp_path, path, headers, status):
    assert answered(tmp_path, path, headers=headers) == status


def test_all_visitors_together_fill_no_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(request_limits, "_MOST_KEPT", 100)
    monkeypatch.setattr(request_limits, "_LEAST_KEPT", 1)
    kept = tmp_path / "a" / "photo.png"
    kept.parent.mkdir()
    kept.write_bytes(b"1" * 90)
    assert answered(tmp_path, UPLOAD, headers=sized(11)) == 503
    assert answered(tmp_path, UPLOAD, body=b"1" * 10) == b"1" * 10
    long_ago = time.time() - 61
    os.utime(kept, (long_ago, long_ago))  # as what broken uploads leave behind
    assert answered(tmp_path, UPLOAD, body=b"1" * 90) == b"1" * 90
    assert not kept.exists()


def test_small_files_of_visitors_are_limited_in_number(tmp_path):
    for number in range(4):
        (tmp_path / f"{number}.png").write_bytes(b"1")
    assert RequestLimits(None, tmp_path, 1000, 60)._kept_bytes() == 4 * 2**16


def test_uploads_that_arrive_together_count_together(tmp_path, monkeypatch):
    monkeypatch.setattr(request_limits, "_MOST_KEPT", 100)
    statuses = []

    async def both():
        arrived, is_over = asyncio.Event(), asyncio.Event()

        async def page(scope, receive, send):
            arrived.set()
            await is_over.wait()

        async def send(message):
            statuses.append(message.get("status"))

        limits = RequestLimits(page, tmp_path, 1000, 60)
        scope = {"type": "http", "method": "POST", "path": UPLOAD, "headers": sized(60)}
        first = asyncio.create_task(limits(scope, None, send))
        await arrived.wait()
        await limits(scope, None, send)
        is_over.set()
        await first
        statuses.append("next")
        await limits(scope, None, send)

    asyncio.run(both())
    assert statuses[0] == 503
    assert statuses[-1] == "next"

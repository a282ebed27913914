"""The page on which to try an agent out: looks at given cells, and the page in Chromium."""

import asyncio
import os
import re
import shutil
import socket
import sys
import urllib.error
import urllib.request
from types import ModuleType, SimpleNamespace

import pytest
import torch

from semfov.cli import app
from semfov.cli.app import _Calls, _Doorkeeper, _look_at_cells
from semfov.cli.main import main
from semfov.data import read_image
from tests.pretended import a_gpu
from tests.small import rand

NAMES = (os.environ.get("CHROMIUM", ""), "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for name in NAMES if name and (path := shutil.which(name))), None)


@pytest.mark.slow
def test_looks_at_cells_that_the_agent_chose_are_those_of_its_search(agent, photo):
    image = read_image(photo)
    own = agent.search(image, "wine glass", how="fovea", start=47, shifts=3, closer=0)
    assert len(own) == 4
    cells = own.cells.tolist()
    for count in (1, 2, 3):
        looked = _look_at_cells(agent, image, "wine glass", cells[:count])
        assert looked.record.cells.tolist() == cells[:count]
        torch.testing.assert_close(looked.record.presence, own.presence[:count])
        values = own.values[count - 1]
        assert float(values[looked.advice]) == pytest.approx(float(values[cells[count]]))  # ties are drawn
        assert looked.advice not in cells[:count]
        assert looked.agent.cells.tolist() == cells[:count]
    assert "before it" in looked.describe()
    assert "before it" not in _look_at_cells(agent, image, "wine glass", [3]).describe()


def test_looks_at_cells_beside_a_gpu_are_those_on_the_cpu(agent):
    image = rand(3, 120, 160)
    here = _look_at_cells(agent, image, "wine glass", [3, 7])
    with a_gpu():
        there = _look_at_cells(agent.to("cuda"), image, "wine glass", [3, 7])
    assert there.advice == here.advice
    assert there.record.presence is not None
    torch.testing.assert_close(there.record.presence, here.record.presence, rtol=1e-3, atol=1e-4)


def test_what_cannot_be_served_is_told_before_anything_is_loaded(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "gradio", None)
    assert main(["app"]) == 1
    assert capsys.readouterr().err == 'error: app: expected Gradio for the page; pip install "semfov[app]"\n'
    monkeypatch.setitem(sys.modules, "gradio", ModuleType("gradio"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["app", "--port", str(port)]) == 1
    assert re.fullmatch(rf"error: app: cannot be served on 127.0.0.1:{port}: .*\n", capsys.readouterr().err)


class Told(Exception):
    """What the page shows of an error."""

    def __init__(self, message, *, print_exception):
        super().__init__(message)


@pytest.fixture
def calls(agent, monkeypatch):
    """What the page calls, without Gradio."""
    gradio = ModuleType("gradio")
    monkeypatch.setattr(gradio, "Error", Told, raising=False)
    monkeypatch.setitem(sys.modules, "gradio", gradio)
    return _Calls(agent)


def test_what_the_page_calls_needs_no_gradio_but_for_its_errors(agent, calls, photo):
    path, (_, height, width) = str(photo), read_image(photo).shape
    refused = {"picture: expected one": (None, "red"), "class: expected one to search for": (path, "all classes")}
    for said, given in refused.items():
        with pytest.raises(Told, match=said):
            calls.look(*given, "search", 3.0)
        with pytest.raises(Told, match=said):
            calls.click(*given, [], SimpleNamespace(index=(1, 1)))
    for task, target in (("search", "red"), ("find all", "all classes")):
        words, page = calls.look(path, target, task, 3.0)
        assert words
        assert page.startswith('<iframe title="The looks" sandbox="allow-scripts" srcdoc="&lt;!DOCTYPE html')
    with pytest.raises(Told, match="prior: expected a share above 0 and below 1"):
        calls.look(path, "red", "search", 3.0, 1.5)
    assert calls.look(path, "all classes", "find all", 3.0, 1.5)[0]  # which has no use for it
    cells: list[int] = []
    for x, y in ((5, 5), (width - 5, height - 5)):
        cells, clicked, seen, believed, words = calls.click(path, "red", cells, SimpleNamespace(index=(x, y)))
        assert clicked.size == (width, height)
        assert seen is not None
        assert believed is not None
        assert words
    assert cells == [0, agent.columns * agent.rows - 1]
    assert calls.fresh(path)[0] == []
    assert calls.fresh(None)[1] is None


EPS = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 64 64
%%EndComments
0 0 64 64 rectfill
showpage
"""


def test_files_that_only_other_programs_read_start_none(calls, tmp_path, monkeypatch):
    """Ghostscript is there, but for its work: a stand-in that leaves a mark where it is started."""
    program = tmp_path / "gs"
    program.write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    for name in ("photo.png", "photo.eps"):
        path = str(tmp_path / name)
        (tmp_path / name).write_bytes(EPS)
        with pytest.raises(Told, match="not an image in a format that is read"):
            calls.look(path, "red", "search", 3.0)
        with pytest.raises(Told, match="not an image in a format that is read"):
            calls.click(path, "red", [], SimpleNamespace(index=(1, 1)))
        with pytest.raises(Told, match="not an image in a format that is read"):
            calls.fresh(path)
    assert not (tmp_path / "started").exists()


def test_a_picture_for_which_everybody_would_wait_is_refused_by_its_size(calls, photo, monkeypatch):
    monkeypatch.setattr(app, "_MOST_PIXELS", 100)
    for call in (calls.fresh, lambda path: calls.look(path, "red", "search", 3.0)):
        with pytest.raises(Told, match=r"picture: expected at most 100 pixels, got \d+ × \d+; reduce it"):
            call(str(photo))


def test_a_visitor_stops_its_own_search(calls, agent, photo, monkeypatch):
    """Both begin to search; one stops during its first look, the other's search goes on."""
    counts = {}
    explore = agent.explore

    def explored(picture, **limits):
        going = limits["on_look"]

        def on_look(record):
            calls.stop("impatient")
            return going(record)

        record = explore(picture, **limits | {"on_look": on_look})
        counts[visitor] = record.passes
        return record

    monkeypatch.setattr(type(agent), "explore", lambda _, picture, **limits: explored(picture, **limits))
    for visitor in ("patient", "impatient"):
        calls.look(str(photo), "red", "explore", 4.0, visitor=visitor)
    assert counts["impatient"] < counts["patient"] == 4


@pytest.mark.parametrize(
    ("host", "address", "origin", "admitted"),
    [
        ("127.0.0.1", "127.0.0.1:7860", None, True),
        ("127.0.0.1", "localhost:7860", "http://localhost:7860", True),
        ("127.0.0.1", "[::1]:7860", None, True),
        ("127.0.0.1", "127.0.0.1:7860", "http://127.0.0.1:7861", False),
        ("127.0.0.1", "127.0.0.1:7860", "https://elsewhere.org", False),
        ("127.0.0.1", "127.0.0.1:7860", "null", False),
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
    entered, sent = [], []

    async def page(scope, receive, send):
        entered.append(scope)

    async def send(message):
        sent.append(message)

    headers = [(b"host", address.encode()), *([(b"origin", origin.encode())] if origin else [])]
    asyncio.run(_Doorkeeper(page, host)({"type": kind, "headers": headers}, None, send))
    assert bool(entered) == admitted
    assert bool(sent) != admitted
    assert admitted or sent[0].get("status", 403) == 403


@pytest.fixture
def served(agent, tmp_path, monkeypatch):
    """The page of the agent of squares, opened in Chromium on a telephone; it may print and request nothing."""
    gradio = pytest.importorskip("gradio", reason='needs Gradio (pip install "semfov[app]")')
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install playwright)")
    if CHROMIUM is None:
        pytest.skip("needs Chromium (apt-get install chromium, or set $CHROMIUM)")
    from semfov.cli.app import _launched, _make_page

    assert gradio
    monkeypatch.setenv("GRADIO_TEMP_DIR", str(tmp_path / "kept"))
    page, told = _make_page(agent), []
    address = _launched(page, "127.0.0.1", None)
    with playwright.sync_playwright() as program:
        browser = program.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": 390, "height": 900})
        # Gradio itself warns with this when it closes its stream of answers.
        view.on("console", lambda each: each.text == "Method not implemented." or told.append(each.text))
        view.on("pageerror", lambda error: told.append(str(error)))
        view.on("request", lambda each: each.url.startswith((address, "data:", "blob:")) or told.append(each.url))
        view.goto(address)
        yield view
        assert told == []
        browser.close()
    page.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # those of Gradio and of what it imports
def test_a_picture_a_search_and_a_click_on_the_width_of_a_telephone(served, photo):
    served.set_input_files("input[type=file]", str(photo))
    served.get_by_role("button", name="Look", exact=True).click()
    served.get_by_text("class: expected one to search for, got all classes").wait_for(timeout=60_000)
    served.get_by_label("Class").click()
    served.get_by_role("option", name="red").click()
    served.get_by_role("button", name="Look", exact=True).click()
    served.wait_for_selector(".page iframe", timeout=60_000)
    frame = served.frame_locator(".page iframe")
    frame.get_by_role("heading", level=1).wait_for()
    assert "red" in frame.get_by_role("heading", level=1).inner_text()
    served.get_by_role("tab", name="Look yourself").click()
    own = served.locator("#own img")
    for number in (1, 2):
        box = own.bounding_box()
        own.click(position={"x": 0.1 * number * box["width"], "y": 0.1 * box["height"]})
        served.get_by_text(f"Look {number}", exact=True).wait_for(timeout=60_000)
    assert served.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_strangers_and_large_files_are_turned_away_on_a_telephone(served, tmp_path, monkeypatch):
    """Gradio itself answers any name of the machine, and opens files with all of Pillow's decoders."""
    program = tmp_path / "gs"
    program.write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    for headers in ({"Host": "elsewhere.org"}, {"Origin": "http://elsewhere.org"}, {"Origin": "null"}):
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(urllib.request.Request(served.url, headers=headers))
        assert caught.value.code == 403
        caught.value.close()
    (tmp_path / "photo.png").write_bytes(EPS)
    served.set_input_files("input[type=file]", str(tmp_path / "photo.png"))
    served.get_by_text("not an image in a format that is read").first.wait_for(timeout=60_000)
    assert not (tmp_path / "started").exists()
    with (tmp_path / "large.png").open("wb") as file:
        file.truncate(app._MOST_BYTES + 1)
    served.reload()
    served.set_input_files("input[type=file]", str(tmp_path / "large.png"))
    served.get_by_text("maximum").first.wait_for(timeout=60_000)

"""The page on which to try an agent out: looks at given cells, and the page in Chromium."""

import os
import re
import shutil
import socket
import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch
from PIL import Image

from semfov.cli.app import _Calls, _look_at_cells
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


def test_what_the_page_calls_needs_no_gradio_but_for_its_errors(agent, photo, monkeypatch):
    class Error(Exception):
        def __init__(self, message, *, print_exception):
            super().__init__(message)

    gradio = ModuleType("gradio")
    monkeypatch.setattr(gradio, "Error", Error, raising=False)
    monkeypatch.setitem(sys.modules, "gradio", gradio)
    calls, picture = _Calls(agent, seed=0), Image.open(photo)
    refused = {"picture: expected one": (None, "red"), "class: expected one to search for": (picture, "all classes")}
    for said, given in refused.items():
        with pytest.raises(Error, match=said):
            calls.look(*given, "search", 3.0)
        with pytest.raises(Error, match=said):
            calls.click(*given, [], SimpleNamespace(index=(1, 1)))
    for task, target in (("search", "red"), ("find all", "all classes")):
        words, page = calls.look(picture, target, task, 3.0)
        assert words
        assert page.startswith('<iframe title="The looks" sandbox="allow-scripts" srcdoc="&lt;!DOCTYPE html')
    cells: list[int] = []
    for x, y in ((5, 5), (picture.width - 5, picture.height - 5)):
        cells, clicked, seen, believed, words = calls.click(picture, "red", cells, SimpleNamespace(index=(x, y)))
        assert clicked.size == picture.size
        assert seen is not None
        assert believed is not None
        assert words
    assert cells == [0, agent.columns * agent.rows - 1]
    assert calls.fresh(picture)[0] == []
    assert calls.fresh(None)[1] is None


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

"""The page on which to try an agent out: looks at given cells, and the page in Chromium."""

import json
import os
import re
import shutil
import socket
import sys
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from html import unescape
from types import ModuleType

import pytest

from semfov.cli import app
from semfov.cli.app import _Calls
from semfov.cli.main import main
from semfov.data import read_image
from tests import small

NAMES = (os.environ.get("CHROMIUM", ""), "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for name in NAMES if name and (path := shutil.which(name))), None)


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
    with pytest.raises(Told, match="picture: expected one"):
        calls.click(None, "red", [], (1, 1))
    for task, target in (("search", "red"), ("find all", "all classes"), ("explore", "all classes")):
        asked, page = calls.look(path, target, task, 3.0)
        assert asked == ""
        assert page.startswith('<iframe title="The looks" sandbox="allow-scripts" srcdoc="&lt;!DOCTYPE html')
    for prior in ("1.5", "often"):
        with pytest.raises(Told, match=r"prior: expected .*a share.* above 0 and below 1"):
            calls.look(path, "red", "search", 3.0, prior)
    assert calls.look(path, "all classes", "find all", 3.0, "1.5")[1]  # which has no use for it
    with pytest.raises(Told, match=r"prior: expected None for models without the share of their fit, got 0\.2"):
        calls.look(path, "red", "search", 3.0, " 0.2 ")
    for prior in (" ", " fit "):
        assert calls.look(path, "red", "search", 3.0, prior)[1]
    cells: list[int] = []
    for x, y in ((5, height - 5), (width - 5, height - 5)):
        cells, marks, words = calls.click(path, "wine glass", cells, (x, y))
        assert marks
        assert words
    count = agent.columns * agent.rows
    assert cells == [count - agent.columns, count - 1]
    assert calls.fresh(path, "red")[0] == []
    assert calls.fresh(None, "red")[1] == ""


def test_what_is_missing_is_asked_for_in_words_and_the_one_of_most_objects_is_usual(calls, photo):
    assert calls.look(None, "red", "search", 3.0) == ("Give it a picture, or take an example.", "")
    asked, page = calls.look(str(photo), "all classes", "search", 3.0)
    assert asked.startswith("Choose a class")
    assert page == ""
    cells, marks, asked = calls.click(str(photo), calls.sought("all classes", ""), [3], (1, 1))
    assert (cells, marks) == ([3], "")
    assert asked.startswith("Choose a class")
    assert calls.sought("all classes", "red") == "red"
    assert calls.sought("wine glass", "red") == "wine glass"


def test_examples_come_in_turn_with_the_class_that_suits_the_task():
    calls = _Calls(small.agent(small.Coloured(("car", "person"))))
    picture, target, usual, following = calls.take(0, "find all")
    people = [int((scene.labels == 2).sum()) for scene in calls.examples]
    cars = [int((scene.labels == 1).sum()) for scene in calls.examples]
    assert picture.size == calls.examples[0].size
    assert (target, following) == ("all classes", 1)
    assert usual == ("person" if people[0] > cars[0] else "car")
    for number in range(len(calls.examples)):
        expected = "person" if people[number] > cars[number] else "car"
        assert calls.take(number, "search")[1:3] == (expected, expected)
    assert calls.take(len(calls.examples), "find all")[0].tobytes() == picture.tobytes()


def test_a_detector_of_other_classes_has_no_examples(calls):
    assert calls.take(0, "search") == (None, "all classes", "", 0)


@pytest.mark.parametrize(("task", "target"), [("search", "red"), ("find all", "all classes"), ("explore", "red")])
def test_a_page_says_its_outcome_once(calls, photo, task, target):
    _, page = calls.look(str(photo), target, task, 3.0)
    document = unescape(re.search('srcdoc="(.*)"', page, re.DOTALL)[1])
    markup = document.split('<script type="application/json"')[0]
    heading = unescape(re.search("<h1>(.*?)</h1>", markup)[1])
    assert heading
    assert unescape(markup).count(heading.split(". ")[0]) == 2  # the title of the document, and the heading
    assert 'class="outcome" data-about="decision"></p>' in markup


def test_a_picture_that_was_removed_is_asked_for_again(calls, tmp_path):
    with pytest.raises(Told, match="picture: expected it once more"):
        calls.look(str(tmp_path / "gone.png"), "red", "search", 3.0)


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
            calls.click(path, "red", [], (1, 1))
        with pytest.raises(Told, match="not an image in a format that is read"):
            calls.fresh(path, "red")
    assert not (tmp_path / "started").exists()


def test_a_picture_for_which_everybody_would_wait_is_refused_by_its_size(calls, photo, monkeypatch):
    monkeypatch.setattr(app, "_MOST_PIXELS", 100)
    for call in (lambda path: calls.fresh(path, "red"), lambda path: calls.look(path, "red", "search", 3.0)):
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


@pytest.fixture
def served(opened):
    """The page, opened in Chromium on a telephone; it may print and request nothing."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install playwright)")
    if CHROMIUM is None:
        pytest.skip("needs Chromium (apt-get install chromium, or set $CHROMIUM)")
    address, told = opened(None), []
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


def give_file(served, path):
    """Take the example away, and give a file instead."""
    served.wait_for_selector("#picture img")
    served.get_by_label("Remove Image").click()
    served.set_input_files("#picture input[type=file]", str(path))


def press_look(served):
    """Press *Look*; returns the first heading of the page that comes."""
    served.get_by_role("button", name="Look", exact=True).click()
    served.wait_for_selector(".page iframe", timeout=60_000)
    heading = served.frame_locator(".page iframe").get_by_role("heading", level=1)
    heading.wait_for()
    return heading


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # those of Gradio and of what it imports
def test_the_first_press_shows_a_result_on_the_first_screen_of_a_telephone(served):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-playwright-python")
    served.wait_for_selector("#picture img")  # an example is there
    heading = press_look(served)
    assert heading.inner_text().startswith("1 object found.")
    assert served.get_by_text("Error").count() == 0
    picture = served.frame_locator(".page iframe").locator(".large svg").first
    assert picture.bounding_box()["y"] + 100 < 900
    assert served.evaluate("window.scrollY") == 0
    served.get_by_role("tab", name="Look yourself").click()
    served.locator("#own canvas").wait_for()
    found = axe.Axe().run(served)
    assert found.violations_count == 0, found.generate_report()
    assert served.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_fields_that_a_task_does_not_use_are_grey_on_a_telephone(served):
    served.get_by_role("button", name="More settings").click()
    used = {"find all": (True, True, False), "search": (True, True, True), "explore": (False, True, False)}
    fields = ("Class", "number input for Looks at most", "Share of your pictures")
    for task, expected in [*used.items(), ("gaze", (False, False, False)), ("find all", used["find all"])]:
        served.get_by_label(task, exact=True).check()
        for field, is_used in zip(fields, expected, strict=True):
            expect_enabled(served.get_by_label(field).first, is_used)
        if task == "search":
            assert served.get_by_label("Class").first.input_value() == "red"  # that of most objects of the example


def expect_enabled(field, is_used):
    """Wait until a field can be used, or not."""
    from playwright.sync_api import expect

    (expect(field).to_be_enabled if is_used else expect(field).to_be_disabled)()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_picture_a_search_and_looks_of_ones_own_on_the_width_of_a_telephone(served, photo):
    give_file(served, photo)
    served.wait_for_selector("#picture img")
    served.get_by_label("search", exact=True).check()
    served.get_by_role("button", name="Look", exact=True).click()
    served.get_by_text("Choose a class: a search looks for one.").wait_for(timeout=60_000)
    served.get_by_label("Class").first.click()
    served.get_by_role("option", name="red").click()
    assert "red" in press_look(served).inner_text()
    served.get_by_role("tab", name="Look yourself").click()
    canvas = served.locator("#own canvas")
    for number, (x, y) in enumerate([(0.9, 0.9), (0.11, 0.15)], 1):
        served.wait_for_timeout(500)
        box = canvas.bounding_box()
        canvas.click(position={"x": x * box["width"], "y": y * box["height"]})
        served.get_by_text(f"Look {number}", exact=True).wait_for(timeout=60_000)
    served.get_by_text("You: found in 2 looks.").wait_for()
    assert served.locator("#own .belief").count() == 48
    assert served.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_fovea_follows_the_pointer_without_the_server_on_a_telephone(served):
    served.get_by_role("tab", name="Look yourself").click()
    served.get_by_text("Click to look: find “red”").wait_for()
    canvas = served.locator("#own canvas")
    asked = []
    served.on("request", lambda each: asked.append(each.url))
    views = []
    for x, y in ((0.2, 0.2), (0.8, 0.7)):
        box = canvas.bounding_box()
        served.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        served.wait_for_timeout(300)
        views.append(canvas.evaluate(SHARPNESS))
    assert asked == []
    assert views[0]["first"] > 2 * views[0]["second"]
    assert views[1]["second"] > 2 * views[1]["first"]


SHARPNESS = """canvas => {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", {willReadFrequently: true});
  copy.drawImage(canvas, 0, 0);
  const sum = (x, y) => {
    const {data} = copy.getImageData(x * canvas.width - 20, y * canvas.height - 20, 40, 40);
    let total = 0;
    for (let at = 4; at < data.length; at += 4) total += Math.abs(data[at] - data[at - 4]);
    return total;
  };
  return {first: sum(0.2, 0.2), second: sum(0.8, 0.7)};
}"""
"""Sums of the differences of neighbouring pixels around two points of a canvas."""


def look_over_http(address, photo, visitor):
    """Give a picture and press *Look* by requests, as a browser does; returns the data of the answer."""
    import httpx

    with httpx.Client(base_url=address.partition("?")[0], follow_redirects=True, timeout=120) as client:
        client.get(address).raise_for_status()  # and keep the cookie
        look = next(each for each in client.get("config").json()["dependencies"] if len(each["inputs"]) == 5)
        path = client.post("gradio_api/upload", files={"files": photo.read_bytes()}).json()[0]
        picture = {"path": path, "meta": {"_type": "gradio.FileData"}}
        given = {"data": [picture, "red", "search", 4, ""], "fn_index": look["id"], "session_hash": visitor}
        client.post("gradio_api/queue/join", json=given).raise_for_status()
        with client.stream("GET", "gradio_api/queue/data", params={"session_hash": visitor}) as answers:
            for line in answers.iter_lines():
                if "process_completed" in line:
                    return json.loads(line.removeprefix("data:"))["output"]["data"]
    raise AssertionError("the answers ended before the look")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_twenty_visitors_with_the_token_are_answered_and_none_without_it_on_a_telephone(opened, photo):
    import httpx

    address = opened("sesame")
    assert address.endswith("/?token=sesame")
    for wrong in (address.partition("?")[0], address.replace("sesame", "sesam")):
        assert httpx.get(wrong, follow_redirects=True).status_code == 401
    with ThreadPoolExecutor(20) as visitors:
        answers = list(visitors.map(lambda number: look_over_http(address, photo, f"visitor{number}"), range(20)))
    assert len(answers) == 20
    for _, page in answers:
        assert "“red” found" in unescape(unescape(page))


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
    give_file(served, tmp_path / "photo.png")
    served.get_by_text("not an image in a format that is read").first.wait_for(timeout=60_000)
    assert not (tmp_path / "started").exists()
    with (tmp_path / "large.png").open("wb") as file:
        file.truncate(app._MOST_BYTES + 1)
    served.reload()
    give_file(served, tmp_path / "large.png")
    served.get_by_text("maximum").first.wait_for(timeout=60_000)

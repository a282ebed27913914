"""The built site: complete, with working links, and without anything loaded from a network."""

import json
import os
import re
import shutil
import zlib
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from docs.api import entries, place
from docs.site.tutorials import SOURCES

pytestmark = pytest.mark.slow

NAMES = (os.environ.get("CHROMIUM", ""), "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for name in NAMES if name and (path := shutil.which(name))), None)
LOADS = {
    "script": "src",
    "link": "href",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "object": "data",
}


class Page(HTMLParser):
    """What a page loads, its text, and the code in it with a flag that tells whether it is linked."""

    def __init__(self, path):
        super().__init__()
        self.loads, self.pictures, self.code, self.text = [], [], [], []
        self._open = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag in LOADS and attributes.get(LOADS[tag]):
            self.loads.append(attributes[LOADS[tag]])
        if tag == "img":
            self.pictures.append(attributes)
        if tag not in ("img", "link", "meta", "br", "input", "hr", "source"):
            self._open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if self._open and self._open[-1] == tag:
            self._open.pop()

    def handle_endtag(self, tag):
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data):
        if "script" in self._open or "style" in self._open:
            return
        if "pre" not in self._open:
            self.text.append(data)
        if "code" in self._open and "pre" not in self._open:
            self.code.append((data, "a" in self._open))


def pages(site):
    return sorted(site.rglob("*.html"))


def test_nothing_is_loaded_from_a_network(site):
    assert len(pages(site)) > 50
    outside = [
        (page.name, load) for page in pages(site) for load in Page(page).loads if re.match(r"(https?:)?//", load)
    ]
    for path in [*site.rglob("*.css"), *pages(site)]:
        fonts = r"(?:url\(|@import)\s*['\"]?(?:https?:)?//[^)'\"\s]+"
        outside += [(path.name, load) for load in re.findall(fonts, path.read_text(encoding="utf-8"))]
    assert outside == []


def test_every_public_name_and_page_is_in_the_index(site):
    packed = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    known = {line.split(" ")[0] for line in zlib.decompress(packed).decode().splitlines()}
    wanted = {place(module, name, thing) for module, things in entries().items() for name, thing in things}
    assert len(wanted) > 200
    assert wanted - known == set()
    home = (site / "index.html").read_text(encoding="utf-8")
    assert [module for module in entries() if f'href="./api/{module}.html"' not in home] == []


def test_names_of_code_on_the_method_page_are_linked(site):
    code = [found for found in Page(site / "method.html").code if found[0].startswith("semfov.")]
    assert len(code) > 100
    assert [name for name, linked in code if not linked] == []


def test_formulas_are_converted_and_no_markup_is_left(site):
    drawn = 0
    for path in (site / "api").glob("*.html"):
        html = path.read_text(encoding="utf-8")
        drawn += html.count("<math")
        assert "<blockquote" not in html, f"{path.name}: examples must not be quotations"
        text = " ".join(Page(path).text)
        assert not re.search(r":math:|\.\. math::|\$\$|\\(?:frac|mathrm|sum)|Example::", text), path.name
    assert drawn > 100


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_tutorials_have_pictures_with_content_and_alt_text(site, can_run, source):
    if not can_run:
        pytest.skip("the default detector's weights are missing")
    page = Page(site / "tutorials" / f"{source.stem}.html")
    drawn = [picture for picture in page.pictures if picture["src"].startswith(source.stem)]
    assert len(drawn) >= 2
    for picture in drawn:
        assert len(picture["alt"]) > 40
        with Image.open(site / "tutorials" / picture["src"]) as image:
            assert min(image.size) > 150
            assert np.asarray(image.convert("L")).std() > 15
    notebook = json.loads((site / "tutorials" / f"{source.stem}.ipynb").read_text(encoding="utf-8"))
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    assert {"stream", "display_data"} <= {output["output_type"] for output in outputs} | {"display_data"}
    assert not [output for output in outputs if output["output_type"] == "error"]


@pytest.fixture
def opened():
    """A page of a browser, and the list of addresses that it requests."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install playwright)")
    if CHROMIUM is None:
        pytest.skip("needs Chromium (apt-get install chromium, or set $CHROMIUM)")
    asked = []
    with playwright.sync_playwright() as program:
        browser = program.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        page.set_default_timeout(120_000)  # on a busy machine the page may be slow
        page.on("request", lambda request: asked.append(request.url))
        yield page, asked
        browser.close()


def test_a_browser_draws_formulas_and_requests_nothing_else(site, opened):
    page, asked = opened
    page.goto((site / "api" / "semfov.sensor.html").as_uri())
    fraction = page.locator("math mfrac").first.bounding_box()
    number = page.locator("math mn").first.bounding_box()
    assert fraction["height"] > 1.3 * number["height"]
    assert [address for address in asked if not address.startswith(("file:", "data:", "blob:"))] == []


ASKED = {
    "csv": "tasks/count",
    "opencv": "tasks/camera",
    "device": "tasks/running",
    "drone": "tasks/count",
    "visual angle": "tasks/eye-tracker",
    "saliency": "tasks/poster",
    "eye tracking": "tasks/eye-tracker",
    "jupyter": "tasks/running",
    "docker": "install",
    "webcam": "tasks/video",
    "threshold": "tasks/find",
    "confidence": "tasks/find",
    "windows": "install",
    "budget": "tasks/running",
    "camera": "tasks/camera",
    "video": "tasks/video",
    "heat map": "tasks/poster",
    "heatmap": "tasks/poster",
    "gpu": "tasks/running",
    "label": "tasks/count",
    "count": "tasks/count",
    "onnx": "#an-onnx-model-of-your-own",
    "offline": "install",
    "ros": "guides/robots",
    "calibration": "guides/evaluation",
    "license": "LICENSE",
    "batch": "tasks/running",
    "uncertainty": "tasks/count",
    "pomdp": "guides/environments",
    "tracking": "tasks/video",
    "mot": "tasks/video",
    "coco": "tasks/count",
    "dota": "tasks/count",
    "attention": "tasks/poster",
    "prior": "zoom",
    "stop": "tasks/find",
    "cite": "index",
    "tobii": "tasks/eye-tracker",
    "gym": "guides/environments",
    "rl": "guides/environments",
    "mask": "/zoom.html",
    "zoom": "/zoom.html",
    "resolution": "/zoom.html",
    "panorama": "/head.html",
    "ptz": "pan-tilt",
    "scanpath": "tasks/poster",
    "version": "changelog",
}
"""Words that a reader may ask for, and a page that is among the first three answers."""
ANSWERS = """() => {
  let focus = document.activeElement;
  while (focus.shadowRoot) focus = focus.shadowRoot.activeElement;
  return [...focus.getRootNode().querySelectorAll("a[href*='?h=']")].slice(0, 3).map(link => link.href);
}"""


def test_the_search_works_and_requests_nothing_from_elsewhere(site, serve, opened):
    address = serve(site)
    page, asked = opened
    page.goto(f"{address}/index.html")
    box = page.locator("input[placeholder]:visible").first
    for _ in range(60):  # until the program of the page reacts to keys
        page.keyboard.press("Control+k")
        page.wait_for_timeout(1000)
        if box.is_visible():
            break
    box.press_sequentially("Kaplan")
    page.get_by_text(re.compile(r"^\d+ results$")).first.wait_for()
    for words, wanted in ASKED.items():
        box.fill(words)
        for _ in range(20):
            page.wait_for_timeout(100)
            if f"?h={words.replace(' ', '+')}" in (answers := " ".join(page.evaluate(ANSWERS))):
                break
        assert wanted in answers, words
    assert [other for other in asked if not other.startswith((address, "data:", "blob:"))] == []


def test_language_models_get_a_table_of_contents_whose_links_lead_to_pages(site):
    text = (site / "llms.txt").read_text(encoding="utf-8")
    assert text.startswith("# semfov\n\n> ")
    links = re.findall(r"^- \[[^\]]+\]\(([^)]+)\)", text, re.MULTILINE)
    assert "tasks/language-model.html" in links
    missing = [link for link in links if not (site / link).is_file()]
    assert not missing

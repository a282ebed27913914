"""The page in a real browser: Chromium steps through an episode by keyboard.

The browser is `chromium`, `chromium-browser` or `google-chrome` on the path, or what $CHROMIUM names.
"""

import os
import shutil
from dataclasses import replace

import pytest

from semfov.report.episode import Pool, episode_data
from semfov.report.page import write_page

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install playwright)")
NAMES = (os.environ.get("CHROMIUM", ""), "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for name in NAMES if name and (path := shutil.which(name))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (apt-get install chromium, or set $CHROMIUM)"),
]


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as program:
        browser = program.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def path(scanpath, image, hostile, tmp_path):
    pool = Pool()
    views = [image * share for share in (0.3, 0.6, 0.9)]
    timed = replace(scanpath, seconds=tuple({"detect": 0.1 * number} for number in (1, 2, 3)))
    episodes = [episode_data(timed, image, views, pool, name=name) for name in (hostile, "another")]
    return write_page(tmp_path / "page.html", f"search for {hostile}", episodes, pool)


@pytest.fixture
def opened(chromium, path):
    """The page; nothing may be complained of, asked for or run that is not its own."""
    page, told = watched(chromium)
    page.goto(path.as_uri())
    yield page
    assert told == []
    page.close()


def watched(chromium):
    """A new page, and what it says: complaints, dialogs, and what it asks of the network."""
    page, told = chromium.new_page(viewport={"width": 1200, "height": 900}), []

    def dismiss(dialog):
        told.append(f"dialog: {dialog.message}")
        dialog.dismiss()

    page.on("dialog", dismiss)
    page.on("console", lambda message: told.append(message.text))
    page.on("pageerror", lambda error: told.append(str(error)))
    page.on("request", lambda request: request.url.startswith(("file:", "data:")) or told.append(request.url))
    return page, told


PICTURES = ("path", "view", "belief", "entropy", "values")


def pictures(page):
    """What is to be seen; the same drawing may differ in a pixel where the page has moved by part of one."""
    return {name: page.locator(f"#{name}").screenshot() for name in PICTURES}


def drawings(page):
    return {name: page.locator(f"#{name}").inner_html() for name in PICTURES}


def test_slider_moves_by_keyboard(opened):
    before, drawn = pictures(opened), drawings(opened)
    opened.locator("#fixation").focus()
    opened.keyboard.press("ArrowRight")
    assert opened.locator("#number").inner_text() == "1 of 2"
    after = pictures(opened)
    assert all(after[name] != before[name] for name in before)
    opened.keyboard.press("ArrowLeft")
    assert drawings(opened) == drawn


def test_arrow_keys_move_without_focus(opened):
    opened.keyboard.press("ArrowRight")
    opened.keyboard.press("ArrowRight")
    opened.keyboard.press("ArrowRight")
    assert opened.locator("#number").inner_text() == "2 of 2"
    assert opened.locator("#forward").is_disabled()
    assert "The end" in opened.locator("#status").inner_text()
    opened.keyboard.press("Home")
    assert opened.locator("#number").inner_text() == "0 of 2"


def test_another_class_changes_the_map(opened, scanpath):
    before, drawn = pictures(opened), drawings(opened)
    opened.locator("#class").select_option(label="cup")
    assert pictures(opened)["belief"] != before["belief"]
    assert drawings(opened)["values"] == drawn["values"]
    assert "Probability of cup" in opened.locator("#belief").get_attribute("aria-label")


def test_cells_have_the_colours_of_their_values(opened, scanpath):
    """The cell with the greatest value has the last colour of the map."""
    cells = opened.locator("#belief rect").evaluate_all("all => all.map(cell => cell.getAttribute('fill'))")
    assert len(cells) == 12
    opened.keyboard.press("End")
    posterior = scanpath.posterior
    look, cell = divmod(int(posterior.argmax()), 12)
    opened.locator("#fixation").fill(str(look))
    fills = opened.locator("#belief rect").evaluate_all("all => all.map(cell => cell.getAttribute('fill'))")
    assert fills[cell] == "rgb(253 231 37)"


def test_names_are_shown_and_not_run(opened, hostile):
    assert opened.title() == f"search for {hostile}"
    assert hostile in opened.locator("#class option").all_inner_texts()
    assert opened.locator("script").count() == 2
    assert hostile in opened.locator("#detections").inner_text()


def test_names_of_a_run_are_shown_and_not_run(chromium, run_page, hostile):
    page, told = watched(chromium)
    page.goto(run_page.as_uri())
    assert page.title() == f"semfov: {hostile} with {hostile}"
    for label in page.locator("#class option").all_inner_texts():
        page.locator("#class").select_option(label=label)
    page.keyboard.press("End")
    page.locator("summary").click()
    assert page.locator("script").count() == 2
    assert page.locator("main img").count() == 0
    assert told == []
    page.close()


def test_names_would_run_if_they_were_not_escaped(chromium, hostile, tmp_path):
    """Or the tests that they do not would show nothing."""
    page, told = watched(chromium)
    page.goto(write_page(tmp_path / "page.html", "t", [], Pool(), sections=hostile).as_uri())
    assert told.count("dialog: taken") >= 2
    page.close()


def test_another_episode(opened):
    opened.keyboard.press("End")
    opened.locator("#episode").select_option(index=1)
    assert opened.locator("#number").inner_text() == "0 of 2"


def test_play_goes_to_the_end(opened):
    opened.locator("#play").click()
    playwright.expect(opened.locator("#play")).to_have_text("Pause")
    playwright.expect(opened.locator("#number")).to_have_text("2 of 2")
    playwright.expect(opened.locator("#play")).to_have_text("Play")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_phone(chromium, path, scheme):
    """Nothing sticks out sideways, and text stands out from its background by 4.5 to 1 at least."""
    context = chromium.new_context(viewport={"width": 360, "height": 740}, color_scheme=scheme)
    page = context.new_page()
    page.goto(path.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    ratios = page.evaluate(CONTRAST)
    assert len(ratios) > 20
    assert min(ratios.values()) >= 4.5, ratios
    context.close()


# WCAG 2's contrast of every element that holds text itself, by its tag and the start of its text.
CONTRAST = """() => {
  const channels = (colour) => (colour.match(/[\\d.]+/g) ?? []).map(Number);
  const light = (rgb) => rgb.slice(0, 3).map((v) => v / 255)
    .map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, n) => sum + v * [0.2126, 0.7152, 0.0722][n], 0);
  const behind = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const rgb = channels(getComputedStyle(at).backgroundColor);
      if (rgb.length === 3 || rgb[3] === 1) return rgb;
    }
    return [255, 255, 255];
  };
  const ratios = {};
  const texts = "h1, h2, h3, p, label, output, button, select, figcaption, th, td, span";
  for (const element of document.querySelectorAll(texts)) {
    if (!element.textContent.trim() || element.disabled) continue;
    const [a, b] = [light(channels(getComputedStyle(element).color)), light(behind(element))];
    ratios[element.tagName + element.textContent.slice(0, 20)] = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  }
  return ratios;
}"""

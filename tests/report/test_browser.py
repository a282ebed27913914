"""The page in a real browser: Chromium steps through an episode by keyboard.

The browser is `chromium`, `chromium-browser` or `google-chrome` on the path, or the program given by $CHROMIUM.
"""

import os
import re
import shutil
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations

import pytest
import torch

from semfov import ActivePerception
from semfov.decision import Decision
from semfov.report import write_page
from semfov.report.episode import episode_data
from semfov.report.zoom import zoom_data
from semfov.viz.style import overlay_colours
from tests import small

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install playwright)")
axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-playwright-python")
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


@pytest.fixture(scope="module")
def path(scanpath, image, hostile, tmp_path_factory):
    views = [image * share for share in (0.3, 0.6, 0.9)]
    timed = small.with_looks(scanpath, stages=[{"detect": 0.1 * number} for number in (1, 2, 3)])
    settings = {"sensor": {"sigma": 20, "reference": 640, "growth": 2}, "detector": {"name": "none"}}
    names = (hostile, "another")
    episodes = [episode_data(timed, image, views, name=name, settings=settings) for name in names]
    return write_page(tmp_path_factory.mktemp("page") / "page.html", f"search for {hostile}", episodes)


@contextmanager
def watched(chromium, path):
    """The page, opened; it may give no message, error or dialog, and request nothing from elsewhere."""
    page, told = chromium.new_page(viewport={"width": 1200, "height": 900}), []

    def dismiss(dialog):
        told.append(f"dialog: {dialog.message}")
        dialog.dismiss()

    page.on("dialog", dismiss)
    page.on("console", lambda message: told.append(message.text))
    page.on("pageerror", lambda error: told.append(str(error)))
    page.on("request", lambda request: request.url.startswith(("file:", "data:")) or told.append(request.url))
    page.goto(path.as_uri())
    yield page
    page.close()
    assert told == [], "\n".join(told)


@pytest.fixture
def opened(chromium, path):
    with watched(chromium, path) as page:
        yield page


PICTURES = ("path", "view", "belief", "entropy", "values")


def pictures(page):
    """Screenshots; equal drawings may differ in a pixel if the page has moved by a fraction of a pixel."""
    return {name: page.locator(f"#{name}").screenshot() for name in PICTURES}


def drawings(page):
    return {name: page.locator(f"#{name}").inner_html() for name in PICTURES}


def test_the_slider_is_moved_by_arrow_keys(opened):
    before, drawn = pictures(opened), drawings(opened)
    opened.locator("#fixation").focus()
    opened.keyboard.press("ArrowRight")
    assert opened.locator("#number").inner_text() == "2 of 3"
    after = pictures(opened)
    assert all(after[name] != before[name] for name in before)
    opened.keyboard.press("ArrowLeft")
    assert drawings(opened) == drawn


def test_arrow_keys_work_without_focus_on_the_slider(opened):
    opened.keyboard.press("ArrowRight")
    opened.keyboard.press("ArrowRight")
    opened.keyboard.press("ArrowRight")
    assert opened.locator("#number").inner_text() == "3 of 3"
    assert opened.locator("#forward").is_disabled()
    assert "The end" in opened.locator("#status").inner_text()
    opened.keyboard.press("Home")
    assert opened.locator("#number").inner_text() == "1 of 3"


def test_selecting_another_class_changes_only_the_map(opened, scanpath):
    before, drawn = pictures(opened), drawings(opened)
    opened.locator("#class").select_option(label="cup")
    assert pictures(opened)["belief"] != before["belief"]
    assert drawings(opened)["values"] == drawn["values"]
    assert "Probability of cup" in opened.locator("#belief").get_attribute("aria-label")


def test_cells_have_the_colours_of_their_values(opened, scanpath):
    """All maps have one scale from 0, which is transparent, to 1."""
    cells = opened.locator("#belief rect").evaluate_all("all => all.map(cell => cell.getAttribute('fill'))")
    assert len(cells) == 12
    opened.keyboard.press("End")
    posterior = scanpath.posterior
    look, cell = divmod(int(posterior.argmax()), 12)
    opened.locator("#fixation").fill(str(look))
    read = "all => all.map(cell => [cell.getAttribute('fill'), Number(cell.getAttribute('fill-opacity'))])"
    shades = opened.locator("#belief rect").evaluate_all(read)
    for value, (fill, opacity) in zip(posterior[look].tolist(), shades, strict=True):
        *rgb, alpha = overlay_colours()(value)
        told = [int(part) for part in re.findall(r"\d+", fill)]
        assert told == pytest.approx([255 * part for part in rgb], abs=5)
        assert opacity == pytest.approx(alpha, abs=0.09)
    assert opened.locator("#belief-scale span").all_inner_texts()[:2] == ["0", "1"]
    assert max(range(12), key=lambda each: shades[each][1]) == cell
    assert opened.locator("#belief image").evaluate("each => getComputedStyle(each).filter") == "grayscale(1)"


def test_saccades_are_thin_and_fixations_coloured_by_time(opened):
    opened.keyboard.press("End")
    fills = opened.locator("#path circle").evaluate_all("all => all.map(each => each.getAttribute('fill'))")
    assert len(set(fills)) == len(fills) == 3
    # One unit is 1/640 of the width.
    widths = opened.locator("#path line").evaluate_all("all => all.map(each => each.getAttribute('stroke-width'))")
    assert max(float(width) for width in widths) <= 3.5 * 80 / 640


@pytest.mark.parametrize(("size", "scheme"), [((1200, 900), "light"), ((360, 740), "dark")], ids=["desktop", "phone"])
@pytest.mark.parametrize("kind", ["episodes", "run", "notebook", "large"])
def test_axe_finds_no_accessibility_violation_and_the_page_fits(
    chromium, path, run_page, zoom_page, scanpath, kind, size, scheme, tmp_path
):
    if kind == "notebook":
        frame = scanpath._repr_html_()
        page_file = tmp_path / "notebook.html"
        page_file.write_text(f'<!DOCTYPE html><html lang="en"><title>n</title><main><h1>n</h1>{frame}</main>', "utf-8")
    else:
        page_file = {"episodes": path, "run": run_page, "large": zoom_page}[kind]
    context = chromium.new_context(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
    page = context.new_page()
    page.goto(page_file.as_uri())
    page.keyboard.press("End")
    found = axe.Axe().run(page)
    assert found.violations_count == 0, found.generate_report()
    assert len(found.response["passes"]) > 8
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0], "wider than the screen"
    if kind in ("episodes", "large"):  # axe leaves the contrast of some texts open
        ratios = page.evaluate(CONTRAST)
        assert len(ratios) > 20
        assert min(ratios.values()) >= 4.5, ratios
    context.close()


def test_the_page_in_a_frame_is_isolated_from_the_notebook(chromium, scanpath, tmp_path):
    """Styles of the notebook do not apply to the page, and its program cannot read the notebook."""
    file = tmp_path / "notebook.html"
    style = "<style>* { color: red !important; display: block }</style><p id=outcome>mine</p>"
    file.write_text(f"<!DOCTYPE html>{style}{scanpath._repr_html_()}", "utf-8")
    with watched(chromium, file) as page:
        inside = page.frame_locator("iframe")
        assert inside.locator("#number").inner_text() == "1 of 3"
        inside.locator("#forward").click()
        assert inside.locator("#number").inner_text() == "2 of 3"
        assert inside.locator("h1").evaluate("each => getComputedStyle(each).color") != "rgb(255, 0, 0)"
        assert (
            inside.locator("h1").evaluate("() => { try { return parent.document.title } catch { return 'refused' } }")
            == "refused"
        )
        height = page.locator("iframe").bounding_box()["height"]
        assert 400 <= height <= 900


def test_curves_fit_on_a_phone(chromium, run_page):
    """They fit without scrolling, and their numbers are large enough to read."""
    context = chromium.new_context(viewport={"width": 360, "height": 740})
    page = context.new_page()
    page.goto(run_page.as_uri())
    box = page.locator(".curves > svg").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= 360
    assert (
        page.locator(".curves > svg").evaluate(
            "each => each.parentElement.scrollWidth - each.parentElement.clientWidth"
        )
        <= 0
    )
    heights = page.locator(".curves > svg text:visible").evaluate_all("all => all.map(e => e.getBoundingClientRect())")
    assert len(heights) > 5
    assert min(each["height"] for each in heights) >= 11
    for each in heights:
        assert box["x"] - 0.5 <= each["left"] <= each["right"] <= box["x"] + box["width"] + 0.5
    for a, b in combinations(heights, 2):
        apart = a["right"] <= b["left"] or b["right"] <= a["left"] or a["bottom"] <= b["top"] or b["bottom"] <= a["top"]
        assert apart
    context.close()


def test_names_of_an_episode_are_shown_and_not_run(opened, hostile):
    assert opened.title() == f"search for {hostile}"
    assert hostile in opened.locator("#class option").all_inner_texts()
    assert opened.locator("script").count() == 2
    assert hostile in opened.locator("#detections").inner_text()


def test_names_of_a_run_are_shown_and_not_run(chromium, run_page, hostile):
    with watched(chromium, run_page) as page:
        assert page.title() == f"semfov: {hostile} with {hostile}"
        for label in page.locator("#class option").all_inner_texts():
            page.locator("#class").select_option(label=label)
        page.keyboard.press("End")
        page.locator("summary").click()
        assert page.locator("script").count() == 2
        assert page.locator("main img").count() == 0


def test_names_that_are_not_escaped_run(chromium, hostile, tmp_path):
    """Without this, the tests above could pass with harmless names."""
    page = write_page(tmp_path / "page.html", "t", [], sections=hostile)
    with pytest.raises(AssertionError, match=r"(?s)dialog: taken.*dialog: taken"), watched(chromium, page):
        pass


def test_selecting_another_episode_starts_at_its_first_fixation(opened):
    opened.keyboard.press("End")
    opened.locator("#episode").select_option(index=1)
    assert opened.locator("#number").inner_text() == "1 of 3"


def test_the_play_button_runs_to_the_last_fixation(opened):
    opened.locator("#play").click()
    playwright.expect(opened.locator("#play")).to_have_text("Pause")
    playwright.expect(opened.locator("#number")).to_have_text("3 of 3")
    playwright.expect(opened.locator("#play")).to_have_text("Play")


def test_keys_and_clicks_choose_a_look(chromium, zoom_page, hostile):
    with watched(chromium, zoom_page) as page:
        assert page.locator("#episode-views").is_hidden()
        shown = page.locator(".look:visible")
        assert shown.locator("h4").all_inner_texts() == ["Look 1: the whole picture"]
        assert page.get_by_role("button", name="Next look").count() == 1
        page.keyboard.press("ArrowRight")
        assert shown.locator("h4").all_inner_texts() == ["Look 2"]
        assert page.locator("#number").inner_text() == "2 of 3"
        assert page.locator("#status").inner_text().startswith("Look 2 of 3 at (100, 100)")
        chosen = page.locator(".chosen rect").first
        assert [chosen.get_attribute(name) for name in ("x", "y", "width", "height")] == ["0", "0", "200", "200"]
        assert page.locator(".window.now").get_attribute("data-look") == "1"
        assert page.locator(".window.later").get_attribute("data-look") == "2"
        page.locator(".window[data-look='2'] text").click()
        assert shown.locator("h4").all_inner_texts() == ["Look 3"]
        assert page.locator(".object.now").get_attribute("data-look") == "2"
        page.locator("#fixation").focus()
        page.keyboard.press("Home")
        assert page.locator("#number").inner_text() == "1 of 3"
        assert hostile in page.locator("#about").inner_text()


def test_the_page_opens_with_all_objects_whose_rows_are_chosen_and_sorted(chromium, zoom_page):
    with watched(chromium, zoom_page) as page:
        assert (page.locator(".object").count(), page.locator(".object.later").count()) == (2, 0)
        rows = page.locator(".objects tbody tr")
        first = rows.first.locator(".crop").screenshot()
        assert len(set(first)) > 50  # it shows something
        rows.nth(1).click()
        assert page.locator(".object.picked").get_attribute("data-look") == "2"
        assert page.locator("#number").inner_text() == "3 of 3"
        heads = page.locator(".objects th[scope=col]")
        heads.filter(has_text="score").get_by_role("button").click()
        scores = page.locator(".objects tbody tr td:nth-child(4)")
        ascending = scores.all_inner_texts()
        assert ascending == sorted(ascending)
        heads.filter(has_text="score").get_by_role("button").click()
        assert scores.all_inner_texts() == ascending[::-1]
        assert heads.filter(has_text="score").get_attribute("aria-sort") == "descending"
        for switch, drawn in (("Windows", ".window"), ("Names", ".object .name")):
            assert page.locator(drawn).first.is_visible()
            page.get_by_role("checkbox", name=switch).uncheck()
            assert not page.locator(drawn).first.is_visible()


def test_small_and_large_pictures_are_chosen_on_one_page(chromium, scanpath, image, zoom_path, large_picture, tmp_path):
    large = zoom_data(zoom_path, large_picture, name="large.jpg")
    explored = replace(scanpath, target=None, posterior=None, score_threshold=0.1)
    small = episode_data(explored, image, [image] * 3, name="small.jpg")
    both = write_page(tmp_path / "both.html", "both", [large, small, {**large, "name": "other.jpg"}])
    with watched(chromium, both) as page:
        for number, visible in ((1, []), (2, ["other.jpg"]), (0, ["large.jpg"])):
            page.locator("#episode").select_option(index=number)
            assert page.locator(".large:visible > h3:first-child").all_inner_texts() == visible
            assert page.locator("#episode-views").is_visible() == (not visible)
            assert page.locator("#word").inner_text() == ("Look" if visible else "Fixation")
            assert page.locator("#about dd").nth(2).is_visible() == bool(visible)
            assert page.locator(".of-episode").is_visible() == (not visible)
            page.locator("#forward").click()
            assert page.locator("#number").inner_text() == "2 of 3"
            if not visible:  # an object of fixations is shown by a part of the picture, and goes to its fixation
                row = page.locator("tr[data-object]:visible").first
                assert row.locator(".crop").evaluate("crop => crop.firstElementChild.getBBox().width") > 0
                row.click()
                assert page.locator("#number").inner_text() == f"{int(row.get_attribute('data-look')) + 1} of 3"
                assert page.locator("tr.picked:visible").count() == 1


@pytest.mark.parametrize("size", [(390, 844), (1366, 768)])
def test_an_overview_is_on_the_first_screen_and_leads_to_each_picture(
    chromium, zoom_path, large_picture, tmp_path, size
):
    found = replace(zoom_path, classes=("background", "cat", "dog", "cup"))
    nothing = replace(found, decision=Decision("absent", 0.2))
    data = [zoom_data(nothing, large_picture, name=f"nothing-{number}.jpg") for number in range(30)]
    data.append(zoom_data(found, large_picture, name="cup.jpg"))
    path = write_page(tmp_path / "many.html", "many", data)
    with watched(chromium, path) as page:
        page.set_viewport_size({"width": size[0], "height": size[1]})
        rows = page.locator("#overview tbody tr")
        assert rows.count() == 31
        assert rows.nth(3).bounding_box()["y"] < size[1]
        assert rows.first.locator("svg").bounding_box()["height"] > 40
        assert page.locator("#viewer").bounding_box()["y"] < size[1]
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        for row, chosen in ((0, "cup.jpg"), (1, "nothing-0.jpg")):
            rows.nth(row).locator("a").click()
            page.locator(".large:not([hidden]) h3", has_text=chosen).wait_for()
            assert page.locator("#viewer").bounding_box()["y"] == pytest.approx(0, abs=2)
            assert page.locator("#episode option:checked").inner_text().startswith(f"{chosen}: ")
        page.go_back()
        page.locator(".large:not([hidden]) h3", has_text="cup.jpg").wait_for()
        page.locator("#episode").select_option(index=3)
        assert page.locator(".large:visible h3").first.inner_text() == "nothing-3.jpg"
        rows.first.locator("a").click()  # the address of the page is that one already
        page.locator(".large:not([hidden]) h3", has_text="cup.jpg").wait_for()
        assert page.locator("#viewer").bounding_box()["y"] == pytest.approx(0, abs=2)
    with watched(chromium, path.parent / path.name) as page:
        page.goto(f"{path.as_uri()}#large-30")
        assert page.locator(".large:visible h3").first.inner_text() == "cup.jpg"


def test_a_portrait_picture_is_no_higher_than_the_screen(chromium, tmp_path):
    portrait = torch.rand(3, 900, 300, generator=torch.Generator().manual_seed(0))
    prediction = ActivePerception.recommended().gaze(portrait)
    with watched(chromium, prediction.report(tmp_path / "gaze.html")) as page:
        picture = page.locator("#image").bounding_box()
        assert picture["height"] <= 0.81 * 900
        assert picture["height"] / picture["width"] == pytest.approx(3, rel=0.02)
        assert page.locator("#map").bounding_box() == picture


def test_without_javascript_all_looks_are_shown(chromium, zoom_page):
    context = chromium.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(zoom_page.as_uri())
    assert page.locator(".look:visible").count() == 3
    assert page.locator(".controls").is_hidden()
    context.close()


# Contrast by WCAG 2 of every element with text; keys are the tag and the start of the text.
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
  const texts = "h1, h2, h3, h4, p, label, dt, dd, output, button, select, figcaption, th, td, span";
  for (const element of document.querySelectorAll(texts)) {
    if (!element.textContent.trim() || element.disabled) continue;
    const [a, b] = [light(channels(getComputedStyle(element).color)), light(behind(element))];
    ratios[element.tagName + element.textContent.slice(0, 20)] = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  }
  return ratios;
}"""

"""Pages of episodes and of places of gaze, and views in a notebook: well-formed, with the numbers of records."""

import base64
import html
import io
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from PIL import Image

from eval.comparison.curves_html import curves_html
from semfov import Detections, Grid
from semfov.decision import Decision
from semfov.detection import Placement
from semfov.gaze.saliency import FixationDensity
from semfov.paths import GazePrediction
from semfov.paths.drafts import Drafts
from semfov.paths.stimulus import Stimulus, in_bytes
from semfov.report import notebook, page_html, write_page
from semfov.report.episode import episode_data
from semfov.report.gaze import gaze_page_html, gaze_part
from semfov.report.markup import table_html
from semfov.report.template import write_html
from tests import small
from tests.report.pages import Elements, data_of, loads_nothing, names_are_text
from tests.report.test_browser import axe, chromium, playwright, pytestmark, watched  # noqa: F401
from tests.small import rand, slopes


@pytest.fixture
def page(scanpath, image, hostile, tmp_path):
    timed = small.with_looks(scanpath, stages=[{"detect": 0.1, "choose": 0.001}] * 3)
    data = episode_data(timed, image, [image * 0.5] * 3, name=hostile)
    sections = table_html([[hostile, "1"], [hostile, hostile]], hostile)
    return write_page(tmp_path / "page.html", hostile, [data], sections=sections).read_text(encoding="utf-8")


def decoded(data, *shape):
    steps = np.frombuffer(base64.b64decode(data["data"]), np.uint8).reshape(shape)
    return steps / 255 * data["max"]


@pytest.mark.parametrize("kind", ["episode", "run"])
def test_names_are_never_interpreted_as_markup(kind, hostile, request):
    if kind == "run":
        page = request.getfixturevalue("run_page").read_text(encoding="utf-8")
    else:
        page = request.getfixturevalue("page")
    elements = names_are_text(page, hostile)
    assert elements.texts.count(hostile) >= 3
    assert any(hostile in (attributes.get("aria-label") or "") for _, attributes in elements.found)
    (episode,) = data_of(page)["episodes"]
    assert episode["name"].startswith(hostile)
    assert hostile in {each["label"] for each in episode["maps"]}


def test_a_page_begins_with_its_summary_or_else_with_the_outcome_of_the_episode(run_page, scanpath, image, tmp_path):
    run = run_page.read_text(encoding="utf-8")
    assert run.index("<section><h2>") < run.index('id="viewer"') < run.index('id="about"')
    data = episode_data(scanpath, image, [image] * 3, name="kitchen")
    single = write_page(tmp_path / "page.html", "Cup", [data]).read_text(encoding="utf-8")
    outcome = single.index(html.escape(data["decision"]))
    assert outcome < single.index('id="viewer"') < single.index('id="path"') < single.index('id="about"')
    both = page_html("Cup", [data, data])
    assert both.index('id="episode"') < both.index('id="about"')


def test_names_are_not_interpreted_as_placeholders_of_the_template(scanpath, image, tmp_path):
    data = episode_data(scanpath, image, [image] * 3, name="{{program}}")
    page = write_page(tmp_path / "page.html", "{{data}}", [data]).read_text(encoding="utf-8")
    assert "<title>{{data}}</title>" in page
    assert data_of(page)["episodes"][0]["name"] == "{{program}}"


def test_the_page_loads_nothing_from_elsewhere(page):
    loads_nothing(page)


def test_the_page_contains_the_beliefs(page, scanpath):
    (episode,) = data_of(page)["episodes"]
    maps = {each["label"]: decoded(each, 3, 12) for each in episode["maps"]}
    first, *_, last = maps
    # The map of the target is the posterior of the search.
    assert (first, last) == (scanpath.classes[2], "background")
    assert len(episode["maps"]) == len(scanpath.classes)
    np.testing.assert_allclose(maps[first], scanpath.posterior, atol=1 / 500)
    probabilities = scanpath.probabilities
    for index, name in enumerate(scanpath.classes):
        if index != scanpath.target:
            np.testing.assert_allclose(maps[name], probabilities[..., index], atol=1 / 500)
    entropy = -(probabilities * probabilities.log2()).sum(-1)
    np.testing.assert_allclose(decoded(episode["entropy"], 3, 12), entropy, atol=2 / 500)


def test_the_page_contains_fixations_detections_and_pictures(page, scanpath, image):
    data = data_of(page)
    (episode,) = data["episodes"]
    assert [each["cell"] for each in episode["fixations"]] == [0, 6, 11]
    assert [each["next"] for each in episode["fixations"]] == [6, 11, None]
    for number, each in enumerate(episode["fixations"]):
        np.testing.assert_allclose(each["values"], scanpath.values[number], rtol=1e-3)
        seen = scanpath.detections[number]
        rows = seen.confidence[0].argsort(descending=True).tolist()
        for row, detection in zip(rows, each["detections"], strict=False):
            np.testing.assert_allclose(detection["box"], seen.boxes[0, row], atol=0.06)
            best = seen.scores[0, row, 1:].sort(descending=True)
            assert [name for name, _ in detection["scores"]] == [scanpath.classes[index + 1] for index in best.indices]
            np.testing.assert_allclose([score for _, score in detection["scores"]], best.values, rtol=1e-3)
        assert each["seconds"] == {"detect": 0.1, "choose": 0.001}
    picture = data["pictures"][episode["image"]]
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.split(",")[1]))), dtype=float) / 255
    assert np.abs(pixels - image.permute(1, 2, 0).numpy()).mean() < 0.02
    assert len(data["pictures"]) == 2  # the three views are equal


def test_curves_have_their_points_and_a_legend(hostile):
    text = curves_html({"flat": np.full(3, 0.5), hostile: np.array([0, 0.5, 1.0])}, {"flat": np.full(3, 0.1)}, hostile)
    assert hostile not in text
    lines = re.findall(r'<polyline [^>]*points="([^"]+ [^"]+ [^"]+)"', text)
    flat, rising = ([tuple(map(float, point.split(","))) for point in line.split()] for line in lines)
    assert len({y for _, y in flat}) == 1
    assert rising[1] == flat[1]
    assert rising[0][1] - rising[1][1] == pytest.approx(rising[1][1] - rising[2][1], abs=0.2)
    assert text.count("<polygon") == 1
    curves = {"random": np.zeros(3)} | {f"policy {number}": np.full(3, number / 40) for number in range(30)}
    text = curves_html(curves, {}, hostile)
    entries = re.findall(r"</svg> ([^<]+)</li>", text)
    assert entries == ["random", *(f"policy {number}" for number in range(24, 30)), "24 others"]
    assert text.count("<polyline") == 31 + len(entries)
    few = curves_html(dict(list(curves.items())[:3]), {}, hostile)
    assert re.findall(r"</svg> ([^<]+)</li>", few) == ["random", "policy 0", "policy 1"]


def test_classes_of_the_same_name_have_separate_entries(scanpath, image):
    """A detector may use one name for several classes."""
    twins = replace(scanpath, classes=("background", "N/A", "cup", "N/A"))
    data = episode_data(twins, image, [image] * 3, name="twins")
    labels = [each["label"] for each in data["maps"]]
    assert labels[0] == "cup"
    assert sorted(labels) == ["N/A", "N/A (2)", "background", "cup"]


def test_what_an_episode_lacks_is_left_out(scanpath, image, tmp_path):
    data = episode_data(scanpath, image, [image] * 3, name="replayed")
    assert [each["seconds"] for each in data["fixations"]] == [None] * 3
    data = episode_data(replace(scanpath, posterior=None), image, [image] * 3, name="few", classes=1)
    assert [each["label"] for each in data["maps"]] == [scanpath.classes[2], "background"]
    values = scanpath.values.clone()
    values[0, 3] = -torch.inf
    data = episode_data(replace(scanpath, values=values), image, [image] * 3, name="-inf")
    page = write_page(tmp_path / "page.html", "t", [data]).read_text(encoding="utf-8")
    assert data_of(page)["episodes"][0]["fixations"][0]["values"][3] is None
    data = episode_data(scanpath, None, None, name="in the dark")
    page = write_page(tmp_path / "page.html", "t", [data]).read_text(encoding="utf-8")
    assert data_of(page)["pictures"] == []
    assert '<div hidden><dt>Detector</dt><dd data-about="detector"></dd></div>' in page


def test_the_head_shows_photograph_settings_and_outcome(scanpath, image, hostile, tmp_path):
    """It is also shown without JavaScript."""
    settings = {"detector": {"name": hostile}, "sensor": {"sigma": 50.0, "reference": 640.0, "growth": 1.0}}
    decided = replace(scanpath, decision=Decision("found", 0.97, 6), ending="decision")
    data = episode_data(decided, image, [image] * 3, name="a.jpg", settings=settings)
    page = write_page(tmp_path / "page.html", "t", [data]).read_text(encoding="utf-8")
    texts = Elements(page).texts
    assert {"a.jpg", hostile, "fovea of 50 px in 640, growth 1"} <= set(texts)
    (told,) = [text for text in texts if "found after" in text and "{" not in text]
    assert told.endswith("It is at column 2, row 1.")
    assert page.index("found after") < page.index("<main>")


def test_a_page_of_fixations_lists_the_objects_that_its_outcome_counts(scanpath, image):
    """Passes and size stand beside them, and numbers are those of the record, rounded once."""
    boxes = torch.tensor([[[10.0, 10, 21.46, 30], [40.0, 20, 60, 50]]])
    scores = torch.tensor([[[0.1, 0.1, 0.1, 0.63499], [0.1, 0.5, 0.2, 0.2]]])
    looks = (Detections(boxes, scores, torch.ones(1, 2, dtype=torch.bool)), *scanpath.detections[1:])
    explored = replace(
        small.with_looks(scanpath, detections=looks), target=None, posterior=None, score_threshold=0.5, detector="net"
    )
    data = episode_data(explored, image, [image] * 3, name="kitchen")
    page = page_html("kitchen", [data])
    rows = re.findall(r'<tr data-object="(\d)" data-look="(\d)">(.*?)</tr>', page)
    told = [re.findall(r'<td class="number">(.*?)</td>', cells) for *_, cells in rows]
    assert len(rows) == len(explored.objects) > 1
    assert told[0] == ["cup", "0.63", "1", "10,10–21,30"]
    assert f"{len(rows)} objects found" in data["decision"]
    elements = Elements(page)
    assert {"80 × 60 px", "net"} <= set(elements.texts)
    assert len(elements.of("crop")) == len(rows)
    assert data_of(page)["episodes"][0]["article"] in {attributes.get("id") for _, attributes in elements.found}


@pytest.mark.parametrize("how", ["fovea", "windows"])
def test_a_page_names_the_detector_and_so_does_a_page_of_a_file(how, tmp_path):
    agent = small.agent(small.Fixed(("cup", "bowl")), grid=(4, 3), sigma=10.0, reference=64.0)
    record = agent.explore(np.zeros((64, 128, 3), np.uint8), how=how, passes=2)
    record.save(tmp_path / "record.safetensors")
    for each in (record, type(record).load(tmp_path / "record.safetensors")):
        page = each.report(tmp_path / "page.html").read_text(encoding="utf-8")
        assert f'<div><dt>Detector</dt><dd data-about="detector">{agent.eye.detector.name}</dd></div>' in page


def test_the_page_contains_the_outcome(scanpath, image):
    """The decision, why the episode ended, and the probability of presence after each look."""
    decision = Decision("found", 0.97, 6, torch.tensor([1.0, 2.0, 30.25, 40.0]))
    presence = torch.tensor([0.25, 0.5, 0.97])
    searched = replace(scanpath, decision=decision, ending="decision", presence=presence)
    data = episode_data(searched, image, [image] * 3, name="sought")
    assert data["outcome"] == {"why": searched.why_it_ended(), "cell": 6, "box": [1.0, 2.0, 30.2, 40.0]}
    assert data["presence"] == pytest.approx([0.25, 0.5, 0.97])
    assert data["outcome"]["why"] != replace(searched, decision=Decision("absent", 0.1)).why_it_ended() != ""
    for ending in ("box", "min_gain", "shifts", "cells"):
        ended = replace(scanpath, ending=ending)
        data = episode_data(ended, image, [image] * 3, name="other")
        assert data["outcome"] == {"why": ended.why_it_ended(), "cell": None, "box": None}
        assert data["outcome"]["why"].endswith(".")
    assert replace(scanpath, ending=None).why_it_ended() == ""


def predicted(name, size=(104, 78), seed=0):
    torch.manual_seed(seed)
    model = FixationDensity({"backbone8": 3}).eval().requires_grad_(False)
    model.oculomotor.saccade.normal_(0, 0.5)
    terms = {"map": 4 * torch.randn(1, 39, 52), "centre bias": -rand(1, 39, 52)}
    return GazePrediction(model, terms, size, slopes(104, 78), name)


def drawn(name, seed=0):
    prediction = predicted(name, seed=seed)
    return gaze_part(prediction, prediction.scanpaths(5, seed=seed))


@pytest.fixture(scope="module")
def gaze_page(hostile, few_viewers, tmp_path_factory):
    """The file of a page of two pictures."""
    pictures = [drawn(hostile), drawn("b.png", seed=1)]
    page = gaze_page_html(f"where people look in {hostile}", pictures)
    return write_html(tmp_path_factory.mktemp("gaze") / "gaze.html", page)


@pytest.fixture
def opened(chromium, gaze_page):  # noqa: F811
    """The page of two pictures, as it is when it has been opened."""
    with watched(chromium, gaze_page) as page:
        yield page


def circles(page):
    return page.locator("#drawing circle").count()


def heat(page):
    return page.locator("#map").evaluate("each => each.toDataURL()")


def test_the_slider_steps_through_the_fixations(opened):
    most = int(opened.locator("#fixation").get_attribute("max"))
    assert opened.locator("#number").inner_text() == "all"
    assert opened.locator("#word").inner_text() == "Fixations:"
    assert opened.locator("#status").inner_text() == "The first three fixations, and where most are"
    assert circles(opened) == 3  # the first fixations of all viewers
    before = heat(opened)
    opened.keyboard.press("ArrowRight")
    assert opened.locator("#number").inner_text() == f"1 of {most}"
    assert opened.locator("#word").inner_text() == "Fixation"
    assert circles(opened) == 5
    assert heat(opened) != before
    assert "after 1 fixation" in opened.locator("#status").inner_text()
    opened.keyboard.press("End")
    assert opened.locator("#forward").is_disabled()
    opened.keyboard.press("Home")
    assert heat(opened) == before


def test_one_viewer_can_be_followed(opened):
    """By the list and by keys, up to the viewer's own last fixation."""
    lengths = [len(each) for each in predicted("a.png").scanpaths(5, seed=0)]
    most = int(opened.locator("#fixation").get_attribute("max"))
    opened.keyboard.press("ArrowDown")
    opened.keyboard.press("ArrowDown")
    assert opened.locator("#who").input_value() == "2"
    opened.keyboard.press("End")
    assert opened.locator("#number").inner_text() == f"{min(lengths[1], most)} of {min(lengths[1], most)}"
    assert circles(opened) == min(lengths[1], most)
    assert opened.locator("#status").inner_text().startswith("Viewer 2. ")
    opened.locator("#who").select_option(label="viewer 5")
    assert circles(opened) <= lengths[4]
    opened.locator("#picture").select_option(label="b.png")
    assert opened.locator("#who").input_value() == "5"
    opened.locator("#who").select_option(label="all viewers")
    assert not opened.locator("#status").inner_text().startswith("Viewer")


def test_layers_can_be_switched(opened):
    opened.keyboard.press("ArrowRight")
    opened.locator("#paths").uncheck()
    assert circles(opened) == 0
    assert opened.locator("#drawing .border").count() == 4  # a line under each
    opened.locator("#borders").uncheck()
    assert opened.locator("#drawing .border").count() == 0
    assert not opened.locator("#areas").is_visible()  # as none are given
    opened.locator("#heat").uncheck()
    assert not opened.locator("#map").is_visible()


def test_several_pictures_begin_with_an_overview_that_leads_to_each(opened, hostile):
    names = [predicted(hostile).name, "b.png"]
    rows = opened.locator("#overview tbody tr")
    assert rows.locator("a").all_inner_texts() == names
    assert rows.first.locator("ellipse").count() == 3
    rows.nth(1).locator("a").click()
    playwright.expect(opened.locator("#image")).to_have_attribute("alt", "b.png")
    assert opened.locator("#picture").input_value() == "1"
    opened.locator("#overview .sort").first.click()
    assert opened.locator("#overview [aria-sort=ascending]").inner_text() == "picture"
    assert sorted(rows.locator("a").all_inner_texts()) == sorted(names)


@pytest.mark.usefixtures("few_viewers")
def test_an_overview_has_shares_of_areas_and_cautions_where_there_are_some():
    prediction = predicted("a.png")
    viewers = prediction.scanpaths(2, seed=0)
    with_area = gaze_part(prediction, viewers, {"<logo>": (0, 0, 39, 78)})
    without = gaze_part(prediction, viewers)
    page = gaze_page_html("two", [with_area, without | {"caution": "very <small>"}])
    overview = page[page.index('id="overview"') : page.index("</section>")]
    share = 100 * prediction.share({"<logo>": (0, 0, 39, 78)})["<logo>"]
    assert "&lt;logo&gt;" in overview
    assert float(re.search(r'<td class="number">([\d.]+) %', overview)[1]) == pytest.approx(share, abs=0.5)
    assert "very &lt;small&gt;" in overview
    assert "caution" not in gaze_page_html("two", [without, without]).split("</section>")[0].split('id="overview"')[1]
    assert 'id="overview"' not in gaze_page_html("one", [with_area])
    assert 'id="overview"' not in gaze_page_html("compared", [without, without], "<section>both</section>")


@pytest.mark.usefixtures("few_viewers")
def test_names_of_areas_cover_none_of_them_and_stay_in_the_picture(chromium, tmp_path):  # noqa: F811
    """Only at the upper border, where there is no room above, is the name in its area."""
    name = "the button that leads to the shop"
    areas = {name: (70, 50, 100, 60), "headline": (6, 12, 60, 20), "top": (2, 1, 40, 9)}
    prediction = predicted("a.png")
    part = gaze_part(prediction, prediction.scanpaths(2, seed=0), areas)
    path = write_html(tmp_path / "gaze.html", gaze_page_html("areas", [part]))
    with watched(chromium, path) as page:
        picture = page.locator("#drawing").bounding_box()
        boxes = [each.bounding_box() for each in page.locator("#drawing .area").all()]
        names = page.locator("#drawing text:not(.order)")
        assert [text.rpartition(" %")[0].rpartition(" ")[0] for text in names.all_text_contents()] == [*areas]
        labels = [each.bounding_box() for each in names.all()]
    for label in labels:
        assert label["x"] >= picture["x"]
        assert label["x"] + label["width"] <= picture["x"] + picture["width"]
    for label, box in zip(labels[:2], boxes[:2], strict=True):
        assert label["y"] + label["height"] <= box["y"] + 2  # a part of the height is below the letters
    assert labels[2]["y"] >= boxes[2]["y"] - 2


@pytest.mark.usefixtures("few_viewers")
def test_the_table_of_two_drafts_fits_a_telephone(chromium, tmp_path):  # noqa: F811
    drafts = Drafts(predicted("before-the-new-layout.png"), predicted("after-the-new-layout.png", seed=1))
    areas = {"the button that leads to the shop": (70, 50, 100, 60), "headline": (6, 12, 60, 20)}
    path = drafts.report(tmp_path / "drafts.html", areas=areas)
    with watched(chromium, path) as page:
        page.set_viewport_size({"width": 390, "height": 844})
        table = page.locator("table.wraps").bounding_box()
        assert table["x"] + table["width"] <= 390


def test_another_picture_can_be_chosen(opened, hostile):
    before = heat(opened)
    assert opened.locator("#facts-0").is_visible()
    opened.locator("#picture").select_option(label="b.png")
    assert heat(opened) != before
    assert opened.locator("#facts-1").is_visible()
    assert not opened.locator("#facts-0").is_visible()
    assert opened.locator("#image").get_attribute("alt") == "b.png"


def test_the_heat_map_has_the_densities(opened):
    """The most opaque pixel is the cell of the largest probability."""
    cells = predicted("b.png").cells
    context = 'each.getContext("2d").getImageData(0, 0, each.width, each.height).data'
    read = f"each => [...{context}].filter((_, n) => n % 4 == 3)"
    opacity = torch.tensor(opened.locator("#map").evaluate(read)).view(39, 52)
    assert int(opacity.max()) == int(opacity.flatten()[cells.argmax()])
    assert float(torch.corrcoef(torch.stack([opacity.flatten().float(), cells.flatten()]))[0, 1]) > 0.6


def test_it_fits_a_phone_and_is_accessible(opened):
    opened.set_viewport_size({"width": 360, "height": 700})
    assert opened.evaluate("document.documentElement.scrollWidth") <= 360
    results = axe.Axe().run(opened)
    assert [each["id"] for each in results.response["violations"]] == []


def test_play_goes_to_the_end(opened):
    opened.locator("#play").click()
    assert opened.locator("#play").inner_text() == "Pause"
    opened.locator("#play").click()
    assert opened.locator("#play").inner_text() == "Play"


class Frame(HTMLParser):
    """The elements in the output of a cell."""

    def __init__(self, text):
        super().__init__()
        self.tags = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))


def with_photograph(scanpath, image):
    """The scanpath with its photograph."""
    height, width = image.shape[-2:]
    sensor = {"sigma": 20.0, "levels": 2, "growth": 2.0, "convention": "kornia", "reference": 640.0}
    settings = {"sensor": sensor, "detector": {"name": "none"}}
    placement = Placement((80, 60), (width / 80, height / 60), (0, 0))
    pixels = in_bytes(image)
    return replace(scanpath, photograph=pixels, stimulus=Stimulus(pixels, placement, settings))


def test_the_frame_contains_the_page(scanpath, image, hostile):
    text = with_photograph(scanpath, image)._repr_html_()
    ((tag, attributes),) = Frame(text).tags
    assert tag == "iframe"
    assert attributes["sandbox"] == "allow-scripts"
    assert hostile in attributes["title"]
    page = attributes["srcdoc"]
    assert page.startswith("<!DOCTYPE html>")
    data = data_of(page)
    (episode,) = data["episodes"]
    assert len(episode["fixations"]) == 3
    assert (episode["name"], episode["detector"]) == ("80 × 60 px", "none")
    assert len(data["pictures"]) == 4
    assert html.unescape(re.search('srcdoc="([^"]*)"', text)[1]) == page


def test_without_a_photograph_there_are_no_pictures(scanpath):
    page = Frame(scanpath._repr_html_()).tags[0][1]["srcdoc"]
    data = data_of(page)
    assert data["pictures"] == []
    assert data["episodes"][0]["image"] is None
    assert data["episodes"][0]["detector"] is None


def scanpath_of(looks, columns, classes):
    grid = Grid(columns, columns, (80, 60))
    names = ("background", *(f"class {number}" for number in range(classes)))
    return small.scanpath(grid, torch.arange(looks) % len(grid), names, target=1)


@pytest.mark.parametrize(
    ("looks", "columns", "classes", "size", "shown"),
    [(31, 10, 80, 200, True), (120, 10, 80, 416, True), (31, 40, 80, 200, True), (900, 40, 2, 20, False)],
)
def test_the_size_of_the_output_is_limited(looks, columns, classes, size, shown):
    """If the output is too large: coarser pictures and fewer classes, then only text."""
    noise = torch.rand(3, size * 3 // 4, size)
    text = with_photograph(scanpath_of(looks, columns, classes), noise)._repr_html_()
    assert len(text.encode()) <= notebook._MOST_CHARACTERS
    if shown:
        episode = data_of(Frame(text).tags[0][1]["srcdoc"])["episodes"][0]
        assert len(episode["fixations"]) == looks
        labels = [each["label"] for each in episode["maps"]]
        assert labels[0] == "class 0"
        assert labels[-1] == "background"
    else:
        assert Frame(text).tags == [("pre", {})]
        assert "class 0" in text

"""The page of where people look in a real browser: slider, layers and pictures."""

import pytest
import torch

from semfov.gaze.saliency import FixationDensity
from semfov.paths import GazePrediction
from semfov.report.gaze import gaze_part, write_gaze_page
from tests.report.test_browser import axe, chromium, pytestmark, watched  # noqa: F401
from tests.small import rand


def predicted(name, size=(104, 78), seed=0):
    torch.manual_seed(seed)
    model = FixationDensity({"backbone8": 3}).eval().requires_grad_(False)
    model.oculomotor.saccade.normal_(0, 0.5)
    terms = {"map": 4 * torch.randn(1, 39, 52), "centre bias": -rand(1, 39, 52)}
    return GazePrediction(model, terms, size, (rand(3, 78, 104) * 255).byte(), name)


def drawn(name, seed=0):
    prediction = predicted(name, seed=seed)
    return gaze_part(prediction, prediction.scanpaths(5, seed=seed))


@pytest.fixture
def opened(chromium, hostile, tmp_path):  # noqa: F811
    """The page of two pictures."""
    pictures = [drawn(hostile), drawn("b.png", seed=1)]
    path = write_gaze_page(tmp_path / "gaze.html", f"where people look in {hostile}", pictures)
    with watched(chromium, path) as page:
        yield page


def circles(page):
    return page.locator("#drawing circle").count()


def heat(page):
    return page.locator("#map").evaluate("each => each.toDataURL()")


def test_the_slider_steps_through_the_fixations(opened):
    most = int(opened.locator("#fixation").get_attribute("max"))
    assert opened.locator("#number").inner_text() == f"0 of {most}"
    assert circles(opened) == 0
    before = heat(opened)
    opened.keyboard.press("ArrowRight")
    assert opened.locator("#number").inner_text() == f"1 of {most}"
    assert circles(opened) == 5
    assert heat(opened) != before
    assert "after 1 fixation," in opened.locator("#status").inner_text()
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
    assert opened.locator("#drawing .contour").count() == 0
    opened.locator("#contours").check()
    assert opened.locator("#drawing .contour").count() == 6
    opened.locator("#heat").uncheck()
    assert not opened.locator("#map").is_visible()


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

"""The page of a large picture: complete without a script, and names are never interpreted as markup."""

import base64
import html
import io
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from semfov import InputError, Objects
from semfov.decision import CloseUp, Decision
from semfov.report import page_html
from semfov.report.episode import episode_data
from semfov.report.overview import overview_html
from semfov.report.parts import part_of
from semfov.report.zoom import _MOST_DETECTIONS, zoom_data
from tests.report.pages import Elements, data_of, loads_nothing, names_are_text


def pixels(uri):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))), dtype=float) / 255


def test_the_page_is_text_and_loads_nothing_from_elsewhere(zoom_page, hostile):
    page = zoom_page.read_text(encoding="utf-8")
    elements = names_are_text(page, hostile)
    # Title, heading, two entries of the head, name of the picture, rows of tables, and titles of objects.
    assert elements.texts.count(hostile) >= 7
    assert len(loads_nothing(zoom_page.read_text(encoding="utf-8"))) >= 5
    page = zoom_page.read_text(encoding="utf-8")
    assert page.count("data:image/jpeg;base64,") == 4
    assert data_of(page)["pictures"] == []


def test_each_look_shows_the_pixels_of_its_window(zoom_path, large_picture):
    data = zoom_data(zoom_path, large_picture, name="field")
    assert [look["box"] for look in data["looks"]] == [[0, 0, 400, 300], [0, 0, 200, 200], [200, 100, 400, 300]]
    for look in data["looks"]:
        x1, y1, x2, y2 = look["box"]
        seen = pixels(look["view"])
        # The resolution is that of the detector's input.
        assert seen.shape[1] == round((x2 - x1) * look["magnification"])
        assert seen[..., 0].mean() == pytest.approx((x1 + x2 - 1) / 2 / 399, abs=0.02)
        assert seen[..., 1].mean() == pytest.approx((y1 + y2 - 1) / 2 / 299, abs=0.02)
    assert pixels(data["image"]).shape == (300, 400, 3)


def test_detections_are_in_pixels_of_their_window(zoom_path, large_picture, hostile):
    shifted = zoom_data(zoom_path, large_picture, name="field")["looks"]
    for look, window_look in zip(shifted, zoom_path.window_looks, strict=True):
        x1, y1 = look["box"][:2]
        (seen,) = look["detections"]
        boxes = window_look.detections.boxes[0, 0].tolist()
        assert [n + low for n, low in zip(seen["box"], (x1, y1, x1, y1), strict=True)] == pytest.approx(boxes, abs=0.1)
    # The last detection is of a cat, but the score of the target counts where it is large enough.
    assert [look["detections"][0]["label"] for look in shifted] == [hostile] * 3
    assert [look["detections"][0]["score"] for look in shifted] == pytest.approx([0.5, 0.8, 0.2])
    explored = zoom_data(replace(zoom_path, target=None, decision=None), large_picture, name="field")
    assert explored["looks"][2]["detections"][0]["label"] == "cat"


def test_the_page_of_an_exploration_counts_the_objects_of_each_class(zoom_path, large_picture):
    explored = replace(zoom_path, target=None, decision=None)
    data = zoom_data(explored, large_picture, name="field")
    total = len(explored.objects)
    assert data["decision"].startswith(f"{total} objects found: {explored.words.classes}.")
    nothing = replace(explored, candidates=explored.objects[:0])
    assert zoom_data(nothing, large_picture, name="field")["decision"].startswith("No object found.")


def test_windows_objects_and_looks_are_in_the_page_without_a_script(zoom_page, zoom_path):
    elements = Elements(zoom_page.read_text(encoding="utf-8"))
    assert [each["data-look"] for each in elements.of("window")] == ["1", "2"]
    assert [each.get("data-look") for each in elements.of("object")] == ["1", "2"]
    assert ["confirmed" in each["class"] for each in elements.of("object")] == [True, False]
    looks = elements.of("look")
    assert [each["data-look"] for each in looks] == ["0", "1", "2"]
    assert not [each for each in looks if "hidden" in each]
    told = " ".join(elements.texts)
    for number, value in enumerate(["none: the first look", "0.5", "0.25"], 1):
        assert re.search(rf"Look {number}\b.*?Value when it was chosen {re.escape(value)} ", told, re.S)
    # Boxes of the table are in picture pixels.
    assert "30,24–61,52" in elements.texts
    labels = {attributes.get("aria-label") for tag, attributes in elements.found if tag == "svg"}
    assert "The picture with 2 numbered windows and 2 objects" in labels
    assert "The window of look 2 with 1 detection" in labels


def test_numbers_are_rounded_once(zoom_path, large_picture):
    """As the command rounds them; rows have 0.6346, and 0.635 and 61.5 would become 0.64 and 62."""
    boxes = zoom_path.candidates.boxes + torch.tensor([0.0, 0.0, 0.46, 0.0])
    candidates = replace(zoom_path.candidates, boxes=boxes, scores=torch.tensor([0.63461, 0.4]))
    page = page_html(
        "field", [zoom_data(replace(zoom_path, candidates=candidates, decision=None), large_picture, name="")]
    )
    assert '<td class="number">0.63</td>' in page
    assert '<td class="number">30,24–61,52</td>' in page


@pytest.mark.parametrize("sought", [True, False], ids=["search", "find"])
def test_confirmed_objects_are_told_only_where_something_can_confirm_them(zoom_path, large_picture, sought):
    path = replace(zoom_path, unseen=(0.0, 0.0), **({} if sought else {"decision": None}))
    page = page_html("field", [zoom_data(path, large_picture, name="field")])
    assert ("value of a look is the probability that it finds the target" in page) == sought
    assert ("value of a look is the expected number of new objects" in page) != sought
    assert ("confirmed by the decision or a closer look" in page) == sought
    assert ('<button type="button" class="sort">confirmed</button>' in page) == sought
    ((look, *sure),) = re.findall(r'<tr data-object="1" data-look="(\d)">.*?(?:>(yes|no)</td>.*?)?</tr>', page)
    assert (look, *sure) == ("1", "yes" if sought else "")
    assert ("confirmed ones green" in path._repr_html_()) == sought


def test_a_look_brought_the_objects_whose_box_comes_from_it(zoom_path, large_picture, hostile):
    looks = zoom_data(zoom_path, large_picture, name="field")["looks"]
    assert [look["brought"] for look in looks] == ["", f"1 {hostile}", f"1 {hostile}"]
    assert looks[0]["status"] == "Look 1 of 3, at the whole picture."
    assert looks[1]["status"].startswith("Look 2 of 3 at (100, 100), magnification 0.5. Its value was 0.5.")


def test_a_look_that_brought_nothing_has_no_line_of_what_it_brought(zoom_path, large_picture):
    data = zoom_data(zoom_path, large_picture, name="field")
    names = Elements(page_html("field", [data])).texts
    assert names.count("Best seen in this look") == 2  # of three looks the first brought nothing


def test_the_only_look_is_no_closer_one(zoom_path, large_picture):
    shown = CloseUp(None, 1, None, zoom_path.decision.box, 0.875, 0.9, index=0)
    path = replace(
        zoom_path, looks=zoom_path.looks[:1], closer=(shown,), ending="decision", candidates=zoom_path.candidates[:0]
    )
    (look,) = zoom_data(path, large_picture, name="field")["looks"]
    assert look["status"].startswith("The only look, at the whole picture. It is close enough to tell: ")
    assert "closer look" not in look["status"]
    assert "Close enough to tell" in Elements(page_html("field", [zoom_data(path, large_picture, name="field")])).texts


def test_a_closer_look_tells_what_it_showed(zoom_path, large_picture):
    path = replace(
        zoom_path, closer=(CloseUp(None, 1, None, zoom_path.decision.box, 0.875, 0.9, index=2),), ending="decision"
    )
    data = zoom_data(path, large_picture, name="field")
    assert data["decision"].endswith("0.93. A closer look confirmed the target.")
    assert [look["closer"] is None for look in data["looks"]] == [True, True, False]
    assert "It is a closer look: the target is there with a probability of 0.88." in data["looks"][2]["status"]
    texts = " ".join(Elements(page_html("field", [data])).texts)
    assert texts.count("Closer look probability 0.88 that the target is there") == 1
    last = path.window_looks[2]
    near = [replace(last, window=replace(last.window, fixation=(0, 0, 1.5 + more))) for more in range(4)]
    for looks, told in ((near[:1], "magnifications 0.25, 0.5, 1, 1.5"), (near, "magnifications from 0.25 to 4.5")):
        closer = tuple(replace(path.looks[2], shown=look) for look in looks)
        assert replace(path, looks=(*path.looks[:2], *closer)).words.sensor.endswith(told)


def test_long_lists_are_cut_and_say_so(zoom_path, large_picture, monkeypatch):
    monkeypatch.setattr("semfov.report.episode._DRAWN", drawn := _MOST_DETECTIONS + 5)
    many = drawn + 7
    scores = torch.linspace(0.9, 0.3, many)
    place = torch.tensor([[10.0, 10, 20, 20]]).expand(many, 4)
    objects = Objects(place, scores, torch.full((many,), 2), torch.zeros(many).long())
    first = zoom_path.window_looks[0]
    seen = replace(
        first.detections,
        boxes=place[None],
        scores=first.detections.scores.expand(1, many, -1),
        mask=torch.ones(1, many, dtype=torch.bool),
        confidence=first.detections.confidence.expand(1, many),
    )
    looks = (replace(zoom_path.looks[0], detections=seen), *zoom_path.looks[1:])
    data = zoom_data(replace(zoom_path, candidates=objects, decision=None, looks=looks), large_picture, name="crowd")
    page = page_html("crowd", [data])
    assert "<p>7 less confident objects are left out.</p>" in page
    assert f"<p>{many - _MOST_DETECTIONS} less confident detections are left out.</p>" in page
    assert page.count("<tr data-object=") == drawn
    one = replace(zoom_path, decision=None, candidates=objects[torch.arange(drawn + 1)])
    page = page_html("crowd", [zoom_data(one, large_picture, name="crowd")])
    assert "<p>1 less confident object is left out.</p>" in page


@pytest.mark.parametrize(
    ("decision", "ending", "told"),
    [
        (
            Decision("found", 0.93),
            "decision",
            "“cat” found, probability that the picture holds it: 0.93. The probability is high",
        ),
        (Decision("absent", 0.1), "decision", "“cat” probably absent, .* holds it: 0.10. No remaining look is worth"),
        (Decision("undecided", 0.6), "passes", "^No “cat” clearly seen: undecided, .* 0.60. All 3 passes were used.$"),
        (Decision("undecided", 0.6), "decision", "0.60. No remaining look is worth a pass, but .* to call it absent.$"),
        (Decision("undecided", 0.2), "windows", "0.20. No window is left that can show more.$"),
        (Decision("undecided", 0.6), None, "0.60.$"),
        (Decision("found", 0.7), "detection", "“cat” found, best score: 0.70. A detection shows the target.$"),
        (None, "passes", "^No cat found. All 3 passes were used.$"),
        (None, "min_gain", "^No cat found. No remaining look is expected to show enough new objects.$"),
        (None, None, "^No cat found.$"),
    ],
)
def test_the_head_tells_the_outcome_and_its_reason(zoom_path, large_picture, decision, ending, told):
    nothing = zoom_path.candidates.above(1)
    learned = decision is not None and ending != "detection"
    path = replace(
        zoom_path,
        target=1,
        decision=decision,
        candidates=nothing,
        ending=ending,
        unseen=(0.0, 0.0) if learned else None,
    )
    data = zoom_data(path, large_picture, name="field.png")
    assert re.search(told, data["decision"])
    page = page_html("t", [data])
    assert page.index(data["decision"]) < page.index("<main>")
    texts = Elements(page).texts
    assert {"field.png", "400 × 300 px", "windows of 100 × 100 px at magnifications 0.25, 0.5, 1"} <= set(texts)
    assert "3" in texts
    assert "No objects were found." in texts


def test_an_undecided_search_has_the_best_place_of_the_record_on_its_page(zoom_path, large_picture):
    path = replace(zoom_path, decision=Decision("undecided", 0.6), ending="passes")
    place = path.words.best_place
    assert place
    data = zoom_data(path, large_picture, name="field.png")
    assert f" {place.capitalize()}." in data["decision"]
    assert data["best"] == path.best_place[0].tolist()
    page = page_html("t", [data])
    assert len(Elements(page).of("best")) == 1
    nothing = page_html("t", [data | {"objects": [], "count": 0, "looks": data["looks"][:1]}])
    entries = [re.findall(r'<i class="of-(\w+)">', text) for text in (page, nothing)]
    assert "No objects were found. The best place, not sure enough, is dashed." in nothing
    assert ["The keys ← and → step through the looks." in text for text in (page, nothing)] == [True, False]
    assert entries == [["best", "windows", "now"], ["best"]]
    (dashed,) = re.findall(r"<rect [^>]*stroke-dasharray[^>]*><title>([^<]*)</title>", path._repr_html_())
    assert dashed == f"best place {path.best_place[1]:.2f}"
    assert data["objects"] == []
    assert "dash" not in zoom_path._repr_html_()
    assert not Elements(page_html("t", [zoom_data(zoom_path, large_picture, name="field.png")])).of("best")


def test_small_and_large_pictures_share_a_page(zoom_path, large_picture, scanpath, image):
    small = episode_data(scanpath, image, [image * 0.5] * 3, name="small.jpg")
    large = zoom_data(zoom_path, large_picture, name="large.jpg")
    for episodes in ([small, large], [large, small]):
        page = page_html("both", episodes)
        elements = Elements(page)
        data = data_of(page)
        assert [each["name"] for each in data["episodes"]] == [each["name"] for each in episodes]
        assert data["pictures"] == [small["image"], small["fixations"][0]["view"]]
        assert len(elements.of("large")) == 1
        (views,) = [attributes for _, attributes in elements.found if attributes.get("id") == "episode-views"]
        assert "hidden" not in views
        # The head shows the first; the entries that it does not have are hidden, as that of an unknown detector.
        hidden = [tag for tag, attributes in elements.found if tag == "div" and "hidden" in attributes]
        assert len(hidden) == (2 if episodes[0] is small else 0)
        # Without JavaScript, a large picture that is not the first has a head of its own.
        assert ("noscript><dl" in page) == (episodes[0] is small)


def test_a_wrong_picture_or_a_path_without_looks_is_refused(zoom_path, large_picture):
    with pytest.raises(InputError, match="picture: expected the picture of the record, 400 × 300 px"):
        zoom_data(zoom_path, large_picture[:, :200], name="other")
    with pytest.raises(InputError, match="at least one look"):
        zoom_data(replace(zoom_path, looks=()), large_picture, name="other")


def test_an_object_that_no_look_of_the_record_shows_is_cut_out_of_the_picture(zoom_path, large_picture):
    """In a frame of a stream it may be tracked from looks that are no longer counted."""
    data = zoom_data(zoom_path, large_picture, name="field")
    data["objects"][0]["look"] = 0
    rows = part_of(data, 3).objects_html().split("<tr ")[1:]
    assert 'href="#large-3-picture"' in rows[0]
    assert re.search(r'href="#large-3-look-\d-view"', rows[1])


def test_a_page_of_several_pictures_begins_with_an_overview_those_with_a_find_first(
    zoom_path, scanpath, large_picture, image, hostile
):
    """Each row has a small picture, what came of it, and a link to its part; a page of one has none."""
    nothing = zoom_path.candidates.above(1)
    outcomes = [("absent", 0.1), ("undecided", 0.6), ("found", 0.9)]
    records = [
        replace(zoom_path, decision=Decision(outcome, chance), candidates=nothing) for outcome, chance in outcomes
    ]
    explored = replace(zoom_path, target=None, decision=None)
    data = [zoom_data(record, large_picture, name=f"{hostile}{order}") for order, record in enumerate(records)]
    data.append(episode_data(scanpath, image, [image] * 3, name="fovea"))
    data.append(zoom_data(explored, large_picture, name="explored"))
    data.append(zoom_data(replace(explored, candidates=nothing), large_picture, name="nothing"))
    page = page_html("all", data)
    names_are_text(page, hostile)
    elements = Elements(page)
    links = [attributes["href"] for tag, attributes in elements.found if tag == "a"]
    assert links == ["#large-2", "#objects-3", "#large-4", "#large-1", "#large-0", "#large-5"]
    ids = {attributes.get("id") for _, attributes in elements.found}
    assert {link[1:] for link in links} <= ids
    assert "Found in 3 of 6 pictures, 1 undecided" in elements.texts
    assert page.index("Found in 3 of 6") < page.index('id="viewer"')
    overview = page[page.index('id="overview"') : page.index("</section>")]
    assert overview.count('<svg class="small"') == len(data)
    assert [each["summary"] in html.unescape(overview) for each in data] == [True] * len(data)
    sizes = {pixels(uri).shape for uri in re.findall(r'<image href="([^"]+)"', overview)}
    assert sizes == {(120, 160, 3), (60, 80, 3)}  # that of the fovea was smaller
    assert 'id="overview"' not in page_html("one", data[:1])
    assert 'id="overview"' not in page_html("study", data, sections="<section><h2>Curves</h2></section>")


def test_a_picture_that_was_not_kept_has_a_row_without_it(scanpath):
    data = episode_data(scanpath, None, None, name="fovea")
    overview = overview_html([data, data], ["objects-0", "objects-1"])
    assert "<svg" not in overview
    assert overview.count("<tr ") == 2

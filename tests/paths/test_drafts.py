"""Two drafts beside each other: what moves between them, their figure and their page."""

import pytest
import torch

from semfov.gaze.saliency import FixationDensity
from semfov.paths import GazePrediction
from semfov.paths.drafts import Drafts
from semfov.report.drafts import drafts_section
from semfov.viz.drafts import plot_difference
from tests.refusals import refused
from tests.small import slopes

pytestmark = pytest.mark.usefixtures("few_viewers")

LEFT, RIGHT = (0, 0, 52, 78), (52, 0, 104, 78)


def draft(name, right, size=(104, 78), cells=(39, 52), photograph=None):
    """A prediction with a share of the fixations in the right half."""
    torch.manual_seed(0)
    model = FixationDensity({"backbone8": 3}).eval().requires_grad_(False)
    log = torch.full((1, *cells), (1 - right) / (cells[0] * cells[1] / 2)).log()
    log[..., cells[1] // 2 :] += torch.tensor(right / (1 - right)).log()
    terms = {"map": log, "centre bias": torch.zeros(1, *cells)}
    if photograph is None:
        photograph = slopes(*size)
    return GazePrediction(model, terms, size, photograph, name)


@pytest.fixture
def drafts():
    return Drafts(draft("a/before.png", 0.4), draft("b/after.png", 0.75))


def test_what_moves_is_half_of_the_absolute_difference(drafts):
    difference = drafts.second.cells - drafts.first.cells
    torch.testing.assert_close(drafts.difference, difference)
    assert drafts.moved == pytest.approx(float(difference.abs().sum()) / 2, abs=1e-6)
    assert drafts.moved == pytest.approx(0.35, abs=1e-5)
    assert Drafts(drafts.first, drafts.first).moved == 0


def test_shares_of_areas_are_those_of_each_draft(drafts):
    shares = drafts.shares({"left": LEFT, "right": RIGHT})["right"]
    assert shares.first == drafts.first.share({"right": RIGHT})["right"] == pytest.approx(0.4, abs=0.01)
    assert shares.difference == pytest.approx(0.35, abs=0.01)
    words = drafts.describe({"right": RIGHT})
    assert words == (
        "before.png and after.png: 35 % of the fixations are elsewhere in the second\n"
        f"  right: {100 * shares.first:.0f} % and {100 * shares.second:.0f} % of all fixations\n"
        "  Areas are at the same place in both drafts. What moves needs boxes for before.png and for after.png."
    )
    assert drafts.describe().count("\n") == 0


def test_an_area_that_moves_has_its_box_in_each_draft(drafts):
    moved = drafts.shares({"before.png": {"button": LEFT}, "after.png": {"button": RIGHT}})["button"]
    assert moved.first == drafts.first.share({"button": LEFT})["button"]
    assert moved.second == drafts.second.share({"button": RIGHT})["button"]
    moving = {"before.png": {"button": LEFT}, "after.png": {"button": RIGHT}}
    assert "same place" not in drafts.describe(moving) + drafts_section(drafts, moving)
    assert "same place" in drafts_section(drafts, {"button": LEFT})
    larger = Drafts(drafts.first, draft("b/after.png", 0.5, size=(208, 156)))
    assert "same place" not in larger.describe({"button": LEFT})
    twins = Drafts(draft("a/x.png", 0.4), draft("b/x.png", 0.5))
    assert [*twins.shares({"a/x.png": {"button": LEFT}, "b/x.png": {"button": RIGHT}})] == ["button"]
    other = {"before.png": {"button": LEFT}, "after.png": {"logo": RIGHT}}
    refused("areas: expected the same areas in both drafts: button", drafts.shares, other)
    refused("areas: expected boxes for after.png", drafts.shares, {"before.png": {"button": LEFT}})


def test_boxes_are_taken_by_the_names_by_which_drafts_are_told_apart():
    """Pictures without a file have the same name, so theirs are counted."""
    drafts = Drafts(draft(None, 0.4), draft(None, 0.75))
    areas = {drafts.names[0]: {"button": LEFT}, drafts.names[1]: {"button": RIGHT}}
    moved = drafts.shares(areas)["button"]
    assert moved.first == drafts.first.share({"button": LEFT})["button"]
    assert moved.second == drafts.second.share({"button": RIGHT})["button"]
    alike = drafts.shares({drafts.first.name: {"button": LEFT}})["button"]
    assert alike.first == moved.first
    refused(r"expected boxes for .*\(second\)", drafts.shares, {drafts.names[0]: {"button": LEFT}})


def test_drafts_of_one_name_are_told_apart_by_their_folders():
    assert Drafts(draft("a/x.png", 0.4), draft("b/x.png", 0.5)).names == ("a/x.png", "b/x.png")
    assert Drafts(draft("a/x.png", 0.4), draft("b/y.png", 0.5)).names == ("x.png", "y.png")
    for source, name in (("a/x.png", "x.png"), (None, draft(None, 0.4).name)):
        assert Drafts(draft(source, 0.4), draft(source, 0.5)).names == (f"{name} (first)", f"{name} (second)")


def test_drafts_of_other_proportions_have_shares_alone(drafts):
    tall = Drafts(drafts.first, draft("tall.png", 0.5, size=(104, 104), cells=(52, 52)))
    assert tall.difference is tall.moved is None
    assert "proportions differ" in tall.describe()
    assert len(tall.plot().axes) == 2
    assert "The two drafts" in drafts_section(tall)
    refused("two pictures of the same proportions", plot_difference, tall)


def test_the_figure_and_the_page_have_both_maps_and_what_differs(tmp_path):
    drafts = Drafts(draft("before.png", 0.4), draft("before.png", 0.75))
    areas = {f"before.png ({number})": {"<right>": RIGHT} for number in ("first", "second")}
    figure = drafts.plot(areas=areas)
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[:2] == ["before.png (first)", "before.png (second)"]
    assert titles[2].startswith("35 % of the fixations move")
    texts = [[text.get_text() for text in axes.texts] for axes in figure.axes[:2]]
    assert [each[0].rpartition(" %")[0].rpartition(" ")[2] for each in texts] == ["40", "75"]
    path = drafts.report(tmp_path / "drafts.html", title="Two posters", areas=areas)
    page = path.read_text(encoding="utf-8")
    assert "<h1>Two posters</h1>" in page
    assert "35 % of the fixations move between the drafts" in page
    difference = 100 * drafts.shares({"right": RIGHT})["right"].difference
    assert f'<th scope="row">&lt;right&gt;</th><td>40 %</td><td>75 %</td><td>+{difference:.1f}</td>' in page
    fewer = drafts_section(Drafts(drafts.second, drafts.first), {"right": RIGHT})
    assert f"<td>75 %</td><td>40 %</td><td>\N{MINUS SIGN}{difference:.1f}</td>" in fewer
    assert page.count("<figure>") == 3
    refused("html", drafts.report, tmp_path / "drafts.pdf")


def test_what_one_draft_alone_has_is_half_transparent_in_the_difference():
    """A white picture that turns black is grey, also where the drafts have other sizes."""
    white, black = torch.full((3, 78, 104), 255).byte(), torch.zeros(3, 156, 208).byte()
    drafts = Drafts(draft("a.png", 0.4, photograph=white), draft("b.png", 0.75, size=(208, 156), photograph=black))
    ground, _ = plot_difference(drafts).axes[0].images
    assert ground.get_array().shape == (156, 208, 3)
    assert (ground.get_array().min(), ground.get_array().max()) == pytest.approx((0.5, 0.5), abs=1e-3)


def test_drafts_are_predictions():
    refused(r"^first: expected a prediction, agent\.gaze\(picture\), got a str", Drafts, "a.jpg", "b.jpg")
    refused("^second: ", Drafts, draft("a.png", 0.4), None)

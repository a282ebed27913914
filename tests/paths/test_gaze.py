"""The record of where people look: density, terms, places and drawn scanpaths."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn import functional as F

from semfov import ActivePerception, Eye, Foveation, InputError, foveate
from semfov.agents.picture import OpenedPicture
from semfov.data.examples import example_scene
from semfov.data.fixations import Fixations, read_osie, read_table, write_osie, write_table
from semfov.gaze.saliency import FixationDensity, PictureLikeness
from semfov.gaze.saliency.likeness import pooled
from semfov.metrics.scanpath import auc, correlation, nss
from semfov.paths import GazePrediction
from semfov.sensor import LogPolar
from tests import small
from tests.refusals import refused
from tests.small import Shown, rand


def bump(x, y, rows=39, columns=52, width=2.0):
    across, down = torch.arange(columns) - x, torch.arange(rows)[:, None] - y
    return torch.exp(-(across**2 + down**2) / (2 * width**2))


@pytest.fixture
def gaze():
    torch.manual_seed(0)
    model = FixationDensity({"backbone8": 3}).eval().requires_grad_(False)
    model.oculomotor.saccade.normal_(0, 0.5)
    model.pause.fill_(50.0)
    log = (0.02 + 3 * bump(10, 8) + bump(40, 30)).log()
    terms = {"map": log[None], "centre bias": -rand(1, 39, 52)}
    return GazePrediction(model, terms, (104, 78), (rand(3, 78, 104) * 255).byte(), "folder/poster.png")


def test_the_density_sums_to_one_and_has_its_terms_as_parts(gaze):
    assert gaze.density.shape == (78, 104)
    assert float(gaze.density.sum()) == pytest.approx(1, abs=1e-5)
    assert float(gaze.cells.sum()) == pytest.approx(1, abs=1e-5)
    total = gaze.terms["map"][0] + gaze.terms["centre bias"][0]
    torch.testing.assert_close(gaze.cells, total.flatten().softmax(0).view(39, 52))
    p = gaze.cells.double()
    assert gaze.entropy == pytest.approx(float(-(p * p.log2()).sum()), abs=1e-4)
    p = gaze.cells.double()
    for name, rest in (("map", "centre bias"), ("centre bias", "map")):
        q = gaze.terms[rest][0].double().flatten().softmax(0).view(39, 52)
        assert gaze.parts[name] == pytest.approx(float((p * (p / q).log2()).sum()), abs=1e-4)


def test_places_are_the_peaks_in_order(gaze):
    first, second, *others = gaze.peaks(6)
    assert (first["x"], first["y"]) == pytest.approx((20.5, 16.5), abs=2)
    assert (second["x"], second["y"]) == pytest.approx((80.5, 60.5), abs=2)
    shares = [each["share"] for each in (first, second, *others)]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) < 1
    near = (torch.arange(104) - first["x"]) ** 2 + (torch.arange(78)[:, None] - first["y"]) ** 2 <= 5.2**2
    assert first["share"] == pytest.approx(float(gaze.density[near].sum()), rel=0.1)
    assert gaze.peaks(100)[:6] == gaze.peaks(6)
    gaze.peaks(1)[0].clear()  # a caller's own
    assert gaze.peaks(1) == [first]
    refused("count", gaze.peaks, 0)
    # A place is on what is looked at, where a disc of equal weight may hold it anywhere.
    log = (0.001 * rand(39, 52) + bump(30, 20, width=0.4)).log()
    (sharp,) = GazePrediction(gaze.model, {"map": log[None]}, gaze.size, gaze.photograph, gaze.source).peaks(1)
    assert (sharp["x"], sharp["y"]) == (60.5, 40.5)
    # More fixations are around a broad peak than around a high one.
    log = (0.001 + 6 * bump(10, 8, width=0.3) + 0.5 * bump(40, 30, width=4.0)).log()
    broad = replace(gaze, terms={"map": log[None]})
    assert [round(each["x"]) for each in broad.peaks(2)] == [80, 20]
    assert broad.peaks(1) == broad.peaks(2)[:1]


def test_first_fixations_are_where_most_viewers_look_in_turn(gaze):
    """Each is the best place of that fixation's density that no earlier one has taken."""
    first = gaze.first_fixations(4)
    assert gaze.first_fixations(2) == first[:2]
    x, y = torch.arange(52) * 2 + 0.5, torch.arange(39)[:, None] * 2 + 0.5
    for number, place in enumerate(first, 1):
        cells = gaze.given(gaze._viewers(4), number)
        around = ((x - place["x"]) ** 2 + (y - place["y"]) ** 2) <= 5.2**2
        assert place["share"] == pytest.approx(float(cells[around].sum()), rel=1e-3)
    cells = gaze.given(gaze._viewers(1), 1)
    taken = ((x - first[0]["x"]) ** 2 + (y - first[0]["y"]) ** 2) <= (2 * 5.2) ** 2
    assert float(cells[taken].max()) == float(cells.max())  # the most likely cell is at the first place
    for one, other in combinations(first, 2):
        assert math.dist((one["x"], one["y"]), (other["x"], other["y"])) > 2 * 0.05 * 104
    gaze.first_fixations(1)[0].clear()  # a caller's own
    assert gaze.first_fixations(1) == first[:1]
    assert replace(gaze).first_fixations(4) == first
    assert gaze.describe().startswith(f"people look first at ({first[0]['x']:.0f}, {first[0]['y']:.0f}), then (")
    for wrong in (0, 11):
        refused("count", gaze.first_fixations, wrong)


def test_shares_of_areas_are_sums_of_the_density(gaze):
    shares = gaze.share("left:0,0,52,78 right:52,0,104,78 corner:3,4,9,11")
    assert shares["left"] + shares["right"] == pytest.approx(1, abs=1e-5)
    assert shares["corner"] == pytest.approx(float(gaze.density[4:11, 3:9].sum()), abs=1e-6)
    refused(r"areas\['logo'\]", gaze.share, {"logo": (0, 0, 105, 10)})


def test_visits_of_areas_are_those_of_drawn_viewers(gaze):
    """Counted one viewer and one fixation after another, with the pause of 50 ms of this model."""
    areas = {"left": (0, 0, 52, 78), "corner": (3, 4, 40, 39), "sliver": (103, 77, 104, 78)}
    visits = gaze.visits(areas, seconds=2.0)
    viewers = gaze.scanpaths(100, seconds=2.0)
    for name, (left, top, right, bottom) in areas.items():
        times = []
        for viewer in viewers:
            now = 0.0
            for (x, y), duration in zip(viewer.points, viewer.durations, strict=True):
                if left <= x + 0.5 < right and top <= y + 0.5 < bottom:
                    times.append(now / 1000)
                    break
                now += duration + 50
        assert visits[name].viewers == len(times) / 100
        if times:
            assert visits[name].seconds == pytest.approx(np.median(times), rel=1e-3)
    assert visits["left"].viewers > visits["corner"].viewers > 0
    assert visits["sliver"] == (0, None)
    assert str(visits["sliver"]) == "seen by no viewer"
    refused(r"gaze\.share\(areas\) and gaze\.visits\(areas\)", gaze.describe, areas)
    refused(r"gaze\.share\(areas\) and gaze\.visits\(areas\)", gaze.describe, areas=areas)
    with pytest.raises(AttributeError, match=r"use gaze\.visits\(areas\)"):
        _ = gaze.ttff
    for seconds in (0, [3], True):
        refused("seconds", gaze.visits, areas, seconds=seconds)


def test_a_page_has_the_heading_that_it_is_given(gaze, tmp_path):
    path = gaze.report(tmp_path / "page.html", title="Draft < 2", people=2)
    assert "<h1>Draft &lt; 2</h1>" in path.read_text(encoding="utf-8")
    refused("titel", gaze.report, path, titel="Draft 2")


def test_a_page_counts_viewers_in_the_time_that_is_asked_for(gaze, tmp_path):
    areas = {"left": (0, 0, 52, 78)}
    for seconds in (0.2, 2.0):
        page = gaze.report(tmp_path / "page.html", people=2, seconds=seconds, areas=areas).read_text(encoding="utf-8")
        assert "<h1>semfov: where people look in " in page
        assert f">{100 * gaze.visits(areas, seconds=seconds)['left'].viewers:.0f} %<" in page


def test_a_picture_unlike_those_of_the_fit_has_a_caution():
    torch.manual_seed(0)
    detector = Shown("colours", ("none",), (80, 60), stride=4).eval()
    model = FixationDensity({"backbone8": 3}).eval()
    photographs = [rand(3, 60, 80).float() * (0.5 + 0.5 * rand(1)) for _ in range(60)]
    assert GazePrediction.of(detector, photographs[0], model=model).unlikeness is None
    values = [pooled(detector.features(each[None], ["backbone8"]), ["backbone8"]) for each in photographs]
    model.likeness = PictureLikeness.fitted(torch.cat(values))
    alike = GazePrediction.of(detector, photographs[0], model=model)
    assert (alike.unlike, alike.caution) == (False, None)
    assert alike.unlikeness == pytest.approx(float(model.likeness(values[0])), rel=1e-3)
    flat = GazePrediction.of(detector, torch.tensor([0.2, 0.8]).repeat(3, 60, 40), model=model)
    assert flat.unlike
    assert "unlike the photographs" in flat.caution
    assert flat.caution in repr(flat)
    assert "Caution: this picture is unlike" in flat.plot().axes[0].get_title()
    # What a fovea has shown is not compared with sharp pictures.
    eye = Eye(Foveation(8.0, growth=1.0), detector, reference=80.0)
    assert GazePrediction.of(eye, photographs[0], model=model, seen=[[40.0, 30.0]]).unlikeness is None


def test_proportions_unlike_those_of_the_shipped_fit_have_a_caution(gaze):
    said_of = {
        (104, 78): None,
        (78, 104): "wider than high",
        (300, 100): "this one is 3.0 : 1",
        (200, 100): "--panorama",
        (24, 18): "24 × 18 px show little",
    }
    for size, said in said_of.items():
        caution = replace(gaze, size=size, is_shipped=True).caution
        assert (caution is None) == (said is None)
        assert said is None or said in caution
        assert replace(gaze, size=size).caution is None
    assert replace(gaze, size=(200, 100), is_shipped=True, panorama=True).caution is None
    card = replace(gaze, photograph=torch.full((3, 78, 104), 99, dtype=torch.uint8))
    assert card.caution.endswith("that people look at the middle")
    assert replace(card, panorama=True).caution.endswith("how high people look")


@pytest.mark.parametrize("size", [(60, 80), (18, 24), (10, 400), (100, 50)])
@pytest.mark.parametrize("quality", ["quick", "best"])
def test_a_picture_of_one_colour_has_the_centre_bias_alone(size, quality):
    """The padding of the canvas is not in the map."""
    torch.manual_seed(0)
    detector = Shown("colours", ("none",), (80, 60), stride=4).eval()
    model = FixationDensity({"backbone8": 3}, centre=-rand(39, 52).float()).eval()
    card = GazePrediction.of(detector, torch.full((3, *size), 0.5), model=model, quality=quality)
    bias = model.centre_bias(size).flatten().softmax(0).view_as(card.cells)
    torch.testing.assert_close(card.cells, bias)
    assert "one colour" in card.caution
    assert card.density.isfinite().all()


def test_the_edges_of_a_panorama_meet():
    """A quarter turn moves everything by a quarter, over the seam, too."""
    torch.manual_seed(0)
    detector = Shown("colours", ("none",), (80, 60), stride=4).eval()
    model = FixationDensity({"backbone8": 3}, centre=-rand(39, 52).float()).eval().requires_grad_(False)
    picture = 0.2 * rand(3, 104, 208).float()
    picture[:, 40:64, :8] += 0.7
    picture[:, 40:64, -8:] += 0.7
    for quality in ("quick", "best"):
        before = GazePrediction.of(detector, picture, model=model, quality=quality, panorama=True)
        turned = GazePrediction.of(detector, picture.roll(52, -1), model=model, quality=quality, panorama=True)
        torch.testing.assert_close(turned.density, before.density.roll(52, -1))
    centre = model.centre_bias((104, 208)).exp().mean(1).log()
    torch.testing.assert_close(before.terms["centre bias"][0], centre[:, None].expand(26, 52))
    # Between the first and the last column is no larger step than between any others.
    steps = (before.density.roll(1, -1) - before.density).abs().amax(0)
    assert float(steps[0]) <= float(steps[1:].max())
    seen = {"seen": [[3.0, 4.0]], "model": model}
    eye = Eye(Foveation(8.0, growth=1.0), detector, reference=80.0)
    refused("seen: expected None for a panorama, which", GazePrediction.of, eye, picture, **seen, panorama=True)
    refused("seen: expected None for quality='best', which", GazePrediction.of, eye, picture, **seen, quality="best")
    refused("panorama: expected", GazePrediction.of, detector, picture[..., :104], model=model, panorama=True)
    refused("quality", GazePrediction.of, detector, picture, model=model, quality="better")


@pytest.mark.parametrize("height", [277, 104, 80, 77, 52, 35, 4])
def test_a_panorama_of_any_proportions_has_a_density_that_turns_with_it(height):
    torch.manual_seed(0)
    detector = Shown("colours", ("none",), (80, 60), stride=4).eval()
    model = FixationDensity({"backbone8": 3}).eval().requires_grad_(False)
    picture = rand(3, height, 416).float()
    before = GazePrediction.of(detector, picture, model=model, panorama=True)
    turned = GazePrediction.of(detector, picture.roll(104, -1), model=model, panorama=True)
    assert before.density.isfinite().all()
    assert float(before.density.sum()) == pytest.approx(1, abs=1e-5)
    assert before.terms["map"].std() > 0
    torch.testing.assert_close(turned.density, before.density.roll(104, -1))


def test_a_place_at_the_seam_of_a_panorama_is_one_place(gaze):
    log = (0.02 + 3 * bump(0, 8) + 3 * bump(52, 8) + bump(26, 30)).log()
    around = replace(gaze, terms={"map": log[None]}, panorama=True)
    (first, second) = around.peaks(2)
    assert min(first["x"], 104 - first["x"]) < 3
    assert second["x"] == pytest.approx(52.5, abs=2)
    assert first["share"] > 1.2 * replace(around, panorama=False).peaks(1)[0]["share"]


def test_scanpaths_last_as_long_as_people_view(gaze):
    paths = gaze.scanpaths(200, seconds=3.0, seed=4)
    assert len(paths) == 200
    for each in paths:
        assert each.size == (104, 78)
        assert each.picture == "poster.png"
        assert each.inside.all()
        assert (each.durations[:-1] + 50).sum() < 3000.5 + len(each)
    # Durations are log-normal: their mean is exp(µ + σ²/2), here 233 ms.
    mean = math.exp(5.3 + 0.55**2 / 2)
    durations = np.concatenate([each.durations[:3] for each in paths if len(each) >= 3])
    assert durations.mean() == pytest.approx(mean, rel=0.12)
    assert np.mean([len(each) for each in paths]) == pytest.approx(3000 / (mean + 50), rel=0.2)
    assert len(gaze.scanpaths(3, seconds=0.1)) == 3


def test_the_seed_repeats_scanpaths_whose_next_fixation_has_the_mean_of_the_densities(gaze):
    paths = gaze.scanpaths(5, seed=3)
    mean = gaze.given(paths, 2)
    each = torch.stack([gaze.given([path], 2) for path in paths if len(path) >= 2])
    torch.testing.assert_close(mean, each.mean(0))
    assert float(mean.sum()) == pytest.approx(1, abs=1e-5)
    torch.testing.assert_close(gaze.given(paths, 90), gaze.cells)
    refused("n: expected an option of scanpaths, .* did you mean people=", gaze.scanpaths, n=4)
    again = gaze.scanpaths(4, seed=1), gaze.scanpaths(4, seed=1)
    assert all(np.array_equal(a.points, b.points) for a, b in zip(*again, strict=True))
    other = gaze.scanpaths(4, seed=2)
    assert not all(np.array_equal(a.points, b.points) for a, b in zip(again[0], other, strict=True))


def test_points_of_viewers_have_two_digits_and_stay_in_the_picture(gaze, tmp_path):
    """Also at the far edges, where the nearest hundredth lies outside."""
    paths = gaze.scanpaths(100, seed=7)
    gaze.to_csv(tmp_path / "viewers.csv", people=100, seed=7)
    lines = (tmp_path / "viewers.csv").read_text().splitlines()[1:]
    fields = [line.split(",") for line in lines]
    assert len(lines) == sum(map(len, paths)) > 300
    assert max(len(number.partition(".")[2]) for row in fields for number in (row[2], row[3])) == 2
    assert all(path.inside.all() for path in paths)


def test_the_next_density_is_over_the_pixels(gaze):
    path = gaze.scanpaths(1, seed=3)[0]
    density = gaze.next_density(path)
    assert float(density.sum()) == pytest.approx(1, abs=1e-5)
    log = gaze.given([path], len(path)).log()
    over = F.interpolate(log[None, None], (78, 104), mode="bilinear")[0, 0].flatten().softmax(0)
    torch.testing.assert_close(density.flatten(), over)
    torch.testing.assert_close(gaze.next_density(path.resized((208, 156))), density)
    refused(r"scanpath: .* proportions", gaze.next_density, Fixations("a.png", "1", np.array([[5.0, 5.0]]), (100, 100)))


def test_the_fixations_of_one_viewer_are_taken_in_any_form(gaze):
    path = gaze.scanpaths(1, seed=3)[0]
    density = gaze.next_density(path)
    for given in (path.points, torch.from_numpy(path.points), path.points.tolist()):
        torch.testing.assert_close(gaze.next_density(given), density)
    agent = small.agent(small.Fixed(("cup", "bowl")), grid=(4, 3), sigma=10.0, reference=64.0)
    record = agent.explore(np.zeros((78, 104, 3), np.uint8), how="fovea", shifts=2)
    torch.testing.assert_close(gaze.next_density(record), gaze.next_density(record.as_fixations("poster.png")))
    with pytest.warns(UserWarning, match=r"scanpath: 1 of 1 fixations .* far outside"):
        gaze.next_density([[9000.0, 5.0]])


@pytest.mark.parametrize(
    ("given", "got"),
    [
        (
            [Fixations("poster.png", "1", [[5.0, 5.0]], (104, 78))] * 3,
            r"a list of 3; take one: scanpath=scanpaths\[0\]",
        ),
        ([5.0, 5.0], r"a list \(points: expected \(n, 2\)"),
        (np.array(["a", "b"]), r"a ndarray \(points: expected real numbers"),
        (None, "NoneType"),
        ("paths.csv", "str"),
        (Fixations("other.png", "1", [[5.0, 5.0]], (104, 78)), "in 'other.png'"),
    ],
)
def test_what_is_not_one_viewers_fixations_of_the_picture_is_refused(gaze, given, got):
    refused(rf"^scanpath: expected (Fixations|fixations) .*, got {got}", gaze.next_density, given)


def test_what_a_fovea_has_seen_is_known_alone():
    """After one look, the picture is what the fovea has shown; between two, each half is that of its own look."""
    torch.manual_seed(0)
    detector = Shown("colours", ("none",), (80, 60), stride=4).eval()
    model, image = FixationDensity({"backbone8": 3}).eval(), rand(3, 60, 80).float()
    eye = Eye(Foveation(8.0, growth=1.0), detector, reference=80.0)
    points = np.array([[12.0, 30.0], [68.0, 30.0]])

    def predicted(points):
        gaze = GazePrediction.of(eye, image, model=model, seen=points)
        assert f", after {len(points)} fixation" in gaze.describe()
        return gaze.terms["map"][0]

    views = [foveate(image[None], torch.from_numpy(each).float(), sigma=8.0, growth=1.0)[0] for each in points]
    for each, view in zip(points, views, strict=True):
        torch.testing.assert_close(predicted(each[None]), GazePrediction.of(eye, view, model=model).terms["map"][0])
    halves = torch.cat([views[0][..., :40], views[1][..., 40:]], -1)
    torch.testing.assert_close(predicted(points), GazePrediction.of(eye, halves, model=model).terms["map"][0])
    double = GazePrediction.of(eye, image.double(), model=model)
    assert double.model.read.dtype == model.read.dtype == torch.float32
    torch.testing.assert_close(double.terms["map"].float(), GazePrediction.of(eye, image, model=model).terms["map"])
    seen = Fixations("a", "1", points, (80, 60))
    refused("looking: expected an eye", GazePrediction.of, detector, image, model=model, seen=seen)
    with pytest.raises(InputError, match="sensor: expected a Foveation"):
        GazePrediction.of(Eye(LogPolar(8.0), detector), image, model=model, seen=seen)


def test_files_hold_what_was_predicted(gaze, tmp_path):
    gaze.to_csv(tmp_path / "paths.csv", people=3, seed=5)
    for stored, drawn in zip(read_table(tmp_path / "paths.csv"), gaze.scanpaths(3, seed=5), strict=True):
        np.testing.assert_allclose(stored.points, drawn.points)
        np.testing.assert_allclose(stored.durations, drawn.durations)
    np.testing.assert_array_equal(np.load(gaze.save_density(tmp_path / "density.npy")), gaze.density.numpy())
    with Image.open(gaze.save_density(tmp_path / "density.tif")) as image:
        np.testing.assert_array_equal(np.array(image), gaze.density.numpy())
    with Image.open(gaze.save_density(tmp_path / "map.png")) as image:
        assert image.size[0] > 300
    refused(r"\.npy, \.tif or \.png", gaze.save_density, tmp_path / "density.pdf")


def test_comparison_equals_the_measures(gaze):
    points = [np.array([[50.0, 40.0], [20.0, 17.0], [81.0, 60.0]]), np.array([[5.0, 5.0], [22.0, 15.0]])]
    people = [Fixations("poster.png", str(n), each, (104, 78)) for n, each in enumerate(points)]
    scores = gaze.compare(people)
    later = np.concatenate([each[1:] for each in points])
    x, y = ((later + 0.5) / 2 - 0.5).T
    cells = gaze.cells.double().numpy()
    assert scores["NSS"] == pytest.approx(nss(cells, x, y).mean())
    assert scores["AUC"] == pytest.approx(auc(cells, x, y).mean())
    column, row = np.arange(52), np.arange(39)[:, None]
    around = [(column - a) ** 2 + (row - b) ** 2 for a, b in zip(x, y, strict=True)]
    theirs = np.exp(-np.array(around) / (2 * 1.56**2)).sum(0)
    assert scores["CC"] == pytest.approx(float(correlation(cells, theirs)), abs=1e-6)
    doubled = [each.resized((208, 156)) for each in people]
    assert gaze.compare(doubled)["NSS"] == pytest.approx(scores["NSS"])


def test_a_file_without_a_frame_is_refused_for_pictures_of_another_size_than_osie(gaze, tmp_path):
    """Read in the frame of OSIE, which has the same proportions, its points would move to the upper left corner."""
    people = gaze.scanpaths(6, seed=1)
    write_osie(tmp_path / "people.json", people)
    with pytest.raises(
        InputError, match=r"people: expected the frame of .*size=\(104, 78\)\) if .*size=\(800, 600\)\)"
    ):
        gaze.compare(tmp_path / "people.json")
    assert gaze.compare(read_osie(tmp_path / "people.json", size=(104, 78))) == pytest.approx(gaze.compare(people))
    write_osie(tmp_path / "large.json", [one.resized((800, 600)) for one in people])
    assert replace(gaze, size=(800, 600)).compare(tmp_path / "large.json")["NSS"] > 0


def test_people_are_given_as_to_a_scanpath_and_their_unit_is_looked_at(gaze, tmp_path):
    """Of a file those in the picture are taken, which any path and ending of its name tells."""
    people = gaze.scanpaths(6, seed=1)
    scores = gaze.compare(people)
    write_table(tmp_path / "t.csv", [*people, replace(people[0], picture="other.png")])
    assert gaze.compare(tmp_path / "t.csv") == pytest.approx(scores)
    assert gaze.compare([replace(each, picture="x/poster.jpg") for each in people]) == scores
    assert gaze.compare(people[0]) == gaze.compare(people[:1])
    with pytest.raises(InputError, match=r"people: expected fixations in 'poster', got in 'other.png'; if both"):
        gaze.compare([replace(each, picture="other.png") for each in people])
    for said, change in (
        ("fractions of the sides", lambda points: (points + 0.5) / (104, 78)),
        ("pixels from the centre", lambda points: points - (52, 39)),
    ):
        wrong = [replace(each, points=change(each.points)) for each in people]
        with pytest.warns(UserWarning, match=f"people: .* look like {said}") as said_here:
            assert gaze.compare(wrong)["NSS"] < scores["NSS"]
        assert said_here[0].filename == __file__


def test_what_cannot_be_drawn_or_compared_is_refused(gaze):
    for name, value in [("people", 0), ("seconds", 0.0), ("seconds", 1e9)]:
        refused(name, gaze.scanpaths, **{name: value})
    square = Fixations("poster.png", "1", np.array([[5.0, 5.0], [7.0, 8.0]]), (100, 100))
    refused("proportions of 104 × 78", gaze.compare, [square])
    refused("at least one person", gaze.compare, [])
    for wrong in (None, [square, "b.png"]):
        refused(r"^people: expected fixations, records of an agent, or a file, got a ", gaze.compare, wrong)
    only = Fixations("poster.png", "1", np.array([[5.0, 5.0]]), (104, 78))
    refused("after the first of each person", gaze.compare, [only])
    assert repr(gaze).count("\n") == len(gaze.peaks())
    assert gaze.plot() is not None


def test_the_film_has_a_frame_after_each_fixation(gaze, tmp_path):
    film = gaze.animate(people=2, duration=0.8, seed=1)
    assert len(film.frames) == max(map(len, gaze.scanpaths(2, seconds=0.8, seed=1))) + 1
    assert not np.array_equal(film.frames[0], film.frames[1])
    assert gaze.animate(tmp_path / "gaze.gif", people=2, duration=0.4).stat().st_size > 1000
    refused("seconds", gaze.animate, seconds=0)


def test_a_large_picture_is_predicted_from_a_reduced_copy(tmp_path, monkeypatch):
    """Its floats would take gigabytes; the prediction is that of the whole picture, in its pixels."""
    agent = ActivePerception.recommended()
    photograph = example_scene("market", ["person"]).image
    height, width = (4 * side for side in photograph.shape[-2:])
    path = tmp_path / "large.png"
    pixels = F.interpolate(photograph[None], (height, width), mode="bicubic")[0].clamp(0, 1)
    Image.fromarray((255 * pixels.permute(1, 2, 0)).byte().numpy()).save(path)
    seen = [(0.1 * width, 0.7 * height), (0.8 * width, 0.4 * height)]
    expected = [agent.gaze(path), agent.gaze(path, seen=seen)]
    monkeypatch.setattr("semfov.agents.picture._MOST_WHOLE", 1000)
    monkeypatch.setattr("semfov.agents.picture._VIEWED", width / 8)
    monkeypatch.setattr("semfov.data.windowed._LARGE", 1000)
    image, size = OpenedPicture.of(path).viewed(torch.zeros(1))
    assert size == (width, height)
    assert image.shape[-1] == width // 4
    # Views of a panorama are as high as it is, and need its pixels where those of the width would do.
    monkeypatch.setattr("semfov.agents.picture._VIEWED", width / 6.5)
    for panorama, reduction in ((False, 4), (True, 1)):
        image, size = OpenedPicture.of(path).viewed(torch.zeros(1), panorama=panorama)
        assert (image.shape[-1], size) == (width // reduction, (width, height))
    monkeypatch.setattr("semfov.agents.picture._VIEWED", width / 8)
    for whole, prediction in zip(expected, [agent.gaze(path), agent.gaze(path, seen=seen)], strict=True):
        assert prediction.size == (width, height)
        assert 0.5 * (prediction.cells - whole.cells).abs().sum() < 0.15


def test_a_picture_of_one_pixel_has_no_place_at_minus_zero():
    text = str(ActivePerception.recommended().gaze(np.zeros((1, 1, 3), np.uint8)))
    assert "look first at (0, 0)" in text
    assert "-0" not in text

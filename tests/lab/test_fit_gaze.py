"""The fit of where people look, on fixations that were drawn from a known density."""

import math
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter

from eval.human import main as compare
from eval.human.folds import Smoothing, StudiedFold, likeliest_smoothing, others_of, viewed_by
from eval.human.glimpses import so_far
from eval.human.viewing import covering
from semfov import InputError, saliency
from semfov.cli.main import main
from semfov.data.fixations import Fixations, write_osie, write_table
from semfov.fit.gaze import GazeFit, _fit_map, fit_oculomotor, fitted_density, maps_of, score
from semfov.fit.gaze_adapted import adapted_density
from semfov.fit.gaze_folds import CENTRE, Fold, FoldStore
from semfov.fit.gaze_model import (
    ADAPTED,
    ANEW,
    GazeModelFit,
    _describe_viewing,
    fit_gaze_model,
    gaze_report,
    summaries,
)
from semfov.fit.settings import FitDetectorConfig
from semfov.gaze.saliency.fixation_density import cells_of
from semfov.human.viewing import (
    Events,
    MapSource,
    ViewingData,
    _grouped,
    features_of,
    log_centre,
    look,
)
from semfov.metrics.scanpath import auc, log_likelihood, nss
from tests.refusals import refused
from tests.small import Shown

SIZE = (60, 80)


def picture(seed):
    """A grey picture with red and blue discs, and the place of the red one, which people look at."""
    generator = torch.Generator().manual_seed(seed)
    image = 0.5 * torch.ones(3, *SIZE)
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    places = torch.rand(2, 2, generator=generator) * torch.tensor([56.0, 36.0]) + 12
    for channel, place in zip((0, 2), places, strict=True):
        inside = (x - place[0]) ** 2 + (y - place[1]) ** 2 < 64
        image[:, inside] = 0.1
        image[channel, inside] = 0.9
    return image, places[0].numpy()


def people(seed, place, count=6):
    rng, times = np.random.default_rng(seed), np.full(8, 200.0)
    points = (np.clip(place + 3 * rng.standard_normal((8, 2)), 0, (79, 59)) for _ in range(count))
    return [Fixations(f"{seed}.png", str(number), each, (80, 60), times) for number, each in enumerate(points)]


def summary_of(metrics, baseline):
    """Means of the scores of one model over pictures, and its gain over a baseline."""
    return summaries({("all terms", 0): metrics, (CENTRE, 0): baseline})["1"]["all terms"]


def viewed(shown):
    """Pictures `(image, people)` as the fit has them."""
    source = features_of(Shown("colours", ("none",), (80, 60), stride=4).eval())
    (made,) = _grouped((source.maps(image[None]), some) for image, some in shown)
    return made


@pytest.fixture(scope="module")
def group():
    return viewed([(image, people(seed, place)) for seed in range(24) for image, place in [picture(seed)]])


def test_a_fitted_map_is_high_where_people_looked_in_other_pictures(group):
    torch.manual_seed(0)
    ((fitted, held),) = Fold(lambda: [group], 0, 4, GazeFit()).split
    model = saliency.FixationDensity({"backbone8": 3}, units=8, centre=log_centre([group], [fitted]))
    fit = GazeFit(epochs=60, saccade_epochs=15, rate=0.02, dropout=0.0)

    def bits():
        return float(score(model, group, maps_of(model, group, fitted), fitted, conditional=False)[0][:, 2].mean())

    before = bits()
    _fit_map(model, [group], [fitted], fit)
    assert (bits() - before) * math.log(2) > 1
    base = saliency.FixationDensity({"backbone8": 3}, centre=model.centre)
    maps = maps_of(model, group, held)
    (baseline,) = score(base, group, [torch.zeros_like(each) for each in maps], held, conditional=False)
    scores = summary_of(score(model, group, maps, held, conditional=False)[0], baseline)
    assert scores["gain"] > 1.5
    assert scores["NSS"] > 3
    fit_oculomotor(model, [group], [maps_of(model, group, fitted)], [fitted], fit, rate=0.1)
    after = summary_of(score(model, group, maps, held, conditional=True)[0], baseline)
    assert after["gain"] > scores["gain"] - 0.05
    _describe_viewing(model, [group])
    assert float(model.duration[0, 0]) == pytest.approx(math.log(200), abs=1e-5)
    assert float(model.pause) == pytest.approx((3000 - 1600) / 8)


def test_a_model_of_few_people_can_be_read(tmp_path):
    """One scanpath alone is long, and begins outside the picture."""
    model, several = saliency.FixationDensity({"backbone8": 3}), people(0, np.array([40, 30]), count=1)
    points = several[0].points - (500, 0)
    _describe_viewing(model, [viewed([(picture(0)[0], [replace(several[0], points=points)])])])
    model.save(tmp_path / "model.safetensors")
    read = saliency.FixationDensity.from_pretrained(tmp_path / "model.safetensors")
    assert torch.equal(read.duration[:, 1], torch.zeros(len(read.duration)))


def test_pictures_without_scanpaths_change_no_first_fixation():
    one, other = (saliency.FixationDensity({"backbone8": 3}) for _ in range(2))
    group = viewed([(picture(0)[0], people(0, np.array([40, 30])))])
    unseen = viewed([(picture(1)[0], []), (picture(2)[0], [])])
    _describe_viewing(one, [group])
    _describe_viewing(other, [unseen, group])
    assert torch.equal(other.start, one.start)
    assert torch.equal(other.duration, one.duration)


def test_there_is_a_score_for_each_set_of_terms_and_picture(group):
    model = saliency.FixationDensity({"backbone8": 3}).requires_grad_(False)
    maps = maps_of(model, group, [2, 3])
    for conditional in (False, True):
        assert score(model, group, maps, [2, 3], conditional=conditional, without=[]) == []
        assert score(model, group, [], [], conditional=conditional, without=[]) == []
        for pictures in ([], [2, 3]):
            without = (("centre bias",), ("map",), ())
            scored = score(model, group, maps[: len(pictures)], pictures, conditional=conditional, without=without)
            assert [each.shape for each in scored] == [(len(pictures), 3)] * 3


def test_scores_equal_the_measures_of_scanpaths(group):
    """Of a picture whose cells are the bins, so that nothing is summed."""
    torch.manual_seed(1)
    model = saliency.FixationDensity({"backbone8": 3}, centre=torch.randn(39, 52)).requires_grad_(False)
    maps = torch.randn(1, 1, *cells_of(SIZE))
    scored = score(model, group, maps, [2], conditional=False, raster=(52, 39))[0][0]
    log = (maps[0, 0] + model.centre_bias(SIZE)).double()
    log = log - log.logsumexp((0, 1))
    cell = Events.of(group.paths[2], SIZE, cells_of(SIZE)).cell.numpy()
    x, y = cell % 52, cell // 52
    expected = [nss(log.exp(), x, y).mean(), auc(log, x, y).mean(), log_likelihood(log, x, y).mean()]
    np.testing.assert_allclose(scored.numpy(), expected, rtol=1e-4)


def test_views_that_are_all_sharp_show_what_the_sharp_picture_shows(group):
    torch.manual_seed(1)
    model = saliency.FixationDensity({"backbone8": 3}, centre=torch.randn(39, 52)).requires_grad_(False)
    views = group.some([2, 2, 2])
    seen = partial(so_far, model, views, torch.tensor([[5.0, 5.0], [70.0, 5.0], [40.0, 50.0]]), SIZE)
    sharp = maps_of(model, group, [2])[0]
    torch.testing.assert_close(seen(Events.of(group.paths[2], SIZE, (3, 4)))[5:6], sharp)
    one, other = (score(model, group, [each], [2], conditional=True)[0] for each in (sharp, seen))
    torch.testing.assert_close(one, other)
    views.maps["backbone8"].zero_()
    assert not score(model, group, [seen], [2], conditional=True)[0].allclose(one)


def test_the_density_of_other_people_is_that_of_their_blurred_fixations(group):
    """Twin: `scipy.ndimage.gaussian_filter`, far from the border."""
    density = others_of(group, 5, torch.zeros(39, 52), Smoothing(1.3, 0.05)).exp()
    for person in range(len(group.paths[5])):
        counts = np.zeros((39, 52))
        for other, theirs in enumerate(group.paths[5]):
            if other != person:
                np.add.at(counts, tuple(((theirs[1:].numpy()[:, ::-1] + 0.5) * 52 / 80).astype(int).T), 1)
        expected = gaussian_filter(counts, 1.3, mode="constant", truncate=6)
        expected = 0.95 * expected / expected.sum() + 0.05 / 2028
        np.testing.assert_allclose(density[person], expected, atol=1e-4)


def test_the_blur_follows_the_spread_of_people(group):
    """Twin: of all others, the likelihood of a person's fixations is largest at the smoothing that is chosen."""
    centre = torch.zeros(39, 52)
    chosen = {}
    for spread in (0.2, 1.0):

        def nearer(person, spread=spread):
            middle = person.points.mean(0)
            return replace(person, points=middle + spread * (person.points - middle))

        scattered = replace(group, people=tuple(tuple(map(nearer, people)) for people in group.people))
        chosen[spread] = likeliest_smoothing([scattered], [range(6)], centre)
    assert chosen[0.2].blur < chosen[1.0].blur

    def bits(smoothing):
        """Sum over all fixations of people, one after the other."""
        total = 0.0
        for picture in range(6):
            log_density = others_of(group, picture, centre, smoothing).numpy()
            points = [path[1:].numpy() for path in group.paths[picture]]
            logs = [log_density[k][tuple(((p[:, ::-1] + 0.5) * 52 / 80).astype(int).T)] for k, p in enumerate(points)]
            total += float(np.concatenate(logs).mean())
        return total

    best = chosen[1.0]
    others = [Smoothing(1.3, best.share), Smoothing(0.7, best.share), Smoothing(best.blur, 0.2)]
    assert bits(best) >= max(bits(other) for other in others)


def test_a_model_is_adapted_to_few_pictures(group):
    """A model whose map, blur and centre are far off predicts others as well as before it was spoilt."""
    torch.manual_seed(0)
    fit = GazeFit(readouts=1, units=8, epochs=30, saccade_epochs=0, rate=0.02, dropout=0.0)
    model = fitted_density(fit, [group], [range(16)], "a test")

    def bits(model):
        held = range(16, 24)
        return float(score(model, group, maps_of(model, group, held), held, conditional=False)[0][:, 2].mean())

    spoilt = deepcopy(model)
    spoilt.out.mul_(3.0)
    spoilt.blur.sub_(1.0)
    spoilt.centre = (torch.arange(52.0) / 10).expand(39, 52).flatten().log_softmax(0).view(39, 52)
    adapted = adapted_density(spoilt, [group], [range(8)], "a test")
    assert bits(spoilt) < bits(model) - 0.5
    assert bits(adapted) > bits(model) - 0.1
    assert torch.equal(spoilt.centre[0], spoilt.centre[1])  # what was given stays


def test_the_better_of_two_ways_is_kept(tmp_path, monkeypatch):
    """A shipped model is adapted where pictures are few, unless it was fitted to them."""
    everyone = []
    for seed in range(8):
        image, place = picture(seed)
        Image.fromarray((image * 255).byte().permute(1, 2, 0).numpy()).save(tmp_path / f"{seed}.png")
        everyone += people(seed, place, 2)
    write_table(tmp_path / "people.csv", everyone)
    detector = Shown("colours", ("none",), (80, 60), stride=4).eval()
    monkeypatch.setattr(saliency.FixationDensity, "shipped", tmp_path / "shipped")
    data = {"fixations": (tmp_path / "people.csv",), "pictures": (tmp_path,), "cache": tmp_path, "folds": 2}
    good = GazeFit(readouts=1, units=8, epochs=40, saccade_epochs=0, rate=0.02, dropout=0.0)
    alone = fit_gaze_model(GazeModelFit(**data, fit=good), detector, tmp_path / "alone")
    assert [*alone.scores] == [ANEW]
    alone.model.metadata["data"] = ["of other pictures"]
    alone.model.save(tmp_path / "shipped/colours.safetensors")
    poor = GazeModelFit(**data, fit=replace(good, epochs=1))
    few = fit_gaze_model(poor, detector, tmp_path / "few")
    assert few.way == ADAPTED
    assert f"Kept: {ADAPTED}." in gaze_report(few)
    few.model.save(tmp_path / "few.safetensors")
    read = saliency.FixationDensity.from_pretrained(tmp_path / "few.safetensors")
    torch.testing.assert_close(read.centre, few.model.centre)
    alone.model.metadata["data"] = poor.fingerprint
    alone.model.save(tmp_path / "shipped/colours.safetensors")
    assert fit_gaze_model(poor, detector, tmp_path / "known").way == ANEW


def test_people_are_predicted_by_the_others(group):
    """A density of other people predicts better than a centre bias, and is not that of a person's own fixations."""
    fit = GazeFit(saccade_epochs=1)
    fold = StudiedFold(lambda: [group], 0, 4, fit, maps="other people")
    scored = fold.scores(fold.fit())
    assert summary_of(scored["map and centre bias", 0], scored[CENTRE, 0])["gain"] > 1
    alone = viewed_by(group, {"0"})
    assert float(others_of(alone, 5, torch.zeros(39, 52), Smoothing(1.3, 0.05)).std()) < 1e-6


def test_models_are_scored_by_other_people_and_read_again(group, tmp_path, monkeypatch):
    half, others = viewed_by(group, {"0", "1", "2"}), viewed_by(group, {"3", "4", "5"})
    assert {each.subject for some in others.people for each in some} == {"3", "4", "5"}
    fit = GazeFit(epochs=2, units=4, saccade_epochs=0)
    store = FoldStore(tmp_path, {"data": "drawn"})
    fold = StudiedFold(lambda: [half], 1, 4, fit, judges=lambda: [others])
    first = store.scores("halves", [fold])
    assert set(first) == {(CENTRE, 0), ("map", 0), ("map and centre bias", 0)}
    monkeypatch.setattr("semfov.fit.gaze_folds.fitted_density", None)
    monkeypatch.setattr("semfov.fit.gaze_folds.score", None)
    again = store.scores("halves", [fold])
    assert all(torch.equal(first[key], again[key]) for key in first)


def test_oculomotor_biases_recover_a_known_saccade_length():
    """People whose saccades are all of one length, in any direction: the fitted bias peaks there."""
    rng = np.random.default_rng(0)
    shown = []
    for seed in range(12):
        some = []
        for n in range(6):
            path = [np.array([40.0, 30.0])]
            while len(path) < 8:
                angle = rng.uniform(0, 2 * math.pi)
                new = path[-1] + 20 * np.array([math.cos(angle), math.sin(angle)])
                if (new >= 0).all() and new[0] < 80 and new[1] < 60:
                    path.append(new)
            some.append(Fixations(f"{seed}", str(n), np.array(path), (80, 60)))
        shown.append((torch.full((3, *SIZE), 0.5), some))
    group = viewed(shown)
    model = saliency.FixationDensity({"backbone8": 3})
    flat = torch.zeros(12, 1, *cells_of(SIZE))
    fit_oculomotor(model, [group], [flat], [list(range(12))], GazeFit(saccade_epochs=30), rate=0.2)
    path = torch.tensor([[[0.5, 0.4]]])
    places = torch.tensor([[0.5, 0.4]]) + torch.tensor([0.05, 0.15, 0.25, 0.36, 0.5])[:, None] * torch.tensor(
        [0.6, -0.8]
    )
    assert int(model.oculomotor(path, places)[0].argmax()) == 2


def test_folds_hold_out_each_picture_once(group):
    """Also where the pictures of a data set have two sizes, and there is another data set."""
    few = replace(group, people=group.people[:11])
    groups = [few, replace(few, people=few.people[:5]), replace(few, source=1)]
    splits = [Fold(lambda: groups, number, 3, GazeFit()).split for number in range(3)]
    for place, each in enumerate(groups):
        assert sorted(one for split in splits for one in split[place][1]) == list(range(len(each)))
        for fitted, held in (split[place] for split in splits):
            assert sorted(fitted + held) == list(range(len(each)))
    for number, split in enumerate(splits):
        held = [place + before for (_, some), before in zip(split[:2], (0, 11), strict=True) for place in some]
        assert held == list(range(number, 16, 3))


def test_pictures_are_looked_at_once(tmp_path):
    """Maps of any names are read again, in their order, on which the first weights of a model depend."""
    image, place = picture(3)
    Image.fromarray((image * 255).byte().permute(1, 2, 0).numpy()).save(tmp_path / "3.png")
    write_table(tmp_path / "people.csv", people(3, place, 2))
    seen = []

    def maps(image):
        seen.append(image)
        return covering({"red": image[:, :1], "itti-koch": image[:, 1:]}, SIZE)

    data = ViewingData(fixations=(tmp_path / "people.csv",), pictures=(tmp_path,), cache=tmp_path)
    first, again = (look(data, MapSource(("red", "itti-koch"), maps, {})) for _ in range(2))
    assert len(seen) == 1
    torch.testing.assert_close(first[0].features.maps, again[0].features.maps)
    assert [*first[0].features.maps] == [*again[0].features.maps] == ["red", "itti-koch"]


def test_a_frame_that_a_file_lacks_is_asked_for_where_pictures_are_not_those_of_osie(tmp_path):
    image, place = picture(3)
    Image.fromarray((image * 255).byte().permute(1, 2, 0).numpy()).save(tmp_path / "3.png")
    viewed = [replace(one, durations=np.ones(len(one))) for one in people(3, place, 2)]
    write_osie(tmp_path / "people.json", viewed)
    source = MapSource(("red",), lambda image: covering({"red": image[:, :1]}, SIZE), {})
    given = {"fixations": (tmp_path / "people.json",), "pictures": (tmp_path,), "cache": tmp_path}
    told = r"^gaze\.sizes: .* pictures of 80 × 60: 80x60 if .* 800x600 if"
    with pytest.raises(InputError, match=told):
        look(GazeModelFit(**given), source)
    (group,) = look(GazeModelFit(**given, sizes=("80x60",)), source)
    assert group.size == SIZE
    # One of OSIE's size before it tells nothing of the others.
    Image.new("RGB", (800, 600)).save(tmp_path / "0.png")
    points = np.random.default_rng(0).uniform(0, [800, 600], (80, 2))
    many = Fixations("0.png", "1", points, (800, 600), durations=np.ones(80))
    write_osie(tmp_path / "people.json", [many, *(replace(one, size=(800, 600)) for one in viewed)])
    with pytest.raises(InputError, match=told):
        look(GazeModelFit(**given), source)


def test_settings_of_gaze_without_their_fixations_are_refused():
    for given, told in [
        ({"seconds": (-1.0,)}, r"seconds\[0\]: expected a number from 0.1"),
        ({"seconds": (0.05,)}, r"seconds\[0\]"),
        ({"seconds": (3.0, 5.0)}, "seconds: expected a time for each of 1 files"),
        ({"sizes": ("800x600", "640x480")}, "sizes: expected a frame"),
        ({"pictures": ()}, "pictures: expected a folder"),
    ]:
        with pytest.raises(InputError, match=told):
            ViewingData(**{"fixations": (Path("people.csv"),), "pictures": (Path("photographs"),), **given})
    with pytest.raises(InputError, match=r"^gaze\.pictures: expected a folder for each of 1 files of fixations, got 0"):
        GazeModelFit(fixations=(Path("people.csv"),))
    refused(r"^gaze\.folds: expected 0, or 2 or more, got 1", GazeModelFit, folds=1)
    with pytest.raises(InputError, match=r"--gaze\.fixations FILE"):
        FitDetectorConfig(model=Path("yolov3-tiny"), gaze=GazeModelFit(seconds=(3.0,))).named()


@pytest.mark.slow
def test_the_command_fits_a_model_and_studies_compare_it(tmp_path, monkeypatch, capsys):
    """Pictures of two sizes, and a table as eye trackers have it."""
    (tmp_path / "pictures").mkdir()
    everyone = []
    for seed in range(6):
        image, place = picture(seed)
        pixels = (image * 255).byte().permute(1, 2, 0).numpy()
        scale = 2 + seed % 2
        Image.fromarray(np.kron(pixels, np.ones((scale, scale, 1), np.uint8))).save(tmp_path / f"pictures/{seed}.png")
        everyone += [each.resized((80 * scale, 60 * scale)) for each in people(seed, place, 2)]
    write_table(tmp_path / "people.csv", everyone)
    detector = Shown("colours", ("none",), (160, 120), stride=4).eval()
    monkeypatch.setattr("semfov.fit.detector.check_sources", lambda data, config: None)
    monkeypatch.setattr("semfov.fit.detector.make_detector", lambda config: detector)
    data = {"fixations": tmp_path / "people.csv", "pictures": tmp_path / "pictures", "cache": tmp_path, "seconds": 3}
    data |= {"folds": 2, "fit.epochs": 2, "fit.saccade_epochs": 1, "fit.units": 4}
    words = [str(word) for name, value in data.items() for word in (f"--gaze.{name}", value)]
    assert main(["fit", "colours", *words, "--out", str(tmp_path / "mymodels")]) == 0, capsys.readouterr().err
    printed = capsys.readouterr().out
    model = saliency.FixationDensity.from_pretrained(tmp_path / "mymodels/gaze.safetensors")
    assert model.layers == {"backbone8": 3}
    assert model.metadata["training"]["pictures"] == 6
    model.check_compatible(detector)
    assert "6 pictures, each held out once" in (tmp_path / "mymodels/gaze.md").read_text()
    assert f"--model {tmp_path / 'mymodels/gaze.safetensors'}" in printed
    assert not (tmp_path / "mymodels/manifest.json").exists()
    monkeypatch.setattr("eval.human.viewing.load_detector", lambda name, **options: detector)
    monkeypatch.setattr("eval.human.viewing._saliency", lambda name: features_of(detector))
    page = tmp_path / "page.md"
    page.write_text("<!-- table viewing -->\n<!-- end -->\n")
    words = [word.replace("gaze.", "") for word in words]
    more = [
        "--detectors", "[colours]", "--saliency", "[vocus2]", "--studied", "0",
        "--sequences", "2", "--glimpses", "1",
    ]  # fmt: skip
    more += ["--out", str(tmp_path / "viewing"), "--page", str(page)]
    assert compare(["viewing", *words, *more]) == 0, capsys.readouterr().err
    lines = page.read_text().splitlines()
    assert [line.split("|")[1].strip() for line in lines if line.startswith("| ")] == [
        "", "centre bias", "vocus2", "colours", "inter-observer", "vocus2, with oculomotor biases",
        "colours, with oculomotor biases", "centre bias, with oculomotor biases",
        "inter-observer, with oculomotor biases",
    ]  # fmt: skip
    summary = (tmp_path / "viewing/summary.md").read_text()
    assert "half of the people" in summary
    assert "| without oculomotor biases | " in summary

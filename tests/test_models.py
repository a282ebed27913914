"""The models that the package ships: their size, names and metadata, and plausible outputs."""

import json
import re
from itertools import product
from pathlib import Path

import pytest
import torch

import semfov
from semfov import ActivePerception, FovealObservationModel
from semfov.belief import Verification
from semfov.cli.agent import detector_classes, make_agent, note_of_detector
from semfov.cli.options import SearchOptions
from semfov.errors import InputError, SemfovError
from semfov.io.pretrained import shipped_model
from semfov.observation.presence import log_evidence, presence_facts
from semfov.observation.thresholds import Thresholds
from semfov.presets import PUBLISHED_SENSORS, published_model
from semfov.sensor import SENSORS
from semfov.zoom import GlimpseEvidence
from semfov.zoom.hints import Gist
from tests.refusals import refused, unusable

KINDS = (FovealObservationModel, Verification, GlimpseEvidence, semfov.saliency.FixationDensity)
OBSERVATION = sorted(semfov.FovealObservationModel.shipped.glob("*.safetensors"))
ZOOM = sorted(GlimpseEvidence.shipped.glob("*.safetensors"))


LARGEST = {FovealObservationModel: 1_100_000, semfov.saliency.FixationDensity: 350_000}
SHIPPED = [(kind, path) for kind in KINDS for path in sorted(kind.shipped.glob("*.safetensors"))]


@pytest.mark.parametrize(("kind", "path"), SHIPPED, ids=lambda each: each.stem if isinstance(each, Path) else each.kind)
def test_shipped_files_are_small_and_in_their_card_and_name_no_place(kind, path):
    assert path.stat().st_size < LARGEST.get(kind, 100_000)
    assert "/" not in json.dumps(kind.from_pretrained(path.stem).metadata).replace("://", "")
    cards = [folder / "README.md" for folder in (path.parent, path.parent.parent) if (folder / "README.md").exists()]
    assert any(re.search(rf"`{path.stem}(\.safetensors)?`", card.read_text("utf-8")) for card in cards)


def test_the_card_of_where_people_look_says_how_the_models_were_fitted():
    shipped = semfov.saliency.FixationDensity.shipped
    card = (shipped / "README.md").read_text("utf-8")
    table = re.findall(r"^\| `(.+?)` \| (`.+?) \| .+? \|$", card, re.M)
    assert {name for name, _ in table} == {path.stem for path in shipped.glob("*.safetensors")}
    said = {
        "epochs": r"(\d+) epochs",
        "saccade_epochs": r"(\d+) passes",
        "batch": r"(\d+) pictures in a step",
        "rate": r"rate of ([\d.]+\d)",
    }
    for name, layers in table:
        model = semfov.saliency.FixationDensity.from_pretrained(name)
        assert layers == ", ".join(f"`{each}`" for each in model.layers)
        training = model.metadata["training"]
        assert {each: float(re.search(words, card)[1]) for each, words in said.items()} == {
            each: training[each] for each in said
        }
        assert [training[each] for each in ("readouts", "units")] == [4, 32]


@pytest.mark.parametrize("path", OBSERVATION, ids=lambda path: path.stem)
def test_shipped_observation_models(path):
    model = semfov.FovealObservationModel.from_pretrained(path.stem)
    assert len(model.classes) == 80
    zoom = path.stem.endswith("-zoom")
    assert model.alpha.shape == (81, 4 if zoom else 8, 81)
    # Models for windows also have the number of cells that hold each class.
    assert ("cells" in model.metadata) == zoom
    assert bool((model.miss_rate > 0).all() and (model.miss_rate < 1).all())
    # Objects are missed more often at larger distances from the fovea, and if the image is reduced more.
    assert model.miss_rate[1:, -1].mean() > model.miss_rate[1:, 0].mean()
    assert sum(map(sum, model.metadata["counts"])) == model.metadata["samples"]


@pytest.mark.parametrize("kind", ["", "-sharp"])
@pytest.mark.parametrize("detector", ["yolov3-tiny", "yolox-nano", "nanodet-plus-m-1.5x"])
def test_shipped_models_make_semantic_maps(detector, kind):
    model = semfov.FovealObservationModel.from_pretrained(f"{detector}{kind}")
    # A confident detection at the fovea determines the class of its cell, and distant cells are background.
    grid, fixation = semfov.Grid(10, 10, (640, 480)), torch.tensor([[330.0, 230.0]])
    scores = torch.full((1, 1, 81), 0.001)
    scores[..., 7] = 0.92
    box = torch.tensor([[[300.0, 200.0, 360.0, 260.0]]])
    seen = semfov.Detections(box, scores, torch.ones(1, 1, dtype=torch.bool))
    mapper = semfov.observers.SemanticMap(model)
    with torch.no_grad():
        belief = mapper(mapper.start(1, grid, fixation), seen, fixation, grid)
    named = belief.probabilities[0].argmax(-1)
    assert named[grid.cell_of(fixation)[0]] == 7
    assert named[0] == named[99] == 0


@pytest.mark.parametrize("path", ZOOM, ids=lambda path: path.stem)
def test_shipped_models_of_glimpse_evidence(path):
    model = GlimpseEvidence.from_pretrained(path.stem)
    assert model.metadata["detector"]["name"] == path.stem
    # The higher the score of a faint candidate, the more objects of its class closer looks are expected to find.
    scores = torch.zeros(4, 16, 16, model.classes)
    scores[:, 8, 8, 6] = torch.tensor([0.0, 0.005, 0.02, 0.08])
    size = torch.zeros(16, 16)
    size[8, 8] = 4.0
    looks = [Gist(0, (0, 0), 1, hints, size * (hints.amax(-1) > 0), hints > 1) for hints in scores]
    with torch.no_grad():
        found = torch.stack([model.rates(look, torch.tensor([7])).exp()[0, 0, 7:10, 7:10].sum() for look in looks])
        taper = model.taper(16)
    assert bool((found.diff() > 0).all())
    # The higher the score of a class, and the more of its objects are expected, the more probable is its presence.
    assert model.thresholds is not None
    rising = torch.tensor([0.02, 0.3, 0.9])
    with torch.no_grad():
        assert bool((model.presence(rising, torch.ones(3)).diff() > 0).all())
        assert bool((model.presence(torch.full((3,), 0.3), rising).diff() > 0).all())
    # Objects in the middle of a window are detected; objects at its border may be cut.
    assert taper[8] > taper[0]
    torch.testing.assert_close(taper, taper.flip(0))


DETECTORS = ("yolov3-tiny", "yolox-nano", "nanodet-plus-m-1.5x")


def test_every_detector_has_all_kinds_of_models():
    kinds = ("", "-sharp", "-published", "-published-narrow", "-zoom", "-search")
    at_thresholds = {f"{name}-published-{threshold}" for name in DETECTORS[:2] for threshold in (0.1, 0.25, 0.5)}
    every = {name + kind for name in DETECTORS for kind in kinds}
    assert {path.stem for path in OBSERVATION} == every | at_thresholds
    assert {path.stem for path in Verification.shipped.glob("*.safetensors")} == {*DETECTORS}


@pytest.mark.parametrize("name", DETECTORS)
def test_models_of_searches_go_on_from_the_others(name):
    """Of the same eye and α; nearer objects are missed less often, and fixated cells refute what covers them."""
    model = semfov.FovealObservationModel.from_pretrained(f"{name}-search")
    before = semfov.FovealObservationModel.from_pretrained(name)
    assert torch.equal(model.log_alpha, before.log_alpha)
    assert before.log_miss is None
    assert not before.log_exponents.any()
    assert float(before.refutation.detach()) == 0
    model.check_compatible({"detector": before.metadata["detector"], "sensor": before.metadata["sensor"]})
    odds = model.miss_odds(torch.tensor([0.0, 0.9])).detach()
    assert bool((odds[1, 1:] > odds[0, 1:]).all())
    assert float(model.refutation.detach()) > 0.5
    assert model.metadata["method"] == "search"


@pytest.mark.parametrize("name", ["yolox-nano", "nanodet-plus-m-1.5x"])
def test_models_of_searches_say_what_they_were_fitted_to(name):
    metadata = semfov.FovealObservationModel.from_pretrained(f"{name}-search").metadata
    assert metadata["search"]["photographs"] > 40
    assert metadata["training"]["holdout"] == 5
    assert metadata["data"]


def test_the_words_of_other_libraries_for_files_are_refused_with_ours(tmp_path):
    model = semfov.FovealObservationModel.identity(["cup"], [0.2])
    with pytest.raises(AttributeError, match=r"no attribute 'save_pretrained'; use model.save\(path\)"):
        model.save_pretrained(tmp_path)
    assert not hasattr(model, "missing")
    torch.save(model.state_dict(), tmp_path / "alpha.pt")
    with pytest.raises(semfov.InputError, match=r"a shipped observation model .*, got .*alpha.pt; load_state_dict"):
        semfov.FovealObservationModel.from_pretrained(tmp_path / "alpha.pt")


def test_yolov3_tiny_searches_with_the_numbers_of_yolox_nano():
    model, other = (
        semfov.FovealObservationModel.from_pretrained(f"{name}-search") for name in ("yolov3-tiny", "yolox-nano")
    )
    assert "those of yolox-nano-search" in model.metadata["search"]
    assert torch.equal(model.log_miss, other.log_miss)
    assert torch.equal(model.presence.slopes, other.presence.slopes)
    assert torch.equal(model.presence.centre, other.presence.centre)
    assert model.presence.thresholds == other.presence.thresholds


@pytest.mark.parametrize(("name", "detector"), [("yolox-nano", "YOLOX-nano"), ("nanodet-plus-m-1.5x", "NanoDet-Plus")])
def test_the_card_has_the_numbers_and_thresholds_of_true_cells(name, detector):
    model = semfov.FovealObservationModel.from_pretrained(f"{name}-search")
    card = " ".join((model.shipped / "README.md").read_text("utf-8").split())
    presence = model.presence
    offset, slope = presence.centre.tolist()
    assert f"{offset:.2f} and {slope:.2f} for {detector}" in card
    cell, score = presence.slopes.tolist()
    assert f"{cell:.2f} and {score:.2f} in `{name}-search`" in card
    thresholds = presence.thresholds
    assert f"| {thresholds.confirm:.2f} | {thresholds.place:.2f} | {thresholds.stop_below:.2f} |" in card


@pytest.mark.parametrize("name", DETECTORS)
def test_the_presence_of_models_of_searches_grows_with_what_the_looks_show(name):
    presence = semfov.FovealObservationModel.from_pretrained(f"{name}-search").presence
    assert bool((presence.slopes > 0).all())
    assert presence.shares.shape == (80,)
    thresholds = presence.thresholds
    assert 0.49 < thresholds.confirm < 1
    assert 0 < thresholds.stop_below <= 0.3
    # Nothing was seen in one look, and the class with certainty in the other: below and above the threshold.
    facts = presence_facts(torch.tensor([[1e-6], [0.99]]), log_evidence(torch.tensor([0.0, 0.95])))
    unseen, seen = presence(facts).sigmoid().tolist()
    assert unseen < 0.1
    assert seen > thresholds.confirm


@pytest.mark.parametrize("growth", [1.0, 2.0])
@pytest.mark.parametrize("detector", DETECTORS)
def test_a_shipped_model_is_fitted_for_the_sensor(detector, growth):
    model = semfov.FovealObservationModel.from_pretrained(f"{detector}-sharp" if growth == 1 else detector)
    assert model.metadata["sensor"]["growth"] == growth
    assert model.metadata["detector"]["name"] == detector
    assert model.metadata["method"] == "discriminative"


@pytest.mark.parametrize(("detector", "sensor"), list(product(DETECTORS, PUBLISHED_SENSORS)))
def test_published_model_is_fitted_by_maximum_likelihood_for_the_named_sensor(detector, sensor):
    model = semfov.FovealObservationModel.from_pretrained(f"{detector}-{sensor}")
    fitted = model.metadata["sensor"]
    named = SENSORS[sensor].settings
    assert (fitted["sigma"], fitted["growth"]) == pytest.approx((named["sigma"], named["growth"]))
    assert model.metadata["method"] == "newton"
    assert not model.log_prior.any()
    assert float(model.tempering) == 1
    torch.testing.assert_close(model.expected_scores(), model.alpha / model.alpha.sum(-1, keepdim=True))


@pytest.mark.parametrize("threshold", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("detector", ["yolov3-tiny", "yolox-nano"])
def test_published_models_are_fitted_at_other_thresholds_too(detector, threshold):
    assert published_model(detector, "published", threshold) == f"{detector}-published-{threshold}"
    model = semfov.FovealObservationModel.from_pretrained(f"{detector}-published-{threshold}")
    assert model.metadata["detector"]["selection"]["threshold"] == threshold
    assert model.metadata["sensor"]["sigma"] == pytest.approx(100)
    assert model.metadata["method"] == "newton"
    assert not model.log_prior.any()


@pytest.mark.parametrize("sensor", PUBLISHED_SENSORS)
def test_published_agent_searches_and_explores(sensor):
    agent = semfov.ActivePerception.published(sensor=sensor, search="non-predictive")
    assert float(agent.eye.sensor.sigma) == pytest.approx(SENSORS[sensor].settings["sigma"])
    assert agent.eye.sensor.growth == 1
    scene = semfov.EmbeddedScenes(agent.eye.detector.classes, count=1)[0]
    assert len(agent.search(scene.image, "person", start=0, shifts=2)) <= 3
    assert len(agent.explore(scene.image, start=0, shifts=2)) == 3
    with pytest.raises(semfov.InputError, match="published sensor 'gradual'"):
        semfov.ActivePerception.published(sensor="gradual")


def test_recommended_agent_searches_and_explores():
    agent = semfov.ActivePerception.from_pretrained()
    scenes = semfov.EmbeddedScenes(agent.eye.detector.classes, count=1)
    scene = scenes[0]
    target = scenes.targets(0)[0]
    found = agent.search(scene.image, target, boxes=scene.boxes[scene.labels == target], start=0)
    assert found.found
    assert found.shifts <= 10
    assert found.probabilities.shape[-1] == 81
    assert found.posterior.shape == (len(found), 100)
    assert bool(((found.posterior >= 0) & (found.posterior <= 1)).all())
    explored = agent.explore(scene.image, start=0, shifts=2)
    assert explored.posterior is None
    assert len(explored) == 3
    nowhere = torch.zeros(0, 4)  # boxes that no fixation lands on, so that both searches make all looks
    present = agent.search(scene.image, target, start=0, shifts=4, boxes=nowhere)
    absent = agent.search(scene.image, "toaster", start=0, shifts=4, boxes=nowhere)
    assert present.presence[-1] > 0.5 > absent.presence[-1]


@pytest.fixture(scope="module")
def one_of_each(tmp_path_factory):
    """Models of all kinds in files of their own, with thresholds by which they are known again."""
    folder = tmp_path_factory.mktemp("fitted")
    known = Thresholds(0.9375, 0.125, 0.0625)
    search = FovealObservationModel.from_pretrained("yolox-nano-search")
    search.presence.thresholds = known
    verification = Verification.from_pretrained("yolox-nano")
    verification.thresholds = known
    windows = GlimpseEvidence.from_pretrained("yolox-nano")
    windows.thresholds = known
    explore = FovealObservationModel.from_pretrained("yolox-nano")
    with torch.no_grad():
        explore.log_cell += 0.125
    models = {
        "search": search,
        "explore": explore,
        "verification": verification,
        "windows": windows,
    }
    for name, model in models.items():
        model.save(folder / f"{name}.safetensors")
    return folder, models


@pytest.mark.parametrize("part", ["search", "explore", "verification", "windows"])
def test_the_file_of_one_model_takes_the_place_of_the_shipped_one(part, one_of_each):
    """In Python and in commands, which take it as they take a folder; the other models are the shipped ones."""
    folder, models = one_of_each
    file = folder / f"{part}.safetensors"
    agents = [ActivePerception.from_pretrained(file), make_agent(SearchOptions(models=file))]
    shipped = _parts(ActivePerception.recommended())
    for agent in agents:
        parts = _parts(agent)
        assert parts[part].digest() == models[part].digest() != shipped[part].digest()
        for other in parts.keys() - {part}:
            assert parts[other].digest() == shipped[other].digest()


@pytest.mark.shared
def test_one_file_of_a_detector_whose_weights_are_given_takes_the_place_of_the_shipped_one(shared, tmp_path):
    """By its weights, and as a detector of one's own under another name."""
    weights = tmp_path / "mine.onnx"
    weights.write_bytes((shared / "weights" / "nanodet_plus_m_1.5x_416.onnx").read_bytes())
    search = FovealObservationModel.from_pretrained("nanodet-plus-m-1.5x-search")
    search.presence.thresholds = Thresholds(0.9375, 0.125, 0.0625)
    file = tmp_path / "search.safetensors"
    search.save(file)
    agents = [
        ActivePerception.from_pretrained(file, weights=weights),
        ActivePerception.from_pretrained(file, detector=weights),
        make_agent(SearchOptions(models=file, weights=weights)),
        make_agent(SearchOptions(models=file, detector=str(weights))),
    ]
    for agent in agents:
        assert _parts(agent)["search"].digest() == search.digest()
        assert agent.verification.digest() == Verification.from_pretrained("nanodet-plus-m-1.5x").digest()


@pytest.mark.parametrize("name", DETECTORS)
def test_a_shipped_verification_was_fitted_to_the_cells_of_the_shipped_search(name):
    search = FovealObservationModel.from_pretrained(f"{name}-search")
    assert search.true_cells
    Verification.from_pretrained(name).check_searching(search)


def test_the_file_of_a_model_of_other_probabilities_of_cells_is_refused(one_of_each, tmp_path):
    """As earlier fits wrote them: a search without the numbers, a verification that does not name its cells."""
    folder, _ = one_of_each
    search = FovealObservationModel.from_pretrained(folder / "search.safetensors")
    search.presence.centre = None
    verification = Verification.from_pretrained(folder / "verification.safetensors")
    del verification.metadata["true_cells"]
    remedy = (
        "fit again with python -m train.fit_search and python -m train.fit_verification, or .* semfov fit yolox-nano"
    )
    for model, expected, got in (
        (search, "probabilities of cells as the belief has them", "true probabilities of cells"),
        (verification, "true probabilities of cells", "probabilities of cells as the belief has them"),
    ):
        model.save(tmp_path / "former.safetensors")
        message = f"verification: expected one .* with {expected}, got one of {got}; {remedy}"
        refused(message, ActivePerception.from_pretrained, tmp_path / "former.safetensors")
    verification.check_searching(search)


def _parts(agent):
    return {
        "search": agent.searching.observer.model,
        "explore": agent.exploring.observer.model,
        "verification": agent.verification,
        "windows": agent.windows,
    }


def test_the_file_of_a_model_names_its_detector_and_what_else_it_may_be(one_of_each, tmp_path):
    folder, models = one_of_each
    file = folder / "search.safetensors"
    assert detector_classes(SearchOptions(models=file)) == models["search"].classes
    for kind in ("published", "raw"):
        refused("agent: expected recommended with --models FILE", make_agent, SearchOptions(models=file, agent=kind))
    refused("yolov3-tiny", ActivePerception.from_pretrained, file, detector="nothing")
    gaze = semfov.saliency.FixationDensity.shipped / "yolox-nano.safetensors"
    refused("models: expected .* `semfov gaze --model FILE` takes it", ActivePerception.from_pretrained, gaze)
    unnamed = FovealObservationModel.from_pretrained(file)
    unnamed.metadata = {}
    unnamed.save(tmp_path / "unnamed.safetensors")
    refused("detector: expected the detector that", ActivePerception.from_pretrained, tmp_path / "unnamed.safetensors")
    unusable("no such file", ActivePerception.from_pretrained, tmp_path / "missing.safetensors")
    detector = tmp_path / "mine.onnx"
    detector.touch()
    given = rf"or the \.safetensors of one, got a file; a detector is given as detector='{detector}'$"
    unusable(given, detector_classes, SearchOptions(models=detector))
    beach = tmp_path / "beach.jpg"
    beach.touch()
    unusable(r"or the \.safetensors of one, got a file$", detector_classes, SearchOptions(models=beach))


def test_the_file_of_a_model_goes_with_a_detector_that_is_loaded(one_of_each):
    folder, models = one_of_each
    file = folder / "search.safetensors"
    detector = semfov.load_detector(models["search"].metadata["detector"]["name"])
    assert ActivePerception.from_pretrained(file, detector=detector).eye.detector is detector
    with pytest.raises(InputError, match=r"path: expected an option .* known: detector, grid") as caught:
        ActivePerception.from_pretrained(file, path="x")
    assert not re.search(r"known: .*\b(path|name)\b", str(caught.value))


def test_checks_are_of_the_detector_that_the_file_of_a_model_names():
    file = FovealObservationModel.shipped / "yolov3-tiny-search.safetensors"
    options = SearchOptions(models=file, classes=("cup",))
    refused("classes: expected none for yolov3-tiny, which has its own", detector_classes, options)
    options = SearchOptions(models=file, weights=Path("a.onnx"))
    refused("weights: expected Darknet weights for yolov3-tiny", detector_classes, options)
    refused("head: expected none .* got yolov3-tiny", make_agent, SearchOptions(models=file, head="yolox"))
    assert note_of_detector(SearchOptions(models=file)) == f"the detector is yolov3-tiny, to which {file} was fitted\n"
    assert note_of_detector(SearchOptions(models=file, detector="yolov3")) == ""
    assert note_of_detector(SearchOptions()) == ""
    with pytest.raises(SemfovError, match=r"yolov3-tiny.*yolox-nano"):  # named, although it is the default
        make_agent(SearchOptions(models=file, detector="yolox-nano"))


@pytest.mark.parametrize("name", ["mine-search", "mine", "mine-published", "mine-published-0.1"])
def test_a_detector_without_shipped_models_is_named_with_those_that_have_them(name):
    """By their names alone, whatever the purpose of the model, though the file of the detector is called otherwise."""
    others = "nanodet-plus-m-1.5x, yolov3-tiny, yolox-nano" if "0.1" not in name else "yolov3-tiny, yolox-nano"
    message = rf"no observation model is shipped for 'mine', only for {others}; .* `semfov fit my/mine\.onnx "
    refused(message, shipped_model, FovealObservationModel, name, "mine", "my/mine.onnx")

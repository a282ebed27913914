"""`semfov fit` for a detector of coloured squares, from photographs to a search."""

import errno
import itertools
import json
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import torch
from PIL import Image
from scipy import stats

import semfov
from eval.comparison.model_folder import with_models
from eval.decide import main as decide
from eval.decide.run import DecideConfig
from eval.explore.run import ExploreConfig
from eval.search import main as search
from eval.search.run import SearchConfig
from semfov import ActivePerception, DataError, EmbeddedScenes, FovealObservationModel, InputError
from semfov.belief import Verification
from semfov.belief.observers import Semantic, SemanticMap, SemanticSearch
from semfov.cli.main import main as command
from semfov.detection.class_names import COCO_CLASSES
from semfov.fit.detector import _check_photographs, _print_plan, _seconds_of_looks, _with_classes
from semfov.fit.detector_report import Difference
from semfov.fit.folder import FITS as PART_FITS
from semfov.fit.folder_report import thin_classes
from semfov.fit.part import PartInputs, PartResult
from semfov.fit.search import FitSearchConfig
from semfov.fit.searches import SearchEnd
from semfov.fit.settings import FitDetectorConfig
from semfov.fit.thresholds import choose_thresholds
from semfov.fit.verification import VerifiedSearch
from semfov.fit.verification_part import VerificationFit, _scores
from semfov.io.files import sha256
from semfov.io.manifest import PARTS, Manifest, Part
from semfov.model_folder import ModelFolder
from semfov.runs.config import DataConfig, DetectorConfig, PolicyConfig
from semfov.runs.looking import Looking
from semfov.runs.progress import WholeBar, task_bar, track
from semfov.runs.protocols import choose_classes
from semfov.runs.setup import make_map
from tests.colours import CLASSES, COLOURS, SIDE, SMALL, write_home, write_network, write_photographs
from tests.refusals import refused, unusable
from tests.small import once

pytestmark = pytest.mark.usefixtures("few_samples")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The parent folder of a network, photographs and the models fitted to them."""
    folder = write_home(tmp_path_factory.mktemp("fit_detector"))
    torch.set_num_threads(1)
    task, foreign = WholeBar.task, []

    def noting(bar, title, total):
        foreign.extend([title] * (title not in bar._tasks))
        return task(bar, title, total)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WholeBar, "task", noting)
        assert command(arguments(folder)) == 0
    (folder / "foreign.json").write_text(json.dumps(foreign))
    return folder


def data(folder):
    root = folder / "photographs"
    return ["--data.root", str(root), "--data.annotations", str(root / "instances.json")]


def arguments(folder, *more):
    paths = ["--out", str(folder / "models"), "--cache", str(folder / "cache")]
    return once(["fit", str(folder / "colours.onnx"), *data(folder), *SMALL, *paths, *more])


@pytest.mark.slow
def test_the_folder_describes_its_models(home):
    manifest = Manifest.read(home / "models")
    assert manifest.classes == CLASSES
    assert manifest.grid == (4, 4)
    assert manifest.detector["sha256"] == sha256(home / "colours.onnx")
    assert manifest.detector["model_file"]["relative"] == "../colours.onnx"
    assert manifest.sensor["sigma"] == 60
    assert manifest.sensor["growth"] == 1
    assert list(manifest.parts) == ["observation", "search", "verification", "windows"]
    assert manifest.training["photographs"] == 20
    assert manifest.training["held_out"] == 5
    for name, part in manifest.parts.items():
        assert "held-out photographs" in part.why, (name, part.why)
        assert (part.file is None) == (name == "windows")
    thresholds = FovealObservationModel.from_pretrained(home / "models/search.safetensors").presence.thresholds
    assert 0.49 < thresholds.confirm <= 0.9  # few searches to choose it from
    text = (home / "models/report.md").read_text()
    assert f"counts as found if the probability of its presence is at least {thresholds.confirm:.3f}" in text
    assert f"gives up if no other cell has a probability of at least {thresholds.stop_below:.3f}" in text
    assert "20 photographs, 5 of them held out (one in 4); 3 classes; 4 × 4 cells" in text
    verification = Verification.from_pretrained(home / "models/verification.safetensors")
    assert 0.5 <= verification.thresholds.confirm <= 0.9
    assert verification.thresholds.stop_below <= thresholds.stop_below
    assert verification.metadata["detector"] == ModelFolder(home / "models").eye().settings()["detector"]
    section = text.split("## Verification (closer looks)")[1].split("## ")[0]
    assert f"| {verification.thresholds.confirm:.2f} (chosen) " in section
    assert "| no closer looks " in section
    for name in ("reliability.png", "search.png"):
        assert f"({name})" in text
        with Image.open(home / "models" / name) as picture:
            picture.verify()


def test_the_agent_of_the_folder_finds_the_target(home):
    folder = ModelFolder(home / "models")
    agent = ActivePerception.from_pretrained(home / "models")
    assert agent.classes[1:] == CLASSES
    assert (agent.columns, agent.rows) == (4, 4)
    assert not any(parameter.requires_grad for parameter in agent.parameters())
    assert isinstance(agent.searching.observer, SemanticSearch if folder.used("search") else Semantic)
    assert isinstance(agent.exploring.observer, SemanticMap)
    image = photograph_with(2, (7, 0))
    assert 12 in agent.search(image, "blue", start=3, shifts=15).cells.tolist()
    assert len(agent.explore(image, shifts=3).cells) >= 1


@pytest.mark.parametrize("search", ["predictive", "non-predictive"])
def test_the_published_agent_takes_the_folder(home, search):
    folder = ModelFolder(home / "models")
    agent = ActivePerception.published(home / "models", search=search)
    assert (agent.columns, agent.rows) == folder.manifest.grid
    assert agent.eye.settings() == folder.eye().settings()
    fitted = FovealObservationModel.from_pretrained(folder.file("observation")).state_dict()
    used = agent.searching.observer.observation.state_dict()
    assert all(torch.equal(used[name], value) for name, value in fitted.items())
    assert agent.searching.policy.name == search
    assert agent.exploring.policy.name == "kl"
    image = torch.rand(3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    assert len(agent.search(image, "blue", shifts=2, confirm=1.0).cells) == 3
    with pytest.raises(InputError, match="sensor: expected None with a folder of models"):
        ActivePerception.published(home / "models", sensor="published")


def test_eval_search_with_the_folder_matches_the_report(home, capsys):
    """`eval.search` on only the held-out photographs gives the same cumulative performance with other code."""
    (home / "ids.txt").write_text("0 4 8 12 16")
    out = home / "search"
    options = [
        "--models", str(home / "models"), "--policies", "[non-predictive-raw, non-predictive-learned]",
        "--workers", "1", "--data.min_instances", "0", "--data.ids", str(home / "ids.txt"), "--protocol.shifts", "15",
        "--scanpaths", "0", "--out", str(out), "--cache", str(home / "cache"),
    ]  # fmt: skip
    assert search([*data(home), *options]) == 0
    lines = (out / "summary.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines if line.startswith("all") or "all targets" in line]
    performance = {(row[1], int(row[2])): float(row[3]) for row in rows}
    report = (home / "models/report.md").read_text().split("## Search model")[1]
    for name, policy in (("fitted", "non-predictive-learned"), ("raw", "non-predictive-raw")):
        row = next(line for line in report.splitlines() if line.startswith(f"| {name} "))
        shares = [float(cell.split("±")[0]) for cell in row.split("|")[2:5]]
        assert shares == pytest.approx([100 * performance[policy, n] for n in (1, 5, 15)], abs=0.051)
    capsys.readouterr()


FITS = {
    "observation": "observation.fit_published",
    "search": "search_part.fit_search",
    "verification": "verification_part.fit_in_folds",
    "windows": "windows_part.MosaicFit",
}


def test_every_part_of_a_folder_has_a_fit_in_the_order_of_the_manifest():
    assert tuple(PART_FITS) == PARTS


def forbid(monkeypatch, *parts):
    """Make the fit of parts fail."""
    for part in parts:
        monkeypatch.setattr(f"semfov.fit.{FITS[part]}", None)


def test_repeating_the_command_fits_nothing(home, monkeypatch, capsys):
    before = {path.name: path.read_bytes() for path in (home / "models").glob("*.safetensors")}
    forbid(monkeypatch, *FITS)
    assert command(arguments(home)) == 0
    assert {path.name: path.read_bytes() for path in (home / "models").glob("*.safetensors")} == before
    printed = capsys.readouterr()
    assert "semfov search PHOTO.jpg --target" in printed.out
    assert f"--models {home / 'models'}" in printed.out


@pytest.mark.slow
@pytest.mark.parametrize(("part", "lost"), [("verification", "model"), ("search", "record")])
def test_only_a_missing_part_is_fitted_again(home, tmp_path, monkeypatch, part, lost):
    """As after a killed run: finished parts are read, and the missing one is fitted with the same result."""
    shutil.copytree(home / "models", tmp_path / "models")
    name = f"{part}.safetensors" if lost == "model" else f"progress/{part}.json"
    (tmp_path / "models" / name).unlink()
    (tmp_path / "models/manifest.json").unlink()
    forbid(monkeypatch, *(FITS.keys() - {part}))
    torch.set_num_threads(1)
    assert command(arguments(home, "--out", str(tmp_path / "models"))) == 0
    again, once = (folder / f"models/{part}.safetensors" for folder in (tmp_path, home))
    assert again.read_bytes() == once.read_bytes()


@pytest.mark.parametrize("agent", ["recommended", "published"])
def test_the_command_takes_the_folder(home, tmp_path, capsys, agent):
    photo = str(home / "photographs/0.png")
    given = [photo, "--target", "red", "--shifts", "0", "--models", str(home / "models"), "--agent", agent]
    assert command(["search", *given]) == 0
    assert re.search(r"0\.png, .*red", capsys.readouterr().out)


def copy_models(home, tmp_path):
    shutil.copytree(home / "models", tmp_path / "models")
    shutil.copy(home / "colours.onnx", tmp_path)
    return tmp_path / "models"


def test_another_network_is_refused(home, tmp_path):
    folder = copy_models(home, tmp_path)
    write_network(tmp_path / "colours.onnx", bias=-3.0)
    unusable(r"detector: .*expected the network .*semfov fit", ActivePerception.from_pretrained, folder)
    with pytest.raises(DataError, match="expected the network"):
        ActivePerception.from_pretrained(home / "models", detector=tmp_path / "colours.onnx")


def test_a_moved_network_is_found_next_to_the_folder_or_can_be_given(home, tmp_path):
    folder = copy_models(home, tmp_path / "here")
    # The network is next to the folder as before, so the two may be moved together.
    assert ModelFolder(folder).detector_source()[0] == str(tmp_path / "here/models/../colours.onnx")
    place = tmp_path / "here/colours.onnx"
    place.rename(tmp_path / "elsewhere.onnx")
    assert ModelFolder(folder).detector_source()[0] == str((home / "colours.onnx").resolve())
    record = json.loads((folder / "manifest.json").read_text())
    assert record["detector"]["model_file"]["absolute"] == str((home / "colours.onnx").resolve())
    agent = ActivePerception.from_pretrained(folder, detector=tmp_path / "elsewhere.onnx")
    assert agent.eye.detector.classes == CLASSES


@pytest.mark.parametrize("name", ["manifest.json", "search.safetensors", "verification.safetensors"])
def test_a_changed_file_is_refused(home, tmp_path, name):
    folder = copy_models(home, tmp_path)
    content = (folder / name).read_bytes()
    last = bytes([content[-1] ^ 1])  # another byte, whatever it is
    (folder / name).write_bytes(content.replace(b"red", b"rod", 1) if name.endswith("json") else content[:-1] + last)
    unusable(f"{name}: damaged or changed", ModelFolder, folder)
    (folder / name).unlink()
    listed = r"manifest\.json: no such file; expected a folder of models that semfov fit wrote"
    told = listed if name.endswith("json") else rf"{name}, which manifest\.json lists: no such file"
    unusable(told, ModelFolder, folder)


def rewrite_manifest(folder, **parts):
    """Rewrite the manifest of a folder so that all parts are used or unused, or with other parts."""
    known = Manifest.read(folder)
    changed = dict(known.parts) | {name: part for name, part in parts.items() if name != "used"}
    if "used" in parts:
        changed = {name: replace(part, used=parts["used"]) for name, part in changed.items()}
    replace(known, parts=changed).write(folder)


def test_a_part_that_does_not_improve_is_not_used(home, tmp_path):
    folder = copy_models(home, tmp_path)
    rewrite_manifest(folder, used=True)
    agent = ActivePerception.from_pretrained(folder)
    assert isinstance(agent.searching.observer, SemanticSearch)
    assert isinstance(agent.exploring.observer, SemanticMap)
    assert agent.exploring.policy.name == "closer-look"
    given = SearchConfig(models=folder, policies=("recommended", "random"))
    assert with_models(given).policies == ("non-predictive-learned", "random")
    rewrite_manifest(folder, used=False)
    agent = ActivePerception.from_pretrained(folder)
    observer = agent.searching.observer
    assert isinstance(observer, Semantic)
    assert observer.observation is None
    assert observer.tempering == 1
    assert observer.footprint == "overlap"
    assert agent.searching.policy.name == "non-predictive"
    # Maps take raw scores, where these were better, without another part.
    assert isinstance(agent.exploring.observer, SemanticMap)
    given = SearchConfig(models=folder, policies=("recommended", "non-predictive-learned"))
    assert with_models(given).policies == ("non-predictive-raw", "non-predictive-learned")
    (explored,) = with_models(ExploreConfig(models=folder, policies=("recommended",))).policies
    assert (explored.policy, explored.scores) == ("closer-look", "learned")


@pytest.mark.parametrize("scores", ["raw", "calibrated"])
def test_maps_take_the_scores_that_tell_better_what_cells_hold(home, tmp_path, scores):
    folder = copy_models(home, tmp_path)
    part = Manifest.read(folder).parts["observation"]
    of_map = part.settings["map"]
    assert f"| Semantic map (explorations) | yes, {of_map['scores']} scores" in " ".join(
        (folder / "report.md").read_text().split()
    )
    cell = [0.125, 2.0, 0.5]
    part = replace(part, settings={"map": {**of_map, "scores": scores, "raw_cell": cell}})
    rewrite_manifest(folder, observation=part)
    fitted = ModelFolder(folder).observation()
    expected = fitted if scores == "calibrated" else FovealObservationModel.identity(CLASSES, fitted.edges, cell=cell)
    eye = ModelFolder(folder).eye()
    study = with_models(ExploreConfig(models=folder, policies=("recommended",)))
    for got in (
        ActivePerception.from_pretrained(folder).exploring.observer.model,
        make_map(study.belief.map_model, eye),
    ):
        assert torch.equal(got.log_alpha, expected.log_alpha)
        assert torch.equal(got.log_cell, expected.log_cell)
        assert got.metadata == fitted.metadata


def photograph_with(colour, place):
    """A grey photograph with a square of one colour, `place` in 8 × 8 squares."""
    pixels = np.full((SIDE, SIDE, 3), 125, dtype=np.uint8)
    pixels[8 * place[0] : 8 * place[0] + 8, 8 * place[1] : 8 * place[1] + 8] = COLOURS[colour]
    return torch.from_numpy(pixels).permute(2, 0, 1) / 255


def test_the_agent_of_the_folder_looks_closely_at_a_target(home, tmp_path):
    folder = copy_models(home, tmp_path)
    rewrite_manifest(folder, used=True)
    agent = ActivePerception.from_pretrained(folder)
    fitted = Verification.from_pretrained(folder / "verification.safetensors")
    assert torch.equal(agent.verification.linear.weight, fitted.linear.weight)
    image = photograph_with(2, (7, 0))
    scanpath = agent.search(image, "blue", start=3, shifts=15)
    assert 1 <= len(scanpath.closer) <= 2
    look = scanpath.closer[0]
    assert look.cell == 12
    assert scanpath.decision.outcome == "found"
    assert scanpath.decision.place == pytest.approx(max(look.place for look in scanpath.closer))
    assert agent.search(image, "blue", start=3, shifts=15, closer=0).closer == ()


def test_without_verification_or_a_model_of_searches_the_agent_decides_without_closer_looks(home, tmp_path):
    folder = copy_models(home, tmp_path)
    rewrite_manifest(folder, used=True)
    known = Manifest.read(folder).parts
    for unused in ("verification", "search"):
        rewrite_manifest(folder, used=True)
        rewrite_manifest(folder, **{unused: replace(known[unused], used=False)})
        agent = ActivePerception.from_pretrained(folder)
        assert agent.verification is None
        assert agent.search(photograph_with(2, (7, 0)), "blue", start=3, shifts=15).closer == ()


def test_decisions_are_evaluated_with_the_verification_of_the_folder(home, tmp_path):
    folder = copy_models(home, tmp_path)
    rewrite_manifest(folder, used=True)
    file = str(folder / "verification.safetensors")
    assert with_models(DecideConfig(models=folder)).verification == file
    assert with_models(DecideConfig(models=folder, verification="other")).verification == "other"
    given = ["--models", str(folder), "--data.min_instances", "0", "--data.limit", "3", "--workers", "1"]
    out = tmp_path / "decide"
    assert decide([*data(home), *given, "--out", str(out), "--cache", str(home / "cache")]) == 0
    records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert any(record["closer"] > 0 for record in records if record["policy"] == "non-predictive-learned")
    assert {record["closer"] for record in records if "no closer looks" in record["policy"]} == {0}


def test_without_a_model_of_searches_no_verification_is_fitted(home, tmp_path, monkeypatch):
    config = FitDetectorConfig(model=home / "colours.onnx", columns=4, rows=4, holdout=4, out=tmp_path)
    scenes = EmbeddedScenes(("dog", "boat"), count=8)
    inputs = PartInputs(config, SimpleNamespace(scenes=scenes))
    inputs.results["search"] = PartResult(Part("search.safetensors", "0", False, "not better"), "")
    forbid(monkeypatch, "verification")
    fitted = VerificationFit(inputs).fit()
    assert fitted.part == Part(None, None, False, "not fitted, since the agent does not use the model of searches")


def test_a_verification_that_cannot_be_fitted_to_the_held_out_photographs_is_left_out(home, tmp_path, monkeypatch):
    folder = copy_models(home, tmp_path)
    (folder / "progress/verification.json").unlink()
    seen = []

    def fail(photographs, *_):
        seen.extend(photographs)
        raise DataError("data: too few")

    monkeypatch.setattr("semfov.fit.verification_part.fit_in_folds", fail)
    assert command(arguments(home, "--out", str(folder))) == 0
    assert len(seen) >= 2
    assert {photograph.index for photograph in seen} <= set(range(0, 20, 4))
    part = Manifest.read(folder).parts["verification"]
    assert (part.file, part.used, part.why) == (None, False, "could not be fitted: data: too few")
    assert ActivePerception.from_pretrained(folder, detector=home / "colours.onnx").verification is None
    assert "Could not be fitted: data: too few" in (folder / "report.md").read_text()

    def fill_the_disk(*_):
        raise DataError("progress: cannot be written") from OSError(errno.ENOSPC, "no space left")

    # The part is not blamed for what stops the command, and is fitted once there is room.
    (folder / "progress/verification.json").unlink()
    monkeypatch.setattr("semfov.fit.verification_part.fit_in_folds", fill_the_disk)
    assert command(arguments(home, "--out", str(folder))) != 0
    assert not (folder / "progress/verification.json").exists()


def test_decisions_are_scored_by_photograph():
    """Present and absent classes have equal weight, whatever their number."""
    kinds = [(0, True, True), (0, True, None), (0, False, False), (0, False, None), (0, False, None), (4, True, False)]
    searches = [
        VerifiedSearch(number, present, False, (), (), 0.5, 3, SearchEnd(None, 3)) for number, present, _ in kinds
    ]
    ends = [SearchEnd(right, 2) for _, _, right in kinds]
    np.testing.assert_allclose(_scores(searches, ends), [(1 / 2 - 1 / 3) / 2, -1])


def test_experiments_take_their_settings_from_the_folder(home):
    folder = home / "models"
    config = with_models(SearchConfig(models=folder, policies=("non-predictive-learned", "predictive-calibrated")))
    assert config.detector.name == str(folder / "../colours.onnx")
    assert (config.sensor.sigma, config.sensor.growth, config.belief.columns) == (60, 1, 4)
    assert config.belief.search_model == str(folder / "search.safetensors")
    assert config.belief.model == str(folder / "observation.safetensors")
    assert with_models(SearchConfig()) == SearchConfig()
    moved = SearchConfig(models=folder, detector=DetectorConfig(name="elsewhere.onnx"))
    assert with_models(moved).detector.name == "elsewhere.onnx"
    with pytest.raises(InputError, match=r"belief\.map_model: expected null, since models defines it"):
        with_models(SearchConfig(models=folder, belief=SearchConfig().belief.__class__(map_model="x")))


def test_policies_that_need_a_missing_part_are_left_out_or_refused(home, tmp_path):
    folder = copy_models(home, tmp_path)
    rewrite_manifest(folder, observation=Part(None, None, False, "too few detections"))
    kept = with_models(SearchConfig(models=folder)).policies
    assert "predictive-raw" not in kept
    assert {"random", "non-predictive-raw", "non-predictive-learned"} <= set(kept)
    named = SearchConfig(models=folder, policies=(PolicyConfig("non-predictive", "calibrated"),))
    refused("lacks: too few detections", with_models, named)
    refused(r"observation model, got .* without; fit one: semfov fit", ActivePerception.published, folder)


def test_what_has_no_models_is_refused_with_the_command_that_fits_them(home, tmp_path):
    unusable(r"manifest\.json: no such file; .*semfov fit", ActivePerception.from_pretrained, tmp_path)
    refused(r"got 'mymodels'; make a folder by `semfov fit .*mymodels`", ActivePerception.from_pretrained, "mymodels")
    network = str(home / "colours.onnx")
    for make in (ActivePerception.recommended, ActivePerception.from_pretrained, ActivePerception.published):
        refused(r"semfov fit \S+colours\.onnx --data\.root", make, network)


def test_a_known_network_is_recognised_by_its_checksum(home, monkeypatch):
    network = home / "colours.onnx"
    assert semfov.load_detector(network).name == "colours"
    monkeypatch.setitem(semfov.io.compatibility.NETWORKS, sha256(network), "yolox-nano")
    assert semfov.load_detector(network).name == "yolox-nano"


def test_photographs_that_cannot_be_read_are_named_before_the_first_look(tmp_path, capsys):
    paths = sorted((write_home(tmp_path) / "photographs").glob("*.png"))[2:4]
    for path in paths:
        path.write_bytes(path.read_bytes()[:-40])
    assert command(arguments(tmp_path)) == 1
    error = capsys.readouterr().err
    assert "photographs: 2 cannot be read" in error
    assert all(path.name in error for path in paths)
    assert not list((tmp_path / "cache").rglob("*.safetensors"))


def test_annotations_without_any_class_of_the_detector_are_refused(home, tmp_path, capsys):
    record = json.loads((home / "photographs/instances.json").read_text())
    for category in record["categories"]:
        category["name"] = f"other {category['id']}"
    (tmp_path / "instances.json").write_text(json.dumps(record))
    given = arguments(home, "--data.annotations", str(tmp_path / "instances.json"), "--out", str(tmp_path / "out"))
    assert command(given) == 1
    error = capsys.readouterr().err
    assert "expected some of the detector's 3 classes (red, green, blue" in error
    assert "'other 1'" in error


def test_unknown_settings_of_the_call_are_named():
    refused("got 'clases'", semfov.fit_detector, "mine.onnx", "photographs", "instances.json", clases=["cat"])


def test_the_requested_number_of_absent_classes_is_chosen(home):
    """Also for a photograph without a target."""
    scenes = EmbeddedScenes(("person", "dog", "boat", "zebra"), count=4)
    for index in range(4):
        annotation = scenes.annotation(index)
        held = set(annotation.labels.tolist())
        for area in (0.0, 1.0):
            chosen = choose_classes(scenes, index, annotation, 1, area, 0, 3)
            absent = [target for target in chosen if target not in held]
            assert len(absent) == len(set(absent)) == min(3, 4 - len(held))
            assert len(chosen) - len(absent) == (1 if area else 0)


def test_the_highest_threshold_can_be_limited():
    there, looked = torch.tensor([True, False]), torch.ones(1, 2, dtype=torch.bool)
    anywhere, left = torch.tensor([[0.95, 0.99]]), torch.tensor([[0.4, 0.0]])
    assert choose_thresholds(FitSearchConfig(), anywhere, looked, left, there).confirm == 1
    thresholds = choose_thresholds(FitSearchConfig(surest=0.9), anywhere, looked, left, there)
    assert thresholds.confirm == 0.9


def test_classes_with_few_objects_are_reported():
    report = "\n".join(thin_classes({"cat": 3, "dog": 50, "cup": 0}, 20))
    assert "**No object to learn from** (1 classes): cup." in report
    assert "**Fewer than 20 objects to learn from** (1 classes): cat 3." in report
    assert thin_classes({"cat": 20}, 20) == []


@pytest.mark.parametrize("seed", range(6))
def test_differences_match_a_paired_t_test(seed):
    draw = np.random.default_rng(seed)
    fitted, raw = draw.random((2, 8))
    difference = Difference.of(fitted, raw)
    test = stats.ttest_rel(fitted, raw)
    assert difference.mean / difference.error == pytest.approx(test.statistic)
    assert difference.better == (test.statistic > 1)
    # One photograph, or no difference, is no improvement.
    assert not Difference.of(np.array([1.0]), np.array([0.0])).better
    assert not Difference.of(np.ones(5), np.ones(5)).better
    assert Difference.of(np.ones(5), np.zeros(5)).better


def test_one_progress_bar_covers_all_stages(capsys):
    """Stages and tasks count by their weights; unknown tasks do not count, and skipped stages count as done."""
    with WholeBar("all", {"one": {"a": 3, "b": 1}, "two": {"c": 4}, "three": {"d": 2}}) as whole:
        with whole.stage("one"):
            seen = [(item, whole.done) for item in track(range(6), "a", "unit")]
            assert [share for _, share in seen] == pytest.approx([0.05 * number for number in range(6)])
            assert [item for item, _ in seen] == list(range(6))
            assert list(track(range(3), "not among them", "unit")) == [0, 1, 2]
            assert whole.done == pytest.approx(0.3)
        assert whole.done == pytest.approx(0.4)
        with whole.stage("three"):
            assert whole.done == pytest.approx(0.8)
            bar = task_bar(4, "d", "unit")
            bar.update(2)
            assert whole.done == pytest.approx(0.9)
        assert whole.done == pytest.approx(1)
    printed = capsys.readouterr().err
    assert "all: one" in printed
    assert "not among them" not in printed
    # Outside the stages a task has its own bar again.
    assert list(track(range(2), "alone", "unit")) == [0, 1]
    assert "alone" in capsys.readouterr().err


def test_a_bar_fills_no_log(capsys):
    """Where the errors go to a file, a bar is drawn when it opens and when it is done, and seldom between."""
    for _ in track(range(5), "alone", "unit"):
        time.sleep(0.12)
    alone = capsys.readouterr().err
    first, last = alone.splitlines()
    assert "\r" not in alone
    assert first.startswith("alone:")
    assert "0/5" in first
    assert "5/5" in last
    with WholeBar("all", {"one": {"a": 1}}) as whole, whole.stage("one"):
        for _ in track(range(5), "a", "unit"):
            time.sleep(0.12)
    assert capsys.readouterr().err.count("all") <= 4  # it opens, its stage begins and ends, and it is done


def test_a_long_plan_names_what_makes_it_shorter(capsys):
    run = SimpleNamespace(scenes=EmbeddedScenes(COCO_CLASSES, count=2), cells=(3, 2))
    _print_plan(run, {"looking": {"looking": 400.0}, "windows": {"fit": 199.0}})
    assert capsys.readouterr().out.endswith("about 10 minutes\n")
    _print_plan(run, {"looking": {"looking": 400.0}, "windows": {"fit": 201.0}})
    assert "about 11 minutes; --data.limit N takes only N photographs" in capsys.readouterr().out


def test_the_time_left_is_that_of_all_work_and_not_of_one_task(monkeypatch, capsys):
    """Half of the work has taken three times as long as expected; what was done before has taken none."""
    now = [0.0]
    monkeypatch.setattr("semfov.runs.progress.monotonic", lambda: now[0])
    with WholeBar("all", {"done before": {"x": 1e6}, "slow": {"a": 100}, "quick": {"b": 100}}) as whole:
        assert whole.seconds_left == 1_000_200
        with whole.stage("done before"):
            pass
        assert whole.seconds_left == pytest.approx(200)
    with WholeBar("all", {"slow": {"a": 1000}, "quick": {"b": 1000, "c": 1000}}) as whole:
        with whole.stage("slow"):
            for _ in track(range(10), "a", "unit"):
                now[0] += 500
        assert whole.seconds_left == pytest.approx(2000 * 5, rel=0.06)
        with whole.stage("quick"):
            for _ in track(range(10), "b", "unit"):
                now[0] += 10
            # 5,100 seconds for what was expected to take 2,000.
            assert whole.seconds_left == pytest.approx(1000 * 2.55, rel=0.06)
    assert whole.seconds_left == 0
    assert "< 00:00" in capsys.readouterr().err


def test_all_work_of_a_fit_moves_its_bar(home):
    assert json.loads((home / "foreign.json").read_text()) == []


def test_the_bar_expects_looks_from_all_cells_that_are_not_stored(home, tmp_path, monkeypatch):
    """At two seconds a look; scenes that are stored in part count as a whole, and with nothing left a second."""
    root = home / "photographs"
    data = DataConfig(root, root / "instances.json", 3, min_instances=0, max_target_area=None)
    detector = DetectorConfig(str(home / "colours.onnx"))
    run = Looking(
        FitDetectorConfig(data=data, detector=detector, columns=3, rows=2, out=tmp_path, cache=tmp_path, workers=1)
    )
    clock = itertools.count(step=2.0)
    monkeypatch.setattr("semfov.fit.detector.time", SimpleNamespace(monotonic=lambda: next(clock)))
    assert _seconds_of_looks(run, _check_photographs(run)) == 2 * 6 * 3
    run.detections(1)
    assert _seconds_of_looks(run, _check_photographs(run)) == 2 * 6 * 2
    looks = run.store.load(run.digest(1))
    run.store.save(run.digest(1), {cell: looks[cell] for cell in (0, 4)})
    assert _seconds_of_looks(run, _check_photographs(run)) == 2 * 6 * 3
    for index in range(3):
        run.detections(index)
    assert _seconds_of_looks(run, _check_photographs(run)) == 1


@pytest.mark.slow
def test_fitting_from_python_returns_the_agent_of_the_folder(home, tmp_path):
    torch.set_num_threads(1)
    root = home / "photographs"
    agent = semfov.fit_detector(
        home / "colours.onnx", root, root / "instances.json", out=tmp_path / "out", limit=6, columns=4, rows=4,
        holdout=3, steps=3, cache=home / "cache", threshold=0.05,
    )  # fmt: skip
    assert agent.eye.detector.selection.threshold == 0.05
    assert Manifest.read(tmp_path / "out").training["photographs"] == 6
    # Three training steps hardly improve on raw scores; the agent uses only the parts that improved.
    folder = ModelFolder(tmp_path / "out")
    assert isinstance(agent.searching.observer, SemanticSearch) == folder.used("search")
    assert agent.exploring.policy.name == "closer-look"


def test_fitting_uses_targets_of_all_sizes():
    config = FitDetectorConfig(model=Path("a.onnx"), data=DataConfig(max_target_area=0.1)).named()
    assert config.data.max_target_area is None
    assert config.detector.background is None
    for classes, absent in ((("cat", "cup", "dog"), 2), (COCO_CLASSES, None)):
        run = SimpleNamespace(scenes=EmbeddedScenes(classes, count=2))
        assert PartInputs(config, run).absent == absent


def test_class_names_are_the_categories_of_the_annotations_where_their_number_fits(tmp_path, capsys):
    model = onnx.load(write_network(tmp_path / "mine.onnx"))
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "mine.onnx")
    file = write_photographs(tmp_path, 2)
    config = FitDetectorConfig(model=tmp_path / "mine.onnx", data=DataConfig(tmp_path, file)).named()
    refused(r"3 classes of mine\.onnx .*mine\.json.*; the annotations have 4 categories", _with_classes, config)
    annotations = json.loads(file.read_text())
    annotations["annotations"].pop()  # that of the sky
    known = annotations["categories"][:3]
    file.write_text(json.dumps({**annotations, "categories": known[::-1]}))
    assert _with_classes(config).detector.classes == CLASSES
    assert "red, green, blue" in capsys.readouterr().out
    named = replace(config, detector=replace(config.detector, classes=("a", "b", "c")))
    assert _with_classes(named) == named

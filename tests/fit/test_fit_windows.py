"""The fits for windows: evidence on mosaics, verification and decisions, photographs, and their part of a folder."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from semfov import ActivePerception, EmbeddedScenes
from semfov.agents import ZoomAgent
from semfov.agents.episode import EpisodeLimits, Goal
from semfov.agents.window_episode import WindowEpisode, WindowTask
from semfov.data import Annotation, Scene
from semfov.data.mosaics import Mosaics
from semfov.errors import DataError
from semfov.fit.folder import FolderFit
from semfov.fit.photographs import LEAST_CERTAINTY, _explored, _fit_places, fit_photographs
from semfov.fit.settings import FitDetectorConfig
from semfov.fit.windows import MosaicFit
from semfov.fit.windows_decisions import choose_places, search_pictures
from semfov.fit.windows_evidence import ZoomExample
from semfov.fit.windows_part import _RECALL_PASSES, WindowsFit, _photograph_recalls
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.io.manifest import Manifest
from semfov.model_folder import ModelFolder
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.matching import box_iou, right_boxes
from semfov.observation.thresholds import Thresholds
from semfov.runs.config import DataConfig
from semfov.runs.looking import Looking
from semfov.runs.progress import WholeBar
from semfov.runs.window_looking import found_in
from semfov.runs.zoom_store import StoredWindowLooks, WindowLookStore
from semfov.settings import FindSettings
from semfov.zoom import GlimpseEvidence, Lattice, WindowEye
from semfov.zoom.certainty import SPREAD
from semfov.zoom.episode import look_by_look
from semfov.zoom.evidence import PhotographEvidence
from semfov.zoom.looks import LiveWindowLooks, Window
from semfov.zoom.slices import ranked, usual_slices
from tests.colours import COLOURS, write_home
from tests.small import Coloured, RedBoxes, Tiles
from tests.zoom.conftest import Squares
from train.fit_fom import FitFomConfig, fit_fom
from train.fit_zoom import fit_zoom
from train.mosaic_samples import MosaicSampler
from train.zoom_pictures import PICTURE_KINDS, FitZoomConfig, _compose_pictures


def test_mosaics_that_one_look_shows_are_refused(monkeypatch):
    """They are before any is looked at, for which this fit has nothing."""
    monkeypatch.setattr(MosaicFit, "opened", lambda fit, kind: [])
    fit = MosaicFit.__new__(MosaicFit)
    fit.config = FitMosaicsConfig(tile=32)
    with pytest.raises(DataError, match="got a width of 32 px for each; give larger ones, or raise tile"):
        fit.fit()


@pytest.mark.slow
@pytest.mark.lab
def test_the_command_writes_a_model_that_loads(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("semfov.runs.setup.load_detector", lambda name, **options: Tiles(name="bright"))
    config = FitZoomConfig(
        data=DataConfig(limit=4, min_instances=0, max_target_area=None),
        mosaics=1, far=1, crowded=1, judged=1, judged_far=1, searched=1, sought=1, passes=4, tile=48,
        kinds=("few", "objects"), each=1, judged_each=1,
        steps=3, survey_steps=3, out=tmp_path / "out", cache=tmp_path / "cache", workers=1,
    )  # fmt: skip
    fit_zoom(config)
    path = tmp_path / "out" / "bright.safetensors"
    model = GlimpseEvidence.from_pretrained(path)
    model.check_compatible(WindowEye(Tiles(name="bright")).settings())
    assert model.metadata["training"]["steps"] == 3
    figures = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert all(map(math.isfinite, figures.values()))
    assert (tmp_path / "out" / "report.md").read_text() in capsys.readouterr().out
    recalls = recalls_by_foresight((tmp_path / "out" / "report.md").read_text())
    most = [max(*values, 1e-9) for values in zip(*recalls.values(), strict=True)]
    assert len(most) == 3
    best = max(recalls, key=lambda value: sum(recall / high for recall, high in zip(recalls[value], most, strict=True)))
    assert model.survey.foresight == best
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    # Only one part is fitted again.
    fit_zoom(replace(config, evidence=path, refit=("survey",), survey_steps=2, out=tmp_path / "again"))
    other = GlimpseEvidence.from_pretrained(tmp_path / "again" / "bright.safetensors")
    changed = {name for name, tensor in other.state_dict().items() if not torch.equal(before[name], tensor)}
    assert changed
    assert all(name.startswith("survey.") for name in changed)
    assert other.metadata["survey"]["seed"] == config.seed
    fit_zoom(replace(config, evidence=path, refit=("certainty",), out=tmp_path / "certainty"))
    other = GlimpseEvidence.from_pretrained(tmp_path / "certainty" / "bright.safetensors")
    assert other.certainty.numbers == model.certainty.numbers
    assert all(torch.equal(before[name], tensor) for name, tensor in other.state_dict().items())
    # A fit with the same seed gives the same model.
    fit_zoom(config)
    again = GlimpseEvidence.from_pretrained(tmp_path / "out" / "bright.safetensors")
    assert all(torch.equal(before[name], tensor) for name, tensor in again.state_dict().items())


def recalls_by_foresight(report):
    """Recalls by foresight, from the table of a report."""
    rows = {}
    in_table = False
    for line in report.splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if not cells:
            in_table = False
        elif in_table and "-" not in cells[0]:
            rows[float(cells[0])] = tuple(map(float, cells[1:]))
        in_table = in_table or (bool(cells) and cells[0] == "foresight")
    return rows


def test_examples_do_not_depend_on_the_store(tmp_path):
    eye = WindowEye(Tiles(name="bright"))
    mosaics = Mosaics(EmbeddedScenes(("person", "dog", "boat"), count=3), 2, 2, tile=(96, 72), count=1)
    store = WindowLookStore(tmp_path, eye.settings(), 3)
    source = StoredWindowLooks(eye, mosaics, 0, store)
    example = ZoomExample.of(mosaics, 0, source)
    source.save()
    eye.detector.propose = None  # any new look would fail
    same = ZoomExample.of(mosaics, 0, StoredWindowLooks(eye, mosaics, 0, store))
    assert torch.equal(same.shown, example.shown)
    assert torch.equal(same.hinted, example.hinted)
    assert example.overview.counts
    for one, other in zip((example.overview, *example.closer), (same.overview, *same.closer), strict=True):
        assert torch.equal(other.gist.scores, one.gist.scores)
        assert torch.equal(other.gist.found, one.gist.found)
        assert other.counts.keys() == one.counts.keys()
        for size, counts in one.counts.items():
            assert all(map(torch.equal, counts, other.counts[size]))


@pytest.mark.slow
@pytest.mark.lab
def test_observation_models_are_fitted_on_mosaics_by_the_same_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("semfov.runs.setup.load_detector", lambda name, **options: Tiles(name="bright"))
    monkeypatch.setattr("train.mosaic_samples.TILE", (96, 72))
    config = FitFomConfig(
        data=DataConfig(limit=4, min_instances=0, max_target_area=None),
        mosaics=2, fixations=1, levels=4, holdout=2, shard=1, method="newton", name="bright-zoom",
        out=tmp_path / "out", workers=1,
    )  # fmt: skip
    fit_fom(config)
    assert "the number of octaves by which the picture is reduced" in capsys.readouterr().out
    model = FovealObservationModel.from_pretrained(tmp_path / "out" / "bright-zoom.safetensors")
    assert model.edges.tolist() == [0.5, 1.5, 2.5]
    assert model.metadata["sensor"]["glimpse"] == "antialiased bilinear"
    model.check_compatible(WindowEye(Tiles(name="bright")).settings())
    # The model was fitted on one of the two mosaics and evaluated on the other; all samples of the first are counted.
    sampler = MosaicSampler(config, tmp_path / "out" / "samples")
    samples = sampler.load(1)
    assert sum(map(sum, model.metadata["counts"])) == len(samples)
    size = sampler.scenes.annotation(1).size
    lattice = Lattice.over(size, (96, 96))
    assert sum(model.metadata["cells"]) >= lattice.columns * lattice.rows
    assert model.miss_rate.shape == (4, 4)


class Drawn:
    """Pictures of 512 × 384 px with squares; only bright ones are annotated."""

    classes = ("red", "green", "blue")
    ids = (1, 2, 3, 4, 5, 6)

    def _squares(self, index):
        generator = torch.Generator().manual_seed(index)
        for kind in range(3):
            x, y = (int(n) for n in torch.rand(2, generator=generator) * 320)
            yield kind, x, y, float(torch.rand((), generator=generator))

    def __len__(self):
        return len(self.ids)

    def __getitem__(self, index):
        image = torch.zeros(3, 384, 512)
        for kind, x, y, light in self._squares(index):
            image[kind, y : y + 40, x : x + 40] = 0.3 + 0.7 * light
        told = self.annotation(index)
        return Scene(self.ids[index], "squares", image, told.boxes, told.labels)

    def digest(self, index):
        return f"{index:064d}"

    def annotation(self, index):
        bright = [(x, y, kind) for kind, x, y, light in self._squares(index) if light > 0.5]
        boxes = torch.tensor([[x, y, x + 40, y + 40] for x, y, _ in bright]).float().view(-1, 4)
        labels = torch.tensor([kind + 1 for *_, kind in bright]).long()
        return Annotation(boxes, labels, torch.zeros(len(bright)).bool(), (512, 384))


@pytest.mark.slow
def test_the_threshold_of_places_is_chosen_on_searches_that_end_as_those_of_the_agent():
    eye, scenes = WindowEye(Coloured(("red", "green", "blue"), (64, 64), fill=0.0)), Drawn()
    opened = [StoredWindowLooks(eye, scenes, n, None) for n in range(len(scenes))]
    torch.manual_seed(0)
    model = GlimpseEvidence(3, thresholds=Thresholds(0.3, 0.01)).eval().requires_grad_(False)
    config = FitZoomConfig(sought=3, passes=8, place=0.1, false_alarms=0.5)
    searches = search_pictures(model, scenes, opened, config, "test")
    names = "background", *scenes.classes
    for sought in searches:
        assert sought.present == (sought.target in scenes.annotation(sought.picture).labels.tolist())
        # The looks are those of the agent, as far as it goes without closer looks, and so is the probability.
        task = WindowTask(Goal.of(names, sought.target), model)
        path = WindowEpisode(task, sought.source, EpisodeLimits(8)).run()
        after = sought.known[path.passes - 1]
        presence = model.presence(torch.tensor(after.best), torch.tensor(after.expected)).sigmoid()
        assert float(presence) == pytest.approx(path.decision.probability, abs=1e-6)
        if path.decision.outcome == "found":
            boxes = scenes.annotation(sought.picture).boxes[scenes.annotation(sought.picture).labels == sought.target]
            right = any(float(box_iou(path.decision.box[None], box[None])) >= 0.5 for box in boxes)
            assert sought.right(path.decision.box) == right
    text = "\n".join(choose_places(model, searches, config))
    fitted = model.places
    assert (fitted.place, fitted.stop_below) == (0.1, 0.01)
    assert f"| {fitted.confirm:.2f} (chosen)" in text
    # A search with all its closer looks tells how one with the chosen threshold ends.
    ends = []
    model.places = replace(fitted, confirm=1.0)
    verified = [sought.verified() for sought in searches]
    model.places = fitted
    for sought, each in zip(searches, verified, strict=True):
        task = WindowTask(Goal.of(names, sought.target), model)
        path = WindowEpisode(task, sought.source, EpisodeLimits(8)).run()
        right, count = each.found(fitted.confirm)
        assert (right is not None, count) == (path.decision.outcome == "found", path.passes)
        assert right is None or right == sought.right(path.decision.box)
        ends.append((right, sought.present))
    assert len({right for right, _ in ends}) > 1
    absent = [right for right, present in ends if not present]
    assert sum(right is not None for right in absent) <= 0.5 * len(absent)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The parent folder of a network and of photographs, 16 of which are held out."""
    return write_home(tmp_path_factory.mktemp("windows"), 48)


def folder_of(home, **settings):
    """The fits of a folder; the parts before the last one are not made."""
    root = home / "photographs"
    config = FitDetectorConfig(
        model=home / "colours.onnx",
        data=DataConfig(root, root / "instances.json", min_instances=0, max_target_area=None),
        columns=4, rows=4, window_steps=8, workers=1,
        out=home / "models", cache=home / "cache",
    )  # fmt: skip
    config = replace(config, **settings).named()
    return FolderFit(config, Looking(replace(config, out=config.out / "progress")))


@pytest.mark.slow
def test_the_agent_of_the_folder_has_the_evidence_and_an_interrupted_fit_continues(home, tmp_path, monkeypatch):
    usual = WindowsFit.mosaics

    def fewer(*given):
        return replace(usual(*given), mosaics=2, crowded=1, judged=2, searched=2)

    monkeypatch.setattr(WindowsFit, "mosaics", fewer)
    folder, used = folder_of(home), []
    tasks, task = folder.fits["windows"].tasks, WholeBar.task
    with monkeypatch.context() as noting, WholeBar("fitting", {"windows": tasks}) as whole, whole.stage("windows"):
        noting.setattr(WholeBar, "task", lambda bar, title, total: used.append(title) or task(bar, title, total))
        fitted = folder.fit("windows")
    assert {*used} == {*tasks}
    config = folder.fits["windows"].settings
    assert isinstance(config, FitMosaicsConfig)
    # Slots of 4 to 3 that hold square photographs of 64 pixels would be 85 wide, more than the detector needs.
    assert config.tile == 74
    model = GlimpseEvidence.from_pretrained(home / "models" / fitted.part.file)
    assert model.thresholds is not None
    assert "% of the objects are found in 16 passes" in fitted.part.why
    assert all(f"| {name} " in fitted.report for name in ("fitted", "raw"))
    # Looks and the finished part are read again; only the fit is repeated when its record is lost.
    before = (home / "models/windows.safetensors").read_bytes()
    (home / "models/progress/windows.json").unlink()
    with monkeypatch.context() as stored:
        stored.setattr("semfov.data.mosaics.Mosaics.__getitem__", None)
        assert folder_of(home).fit("windows") == fitted
    assert (home / "models/windows.safetensors").read_bytes() == before
    monkeypatch.setattr("semfov.fit.windows_part.MosaicFit", None)
    folder = folder_of(home)
    assert folder.fit("windows") == fitted
    part = replace(fitted.part, used=True)
    folder.inputs.results["windows"] = fitted._replace(part=part)
    folder.manifest().write(home / "models")
    agent = ActivePerception.from_pretrained(home / "models")
    assert all(torch.equal(tensor, model.state_dict()[name]) for name, tensor in agent.windows.state_dict().items())
    picture = torch.full((3, 192, 256), 0.49)
    picture[:, ::2] = 0.53  # ground of one colour would count as blank
    picture[:, 96:104, 160:168] = torch.from_numpy(COLOURS[2] / 255).float()[:, None, None]
    record = agent.find_all(picture, "blue", how="windows", passes=16)
    assert len(record.objects) == 1
    torch.testing.assert_close(record.objects.boxes[0], torch.tensor([160.0, 96, 168, 104]), atol=4, rtol=0)
    # A part that is not used, or that a folder lacks, leaves the agent without it.
    for parts in ({"windows": fitted.part.__class__(None, None, False, "")}, {}):
        replace(Manifest.read(home / "models"), parts=parts).write(home / "models")
        assert ModelFolder(home / "models").arguments()["windows"] is None


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"windows": False}, "not fitted, since the setting `windows` is false"),
        (
            {"holdout": 4},
            "not fitted, since mosaics need at least 16 held-out photographs, and 12 of the 48 photographs are held "
            "out",
        ),
    ],
)
def test_the_evidence_is_left_out_with_a_reason(home, tmp_path, monkeypatch, settings, why):
    monkeypatch.setattr("semfov.fit.windows_part.MosaicFit", None)
    folder = folder_of(home, out=tmp_path, **settings)
    assert folder.fits["windows"].tasks == {}
    part = folder.fit("windows").part
    assert (part.file, part.used, part.why) == (None, False, why)


def test_recall_is_that_of_the_objects_of_each_photograph():
    eye, scenes = WindowEye(Tiles(name="bright", pure=True)), RedBoxes()
    mosaics = Mosaics(scenes, 2, 2, tile=(96, 72), count=3)
    opened = [StoredWindowLooks(eye, mosaics, index, None) for index in range(3)]
    shares = {}
    for index, source in enumerate(opened):
        tiles = mosaics.tiles(index)
        looks = [step.look for step in look_by_look(source, ranked(usual_slices(source.lattice)), None)]
        found = torch.stack([found_in(looks[:n], mosaics.annotation(index)) for n in range(1, len(looks) + 1)], -1)
        # When all slices were looked at, recall stays the same.
        assert len(looks) < _RECALL_PASSES[-1]
        found = torch.cat([found, found[:, -1:].expand(-1, _RECALL_PASSES[-1] - len(looks))], -1).double()
        counts = [len(scenes.annotation(tile.scene).boxes) for tile in tiles]
        for tile, part in zip(tiles, found.split(counts), strict=True):
            shares.setdefault(tile.scene, []).append(part.mean(0))
    expected = torch.stack([torch.stack(shares[photograph]).mean(0) for photograph in sorted(shares)])
    assert expected.amax() > 0
    torch.testing.assert_close(torch.from_numpy(_photograph_recalls(mosaics, opened, None)), expected)


SCENES = RedBoxes()
SIZES = {
    "few": (144, 108), "many": (288, 216), "one class": (192, 108), "photographs": (384, 216), "objects": (384, 216)
}  # fmt: skip


@pytest.mark.parametrize("kind", PICTURE_KINDS)
def test_pictures_of_a_kind_have_its_size_and_objects_and_depend_on_the_seed(kind):
    pictures = _compose_pictures(kind, SCENES, 3, 0, tile=48)
    assert len(pictures) == 3
    for index in range(3):
        assert pictures.annotation(index).size == SIZES[kind]
    assert sum(len(pictures.annotation(index).boxes) for index in range(3)) > 0
    assert pictures[0].size == SIZES[kind]
    assert _compose_pictures(kind, SCENES, 3, 1, tile=48).digest(0) != pictures.digest(0)
    assert _compose_pictures(kind, SCENES, 4, 0, tile=48).digest(0) == pictures.digest(0)


def test_objects_of_the_smallest_kinds_have_four_pixels_in_an_overview():
    """Of 416 px, in pictures of the default size."""
    pictures = _compose_pictures("objects", SCENES, 12, 0)
    told = [pictures.annotation(index).boxes for index in range(12)]
    sides = torch.cat([(boxes[:, 2:] - boxes[:, :2]).amax(-1) for boxes in told])
    assert 2 < float(sides.quantile(0.1)) * 416 / 3840 < 8


COUNT, SIZE = 30, (192, 144)


class Photographs:
    """Bright squares are annotated. A pale square of another colour is in each of them, and is not."""

    classes = ("red", "green", "blue")
    fingerprint = "squares"
    ids = tuple(range(COUNT))

    def __len__(self):
        return COUNT

    def annotation(self, index):
        kinds = torch.tensor([1 + index % 2] * (1 + index % 3))
        low = torch.tensor([[16.0 + 40 * number, 16.0] for number in range(len(kinds))])
        return Annotation(torch.cat([low, low + 32], 1), kinds, torch.zeros(len(kinds)).bool(), SIZE)

    def __getitem__(self, index):
        image, about = torch.zeros(3, SIZE[1], SIZE[0]), self.annotation(index)
        for (x1, y1, x2, y2), kind in zip(about.boxes.int().tolist(), about.labels.tolist(), strict=True):
            image[kind - 1, y1:y2, x1:x2] = 0.6 + 0.02 * (index % 11)
        image[index % 2 - 1, 96:128, 16:48] = 0.1 + 0.02 * (index % 7)
        return Scene(index, str(index), image, about.boxes, about.labels)

    def targets(self, index):
        return sorted(set(self.annotation(index).labels.tolist()))

    def digest(self, index):
        return f"{index:064x}"


@pytest.fixture(scope="module")
def fitted():
    torch.manual_seed(0)
    model = GlimpseEvidence(3).requires_grad_(False)
    eye = WindowEye(Squares().eval())
    report = fit_photographs(
        model,
        Photographs(),
        eye,
        SimpleNamespace(photographs=COUNT, window=(0.6, 2.0), surest=0.9, seed=0),
    )
    return model, eye, report


def test_frequencies_are_those_of_all_photographs(fitted):
    model, _, _ = fitted
    held = [sum(kind in Photographs().targets(index) for index in range(COUNT)) for kind in (1, 2, 3)]
    shares = torch.tensor([(number + 0.5) / (COUNT + 1) for number in held])
    torch.testing.assert_close(model.photograph.usual, shares.logit())


def test_what_was_fitted_tells_bright_squares_from_pale_ones(fitted):
    model, eye, report = fitted
    assert f"searches of {COUNT} photographs" in report
    least = float(model.photograph.at_place(torch.tensor(LEAST_CERTAINTY)).sigmoid())
    assert model.photograph.thresholds.stop_below == pytest.approx(least, abs=6e-4)
    agent, right = ZoomAgent(eye, model.eval()), []
    for index in range(COUNT):
        there = Photographs().targets(index)
        for kind in (1, 2, 3):
            decision = agent.search(Photographs()[index].image, kind).decision
            right.append((decision.outcome == "found") == (kind in there))
            assert 0 <= decision.probability <= 1
    assert sum(right) >= 0.95 * len(right)


def test_as_many_objects_are_expected_as_are_right(fitted):
    """A regression with an offset gives in the mean what it was fitted to: objects of the whole, and with slices."""
    model, eye, _ = fitted
    agent, expected, right = ZoomAgent(eye, model.eval()), 0.0, 0
    for index in range(COUNT):
        for passes in (1, 5):
            record = agent.find_all(Photographs()[index].image, settings=FindSettings(passes=passes))
            assert record.passes == passes
            assert record.unseen == (0.0, 0.0)
            expected += float(record.candidates.scores.sum())
            right += int((right_boxes(record.candidates, Photographs().annotation(index)) > 0).sum())
    assert expected == pytest.approx(right, abs=1.5)


def test_the_spread_is_that_of_photographs_that_were_left_out(fitted):
    """Squares are found or missed as a whole. Ten numbers are too few for less than the usual spread."""
    model, _, report = fitted
    rows = [line.split("|")[1:-1] for line in report.splitlines() if line.startswith("| fold")]
    assert len(rows) == 10
    spread = model.photograph.certainty.spread
    assert f"most frequent class of a picture: {spread:.2f}." in report
    assert sum(float(row[3]) for row in rows) >= 0.8 * len(rows)
    assert spread == pytest.approx(SPREAD) or sum(float(row[4]) for row in rows) < 0.8 * len(rows)


def test_a_photograph_without_objects_has_no_most_frequent_class():
    empty = Annotation(torch.zeros(0, 4), torch.zeros(0).long(), torch.zeros(0).bool(), SIZE)
    eye = WindowEye(Squares().eval())
    source = LiveWindowLooks(eye, eye.open(Photographs()[0].image))
    told = [*_explored(source.see([Window.overview(source.lattice)]), source.lattice, empty)]
    assert [(each.target, each.held) for each in told] == [(None, 0)]


def test_places_are_fitted_near_the_certainty_of_objects():
    """The regression of scipy's minimiser, with a normal prior around the identity."""
    torch.manual_seed(0)
    certainty = torch.rand(80) * 0.9 + 0.05
    right = torch.rand(80) < (0.6 * certainty.logit() + 1).sigmoid()
    searches = [SimpleNamespace(spare=False, places=[*zip(certainty[:50].tolist(), right[:50].tolist(), strict=True)])]
    searches += [SimpleNamespace(spare=False, places=[*zip(certainty[50:].tolist(), right[50:].tolist(), strict=True)])]
    searches += [SimpleNamespace(spare=True, places=[(0.9, False)] * 50)]  # for thresholds alone
    evidence = PhotographEvidence(3).requires_grad_(False)
    _fit_places(evidence, searches)
    x, y = certainty.double().logit().numpy(), right.double().numpy()

    def loss(coefficients):
        offset, slope = coefficients
        z = offset + slope * x
        return (np.logaddexp(0, z) - y * z).sum() + offset**2 / 2 + 10 * (slope - 1) ** 2

    expected = minimize(loss, [0.0, 1.0], tol=1e-10).x
    found = [float(evidence.place.bias), float(evidence.place.weight)]
    assert found == pytest.approx(expected.tolist(), abs=1e-4)
    _fit_places(evidence, [])
    assert [float(evidence.place.bias), float(evidence.place.weight)] == [0.0, 1.0]

"""`python -m train.fit_zoom`: small on the embedded scenes, and its examples from a store."""

import json
import math
from dataclasses import replace

import pytest
import torch

from semfov.agents.episode import EpisodeLimits
from semfov.agents.windows import WindowEpisode
from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification
from semfov.data import Annotation, EmbeddedScenes, Scene
from semfov.data.mosaics import Mosaics
from semfov.decision import MOST_CLOSER
from semfov.fit.verification import _unverified, verify
from semfov.fit.windows import _fit_closer, _mosaic_searches
from semfov.fit.windows_evidence import ZoomExample
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.matching import box_iou
from semfov.runs.config import DataConfig
from semfov.runs.zoom_store import GlanceStore, StoredGlances
from semfov.zoom import GlimpseEvidence, Lattice, WindowEye
from tests.small import Coloured, Tiles
from train.fit_fom import FitFomConfig, fit_fom
from train.fit_zoom import fit_zoom
from train.mosaic_samples import MosaicSampler
from train.zoom_pictures import FitZoomConfig


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
    recalls, passes = tables_of_choices((tmp_path / "out" / "report.md").read_text())
    most = [max(*values, 1e-9) for values in zip(*recalls.values(), strict=True)]
    assert len(most) == 3
    best = max(recalls, key=lambda value: sum(recall / high for recall, high in zip(recalls[value], most, strict=True)))
    assert model.survey.foresight == best
    assert model.patience == min(passes, key=passes.get)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    # Only one part is fitted again.
    fit_zoom(replace(config, evidence=path, refit=("survey",), survey_steps=2, out=tmp_path / "again"))
    other = GlimpseEvidence.from_pretrained(tmp_path / "again" / "bright.safetensors")
    changed = {name for name, tensor in other.state_dict().items() if not torch.equal(before[name], tensor)}
    assert changed
    assert all(name.startswith("survey.") for name in changed)
    assert other.metadata["survey"]["seed"] == config.seed
    fit_zoom(replace(config, evidence=path, refit=("spread",), out=tmp_path / "spread"))
    other = GlimpseEvidence.from_pretrained(tmp_path / "spread" / "bright.safetensors")
    assert replace(other.certainty, spread=model.certainty.spread) == model.certainty
    assert all(torch.equal(before[name], tensor) for name, tensor in other.state_dict().items())
    # A fit with the same seed gives the same model.
    fit_zoom(config)
    again = GlimpseEvidence.from_pretrained(tmp_path / "out" / "bright.safetensors")
    assert all(torch.equal(before[name], tensor) for name, tensor in again.state_dict().items())


def tables_of_choices(report):
    """Recalls by foresight and numbers of passes by patience, from the tables of a report."""
    tables = {}
    for line in report.splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if cells and cells[0] in ("foresight", "patience"):
            rows = tables[cells[0]] = {}
        elif cells and cells[0].replace(".", "").isdigit():
            rows[cells[0]] = cells[1:]
        elif cells and "-" not in cells[0]:
            rows = {}
    recalls = {float(value): tuple(map(float, row)) for value, row in tables["foresight"].items()}
    return recalls, {float(value): float(row[0]) for value, row in tables["patience"].items()}


def test_examples_do_not_depend_on_the_store(tmp_path):
    eye = WindowEye(Tiles(name="bright"))
    mosaics = Mosaics(EmbeddedScenes(("person", "cat", "cup"), count=3), 2, 2, tile=(96, 72), count=1)
    store = GlanceStore(tmp_path, eye.settings(), 3)
    glances = StoredGlances(eye, mosaics, 0, store)
    example = ZoomExample.of(mosaics, 0, glances)
    glances.save()
    assert sum(look.window.within is not None for look in example.looks) == 4
    eye.detector.propose = None  # any new look would fail
    same = ZoomExample.of(mosaics, 0, StoredGlances(eye, mosaics, 0, store))
    assert torch.equal(same.labels, example.labels)
    for one, other in zip(example.looks, same.looks, strict=True):
        assert one.window == other.window
        assert torch.equal(one.found, other.found)
        assert (one.gist is None) == (other.gist is None)
        if one.gist is not None:
            assert torch.equal(other.gist.scores, one.gist.scores)
            assert torch.equal(other.gist.found, one.gist.found)


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


class Squares:
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
def test_the_verification_is_fitted_to_closer_looks_at_mosaics():
    eye, scenes = WindowEye(Coloured(("red", "green", "blue"), (64, 64), fill=0.0)), Squares()
    opened = [StoredGlances(eye, scenes, n, None) for n in range(len(scenes))]
    torch.manual_seed(0)
    model = GlimpseEvidence(3, 8, thresholds=Thresholds(0.3, 0.01)).eval().requires_grad_(False)
    config = FitZoomConfig(sought=3, passes=8, place=0.1, false_alarms=0.5)
    searches = list(_mosaic_searches(model, scenes, opened, config, "test"))
    names = "background", *scenes.classes
    for sought in searches:
        assert sought.present == (sought.target in scenes.annotation(sought.picture).labels.tolist())
        # Looks and end are those of the agent.
        path = WindowEpisode(names, model, sought.target, limits=EpisodeLimits(8)).open(sought.looks).run()
        found, count = _unverified(sought, model.thresholds)
        assert (found is not None, count) == (path.decision.outcome == "found", path.passes)
        assert [glance.window for glance in sought.glances[:count]] == [each.window for each in path.glances]
        if found is not None:
            boxes = scenes.annotation(sought.picture).boxes[scenes.annotation(sought.picture).labels == sought.target]
            assert found == any(float(box_iou(path.decision.box[None], box[None])) >= 0.5 for box in boxes)
    kinds = "searched", "judged"
    text = _fit_closer(model, {kind: [(scenes, opened)] for kind in kinds}, config)
    fitted = model.verification.thresholds
    assert (fitted.place, fitted.give_up) == (0.1, 0.01)
    assert f"| {fitted.confirm:.2f} (chosen)" in text
    # The searches from which the threshold was chosen end as those of the agent.
    ends = []
    limits = Thresholds(1.0, model.thresholds.give_up, config.place)
    again = verify(searches, [model.verification], limits, model.thresholds)
    for sought, each in zip(searches, again, strict=True):
        episode = WindowEpisode(names, model, sought.target, limits=EpisodeLimits(8), closer=MOST_CLOSER)
        path = episode.open(sought.looks).run()
        right, count = each.found(fitted.confirm)
        assert (right is not None, count) == (path.decision.outcome == "found", path.passes)
        assert right is None or right == sought.right(path.decision.box)
        ends.append((right, sought.present))
    assert len({right for right, _ in ends}) > 1
    absent = [right for right, present in ends if not present]
    assert sum(right is not None for right in absent) <= 0.5 * len(absent)


def test_without_right_and_wrong_places_there_is_no_verification():
    model = GlimpseEvidence(3, 8, thresholds=Thresholds(0.3, 0.01), verification=Verification()).eval()
    kinds = "searched", "judged"
    text = _fit_closer(model, {kind: [(Squares(), ())] for kind in kinds}, FitZoomConfig(passes=8))
    assert text.startswith("None, since there are no places")
    assert model.verification is None

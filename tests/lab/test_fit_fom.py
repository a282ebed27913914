"""`python -m train.fit_fom` as a user runs it: small, on the embedded scenes, with the real detector."""

import json
from dataclasses import fields

import pytest
import torch

from eval.calibration import main as calibrate
from semfov.metrics.calibration import Calibration
from semfov.observation import FovealObservationModel, match
from semfov.runs.config import DataConfig
from semfov.runs.seeds import generator_for
from tests.refusals import refused
from train.fit_fom import FitFomConfig, _judgement, fit_fom, main
from train.samples import Sampler

pytestmark = pytest.mark.slow

SMALL = ["--data.limit", "6", "--fixations", "2", "--holdout", "3", "--shard", "2", "--method", "newton", "--workers"]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A model fitted to two looks at each of 6 embedded scenes, in three shards."""
    out = tmp_path_factory.mktemp("fit")
    assert main([*SMALL, "1", "--out", str(out)]) == 0
    return out


def test_fit_writes_a_model_and_a_report(fitted):
    model = FovealObservationModel.from_pretrained(fitted / "yolox-nano.safetensors")
    counts = torch.tensor(model.metadata["counts"])
    assert counts.shape == (81, 8)
    assert counts.sum() == model.metadata["samples"] > 30
    person, boat = model.classes.index("person") + 1, model.classes.index("boat") + 1
    assert counts[person].sum() > 0
    assert counts[boat].sum() > 0
    report = (fitted / "report.md").read_text()
    for word in ("raw scores", "Dirichlet, fixed_point", "with levels"):
        assert word in report
    assert json.loads((fitted / "manifest.json").read_text())["model"]["method"] == "newton"
    assert (fitted / "reliability.png").stat().st_size > 3000


def test_the_report_says_when_raw_scores_are_better(fitted):
    worse, better = (Calibration(*[value] * len(fields(Calibration))) for value in (0.341, 0.285))
    config = FitFomConfig()
    said = _judgement(config, {"raw scores": better, "discriminative": worse})
    assert said.startswith("**Raw scores are better on held-out photographs**: the model has Brier 0.341")
    assert _judgement(config, {"raw scores": worse, "discriminative": better}).startswith("The model is better")
    assert "better" in (fitted / "report.md").read_text().partition("on held-out photographs")[0]


def test_estimators_agree(fitted):
    rows = [line for line in (fitted / "report.md").read_text().splitlines() if line.startswith("| Dirichlet, ")]
    figures = [[float(cell) for cell in row.split("|")[2:-1]] for row in rows]
    assert len(figures) == 3
    # The last digit may be rounded either way.
    assert figures[1] == pytest.approx(figures[0], rel=1e-4, abs=1.1e-3)
    assert figures[2] == pytest.approx(figures[0], rel=1e-4, abs=1.1e-3)


def test_the_discriminative_fit_has_a_lower_loss_than_the_published_one(fitted, tmp_path):
    data = DataConfig(limit=6, min_instances=0, max_target_area=None)
    fit_fom(FitFomConfig(data=data, fixations=2, holdout=3, shard=2, out=tmp_path, cache=fitted, workers=1))
    figures = json.loads((tmp_path / "manifest.json").read_text())["held_out"]
    # No comparison with raw scores: a hundred detections of four scenes are too few for it.
    assert figures["discriminative"]["nll"] < figures["Dirichlet, newton"]["nll"] / 2


def test_the_fit_through_the_belief_goes_on_from_the_discriminative_one(fitted, tmp_path):
    """The looks of the other fits are enough; α stays, and searches of held-out scenes have a reported loss."""
    data = DataConfig(limit=6, min_instances=0, max_target_area=None)
    models = {}
    for method in ("discriminative", "search"):
        out = tmp_path / method
        fit_fom(
            FitFomConfig(
                data=data, fixations=2, holdout=3, shard=2, out=out, cache=fitted, workers=1, method=method, steps=3
            )
        )
        models[method] = FovealObservationModel.from_pretrained(out / "yolox-nano.safetensors")
    before, after = models["discriminative"], models["search"]
    assert torch.equal(before.log_alpha, after.log_alpha)
    assert before.log_miss is None
    assert after.log_miss is not None
    assert 0 < float(after.refutation.detach()) <= 1
    assert not torch.equal(after.log_exponents, before.log_exponents)
    assert after.metadata["search"]["photographs"] >= 1
    assert "target's share of the belief" in (tmp_path / "search" / "report.md").read_text()
    refused("method", lambda: fit_fom(FitFomConfig(data=data, mosaics=1, method="search", out=tmp_path)))


def test_the_published_fit_uses_all_detections_however_few_are_in_memory(fitted, tmp_path):
    assert main([*SMALL, "1", "--out", str(tmp_path), "--cache", str(fitted), "--most", "40"]) == 0
    whole, drawn = (FovealObservationModel.from_pretrained(at / "yolox-nano.safetensors") for at in (fitted, tmp_path))
    for name, value in whole.state_dict().items():
        assert torch.equal(value, drawn.state_dict()[name]), name
    judged = [
        json.loads((at / "manifest.json").read_text())["held_out"]["raw scores"]["count"] for at in (fitted, tmp_path)
    ]
    assert 0 < judged[1] < judged[0] / 2


def test_detections_are_drawn_evenly(fitted):
    config = FitFomConfig(data=DataConfig(limit=6, min_instances=0, max_target_area=None), fixations=2, shard=2)
    sampler = Sampler(config, fitted / "samples")
    every = sampler.all()
    assert torch.equal(sampler.drawn(len(every)).scores, every.scores)
    some = sampler.drawn(len(every) // 2)
    assert torch.equal(sampler.drawn(len(every) // 2).boxes, some.boxes)
    assert torch.equal(some.scenes, every.scenes)
    # The number is binomial: within five standard deviations of its mean.
    assert abs(len(some) - len(every) / 2) < 5 * (len(every) / 4) ** 0.5
    places = [(each.scene.double().mul(1e4).add(each.boxes[:, 0].double())).tolist() for each in (some, every)]
    assert set(places[0]) < set(places[1])


def test_the_calibration_command_writes_a_report(fitted, tmp_path, capsys):
    model = fitted / "yolox-nano.safetensors"
    arguments = ["--data.limit", "3", "--fixations", "2", "--model", str(model), "--out", str(tmp_path)]
    assert calibrate([*arguments, "--beliefs", "false", "--workers", "1"]) == 0
    assert "classwise ECE" in capsys.readouterr().out
    assert (tmp_path / "reliability.png").exists()
    rows = [line.split("|") for line in (tmp_path / "calibration.md").read_text().splitlines()[2:]]
    counts = [int(row[3]) for row in rows if row[2].strip() == "raw"]
    assert len(counts) == 9
    assert sum(counts[:-1]) == counts[-1]
    assert not list(tmp_path.glob("beliefs*"))
    assert not (tmp_path / "parts").exists()


def test_samples_match_looks_at_random_fixations(tmp_path):
    sampler = Sampler(FitFomConfig(data=DataConfig(limit=2), fixations=2), tmp_path)
    samples = sampler.sample(0)
    scene = sampler.scenes[1]
    mine = samples[samples.scene == 1]
    first = (
        torch.rand(2, 2, generator=generator_for("fixations", 0, scene.id))[0] * torch.tensor([scene.size]).float()
        - 0.5
    )
    seen = sampler.eye(scene.image[None], first)
    count = int(seen.count)
    torch.testing.assert_close(mine.scores[:count], seen.scores[0])
    expected = match(seen.boxes[0], scene.boxes, scene.labels)
    assert torch.equal(mine.labels[:count], expected)
    centre = (seen.boxes[0, :, :2] + seen.boxes[0, :, 2:]) / 2 - 0.5
    torch.testing.assert_close(mine.distance[:count], (centre - first).norm(dim=1) / max(scene.size))

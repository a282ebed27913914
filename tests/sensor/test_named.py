"""Sensors by name: whatever is registered can be selected by commands, and fitted models know it."""

import json
import re
from typing import get_args

import pytest
import torch

from eval.comparison.settings import sensor_settings
from eval.explore.run import ExploreConfig, ExploreRun
from eval.search import main as search
from semfov import ActivePerception, FovealObservationModel, InputError, Scanpath
from semfov.cli.main import main as command
from semfov.model_folder import ModelFolder
from semfov.runs.command import run_command
from semfov.runs.config import DataConfig, DetectorConfig, SensorConfig
from semfov.sensor import SENSORS, LogPolar, Sensor, named_sensor
from semfov.sensor.named import SensorName, _NamedSensor, sensor_of
from tests.colours import write_home
from tests.refusals import refused
from tests.small import once, run_settings
from train.fit_fom import main as fit_fom


class Dimmed(Sensor):
    """A sensor of a further kind, which dims the picture."""

    kind = "dimmed"
    names = ("share",)

    def __init__(self, share):
        super().__init__()
        self.share = share

    def open(self, canvas, scale):
        return canvas

    def look(self, state, gaze):
        return self.share * state.expand(len(gaze), -1, -1, -1)

    def settings(self):
        return {"kind": self.kind, "share": self.share}


@pytest.mark.parametrize("name", SENSORS)
def test_a_named_sensor_is_made_again_from_its_settings(name):
    config, sensor = SensorConfig(name), named_sensor(name)
    assert type(sensor) is config.kind is type(sensor_of(sensor.settings()))
    assert sensor_of(sensor.settings()).settings() == config.make().settings() == sensor.settings()
    assert sensor_settings(json.loads(json.dumps(config.record()))).make().settings() == sensor.settings()
    assert config.fovea == config.kind.width(SENSORS[name].settings) / 640
    assert config.kind.describe(sensor.settings())


def test_every_name_can_be_given_in_settings():
    assert set(get_args(SensorName)) == set(SENSORS)


def test_settings_of_a_sensor_are_given_by_their_names(capsys):
    made = []
    arguments = ["--name", "log-polar", "--settings.fovea", "40", "--settings.pooling", "2"]
    assert run_command(lambda config: made.append(config), SensorConfig, "Sensors.", arguments) == 0
    (config,) = made
    assert config.make().settings() == {"kind": "log-polar", "fovea": 40.0, "spacing": 1.0, "pooling": 2.0}
    assert config.fovea == 40 / 640
    assert sensor_settings(config.record()) == SensorConfig("log-polar", settings=config.whole())
    for given, name in (({"sigma": 50.0}, "sigma"), ({"levels": 3}, "levels"), ({"settings": {"width": 1.0}}, "width")):
        with pytest.raises(InputError, match=rf"settings of a LogPolar \(fovea, spacing, pooling\), got {name}"):
            SensorConfig("log-polar", **given).make()
    refused("fovea: expected a positive number", SensorConfig("log-polar", settings={"fovea": -1.0}).make)
    refused(r"sensor.fovea: expected a setting of a LogPolar, got none", LogPolar.from_settings, {})


def test_a_further_sensor_needs_one_registration(monkeypatch):
    monkeypatch.setitem(SENSORS, "dimmed", _NamedSensor(Dimmed, {"share": 0.5}))
    config = SensorConfig("dimmed", settings={"share": 0.25})
    assert sensor_of(config.make().settings()).share == 0.25
    assert Dimmed.describe(config.make().settings()) == "share 0.25"
    monkeypatch.undo()
    refused(r"the settings of a Foveation or a .*, got \{'kind': 'dimmed'", sensor_of, {"kind": "dimmed", "share": 0.5})


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with a network and photographs of coloured squares."""
    return write_home(tmp_path_factory.mktemp("log_polar"), 8)


def test_a_registered_sensor_without_a_fovea_runs_in_a_study(home, tmp_path, monkeypatch):
    monkeypatch.setitem(SENSORS, "dimmed", _NamedSensor(Dimmed, {"share": 0.5}))
    data = DataConfig(home / "photographs", home / "photographs" / "instances.json", limit=1, min_instances=0)
    names = ("random-raw", "closer-look-raw")
    settings = run_settings(tmp_path, starts=1, shifts=2) | {"data": data, "policies": names}
    detector = DetectorConfig(str(home / "colours.onnx"))
    records, _ = ExploreRun(ExploreConfig(detector=detector, sensor=SensorConfig("dimmed"), **settings)).outcomes(0)
    assert {record["policy"] for record in records} >= set(names)


def given(home, out, *more):
    photographs = home / "photographs"
    return once([
        "--data.root", str(photographs), "--data.annotations", str(photographs / "instances.json"),
        "--sensor.name", "log-polar", "--out", str(home / out), "--cache", str(home / "cache"), "--workers", "1", *more,
    ])  # fmt: skip


def searching(home, out, policies, *more):
    few = ["--data.min_instances", "0", "--data.limit", "2", "--belief.columns", "3", "--belief.rows", "2"]
    few += ["--protocol.starts", "1", "--protocol.shifts", "2", "--scanpaths", "0"]
    network = ["--detector.name", str(home / "colours.onnx")]
    return given(home, out, *network, *few, "--policies", json.dumps(policies), *more)


def test_searches_run_with_policies_that_need_no_fitted_model(home, capsys):
    assert search(searching(home, "search", ["random", "non-predictive-raw", "vocus2"], "--scanpaths", "1")) == 0
    assert "colours, log-polar fovea (fovea 60, spacing 1, pooling 1)" in capsys.readouterr().out
    manifest = json.loads((home / "search/manifest.json").read_text())
    assert manifest["eye"]["sensor"]["kind"] == "log-polar"


@pytest.mark.parametrize("policy", ["recommended", "predictive-calibrated"])
def test_policies_that_need_a_model_say_that_none_is_shipped(home, policy, capsys):
    assert search(searching(home, "refused", [policy])) == 1
    error = capsys.readouterr().err
    assert re.match(r"error: sensor: expected a Foveation, since models are shipped for no other sensor, got L", error)
    assert "semfov fit" in error


def test_an_observation_model_is_fitted_and_used(home):
    network = ["--detector.name", str(home / "colours.onnx")]
    assert fit_fom(given(home, "fom", *network, "--fixations", "3", "--levels", "3", "--holdout", "4")) == 0
    model = FovealObservationModel.from_pretrained(home / "fom/colours.safetensors")
    assert model.metadata["sensor"]["kind"] == "log-polar"
    assert model.edges.tolist() == pytest.approx([0.5 * 60 / 640, 60 / 640])
    chosen = "--belief.model", str(home / "fom/colours.safetensors")
    assert search(searching(home, "calibrated", ["predictive-calibrated"], *chosen)) == 0


def test_the_levels_of_a_multi_scale_fovea_are_its_scales(home):
    network = ["--detector.name", str(home / "colours.onnx")]
    crops = ["--sensor.name", "multi-scale", "--sensor.settings.side", "64", "--sensor.settings.scales", "3"]
    assert fit_fom(given(home, "scales", *network, *crops, "--fixations", "2", "--holdout", "4")) == 0
    model = FovealObservationModel.from_pretrained(home / "scales/colours.safetensors")
    assert model.metadata["sensor"] == {"kind": "multi-scale", "side": 64, "scales": 3, "reference": 640}
    assert model.edges.tolist() == pytest.approx([32 / 640, 64 / 640, 128 / 640])
    chosen = "--belief.model", str(home / "scales/colours.safetensors")
    assert search(searching(home, "by_scales", ["predictive-calibrated"], *crops, *chosen)) == 0


def test_a_folder_of_models_keeps_its_sensor(home, tmp_path):
    small = ["--columns", "3", "--rows", "2", "--holdout", "2", "--steps", "4", "--fixations", "3"]
    arguments = given(home, "models", *small, "--judged", "2", "--sensor.settings.fovea", "80")
    assert command(["fit", str(home / "colours.onnx"), *arguments]) == 0
    folder = ModelFolder(home / "models")
    assert folder.manifest.sensor == {"name": "log-polar", "fovea": 80, "spacing": 1, "pooling": 1, "reference": 640}
    agent = ActivePerception.from_pretrained(home / "models")
    assert isinstance(agent.eye.sensor, LogPolar)
    image = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0))
    path = agent.search(image, "red", start=0, shifts=2)
    path.save(tmp_path / "path.safetensors")
    kept = Scanpath.load(tmp_path / "path.safetensors")
    seen, again = path.stimulus.views(path.fixations), kept.stimulus.views(kept.fixations)
    assert all(torch.equal(a, b) for a, b in zip(seen, again, strict=True))
    data = given(home, "again", "--data.min_instances", "0", "--data.limit", "2", "--models", str(home / "models"))
    assert search([*data, "--protocol.shifts", "2", "--scanpaths", "0", "--policies", '["recommended"]']) == 0
    assert json.loads((home / "again/manifest.json").read_text())["eye"]["sensor"]["fovea"] == 80

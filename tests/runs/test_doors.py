"""Invalid values are refused before any work, with one line that names the argument and its range."""

import dataclasses

import pytest
import torch
import yaml

from semfov import Selection
from semfov.fit.settings import FitDetectorConfig
from semfov.io.ranges import Range, check_settings
from semfov.runs import config as settings
from semfov.runs.command import run_command
from tests import small
from tests.refusals import refused


@pytest.fixture
def agent():
    return small.agent(small.Fixed(), grid=(4, 3), sigma=10.0, reference=64.0)


IMAGE = torch.rand(3, 40, 50, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("image", [IMAGE * 255, IMAGE - 0.5, IMAGE.masked_fill(IMAGE > 0.99, torch.nan)])
def test_invalid_images_are_refused_by_the_detector_and_the_eye(agent, image):
    for look in (lambda: agent.eye.detector(image[None]), lambda: agent.eye.open(image[None])):
        refused(r"^images: expected RGB in \[0, 1\]", look)


def test_invalid_selections_and_strides_are_refused(agent):
    for wrong in [{"threshold": 2}, {"threshold": float("nan")}, {"iou": -0.1}, {"limit": -1}]:
        refused(f"^{next(iter(wrong))}: expected a (whole )?number from 0 to ", Selection, **wrong)
    for stride in ["auto", 0, -32, 1.5, True]:
        refused(r"^stride: expected a whole number from 1", small.Fixed, stride=stride)
    agent.eye.open(IMAGE[None].clamp(0, 1) * (1 + 2e-7))


def test_unused_settings_are_no_options_and_are_not_written(capsys):
    config = FitDetectorConfig(holdout=3)
    assert "name" in config.unused
    written = yaml.safe_load(config.yaml())
    assert written.keys() == {field.name for field in dataclasses.fields(config)} - {"name"}
    assert (written["holdout"], written["out"], written["data"]["min_instances"]) == (3, "mymodels", 0)
    with pytest.raises(SystemExit):
        run_command(print, FitDetectorConfig, "", ["--name", "mine"])
    assert "unknown option --name" in capsys.readouterr().err


CONFIGS = [value for value in vars(settings).values() if dataclasses.is_dataclass(value) and isinstance(value, type)]


def ranges():
    """Every setting with a range: its class, name, type and range."""
    from typing import Annotated, get_args, get_origin, get_type_hints

    for config in CONFIGS:
        for name, hint in get_type_hints(config, include_extras=True).items():
            for option in (hint, *get_args(hint)):
                if get_origin(option) is Annotated:
                    base, allowed = get_args(option)[:2]
                    if isinstance(allowed, Range):
                        yield config, name, base, allowed


@pytest.mark.parametrize(("config", "name", "base", "allowed"), list(ranges()), ids=str)
def test_settings_out_of_their_range_are_refused_by_name(config, name, base, allowed):
    required = {"policy": "random"} if config is settings.PolicyConfig else {}
    wrong = [allowed.high + 1, float("nan"), float("inf"), True, [1]]
    wrong.append(allowed.low - 1 if allowed.above is None else allowed.above)
    wrong += [1.5] if base is int else []
    for value in wrong:
        refused(f"^{name}: expected a (whole )?number ", config, **required, **{name: value})
        refused(f"^before.{name}: expected ", check_settings, config, {name: value}, "before.")
    config(**required, **{name: base(allowed.high)})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--protocol.shifts", "-1"], "protocol.shifts: expected a whole number from 0 to 10,000, got -1"),
        (["--sensor.sigma", "0"], "sensor.sigma: expected a number above 0"),
        (["--workers", "0"], "workers: expected a whole number from 1 to 1,024, got 0"),
        (
            ["--data.root", "nosuch", "--data.annotations", "no.json"],
            "data.root: no such folder: nosuch; check the path",
        ),
        (["--data.root", "tests", "--data.annotations", "no.json"], "data.annotations: no such file: no.json; check"),
        (["--data.root", "tests"], "data: expected both data.root and data.annotations"),
        (["--detector.name", "yolo"], "unknown detector 'yolo'; did you mean 'yolov3'"),
        (["--detector.name", "nosuch.onnx"], "detector: no such file: nosuch.onnx; check the path"),
    ],
)
def test_invalid_command_lines_are_refused_before_any_work(arguments, message, capsys, tmp_path):
    from eval.search import main

    assert main([*arguments, "--out", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"error: {message}")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir()), "nothing is written"

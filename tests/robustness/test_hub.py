"""`hubconf.py` as `torch.hub` loads it."""

import importlib.util
from pathlib import Path

import pytest
import torch

import semfov

ROOT = str(Path(__file__).parents[2])


def load(name, **options):
    return torch.hub.load(ROOT, name, source="local", **options)


def test_entry_points_are_listed_and_explained():
    names = torch.hub.list(ROOT, source="local") if "source" in torch.hub.list.__code__.co_varnames else None
    spec = importlib.util.spec_from_file_location("hubconf", Path(ROOT, "hubconf.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    entries = {n for n, thing in vars(module).items() if callable(thing) and not n.startswith("_") and n != "Any"}
    assert entries == {
        "foveation", "yolov3_tiny_agent", "yolov3_tiny_detector", "yolov3_tiny_eye", "yolov3_tiny_observation",
    }  # fmt: skip
    assert names is None or entries <= set(names)
    for name in entries:
        assert getattr(module, name).__doc__
    for package in module.dependencies:
        assert importlib.util.find_spec(package) is not None


def test_parts_without_weights():
    sensor = load("foveation", sigma=20.0, levels=3)
    image = torch.rand(1, 3, 40, 40)
    expected = semfov.foveate(image, torch.tensor([8.0, 9.0]), sigma=20.0, levels=3)
    torch.testing.assert_close(sensor(image, torch.tensor([8.0, 9.0])), expected)
    assert load("yolov3_tiny_observation").classes[0] == "person"


@pytest.mark.weights
def test_agent_sees_and_searches():
    scene = semfov.EmbeddedScenes(("person", "cat", "cup", "motorcycle"), count=1)[0]
    eye = load("yolov3_tiny_eye")
    with torch.inference_mode():
        seen = eye(scene.image[None], torch.tensor([[320.0, 240.0]]))
        agent = load("yolov3_tiny_agent", policy="predictive", calibrated=True, columns=4, rows=3)
        path = agent.search(scene.image, "cat", shifts=2)
    assert seen.scores.shape[-1] == 81
    assert 1 <= len(path) <= 3

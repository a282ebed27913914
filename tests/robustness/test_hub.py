"""`hubconf.py` as `torch.hub` loads it."""

import importlib.util
from pathlib import Path

import pytest
import torch

import semfov
from semfov import observers

ROOT = str(Path(__file__).parents[2])


def load(name, **options):
    return torch.hub.load(ROOT, name, source="local", **options)


def test_entry_points_are_listed_and_have_docstrings():
    names = torch.hub.list(ROOT, source="local") if "source" in torch.hub.list.__code__.co_varnames else None
    spec = importlib.util.spec_from_file_location("hubconf", Path(ROOT, "hubconf.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    entries = {n for n, value in vars(module).items() if callable(value) and not n.startswith("_") and n != "Any"}
    assert entries == {
        "foveation", "agent", "detector", "eye", "observation",
    }  # fmt: skip
    assert names is None or entries <= set(names)
    for name in entries:
        assert getattr(module, name).__doc__
    for package in module.dependencies:
        assert importlib.util.find_spec(package) is not None


def test_sensor_and_observation_model_load_without_detector_weights():
    sensor = load("foveation", sigma=20.0, levels=3)
    image = torch.rand(1, 3, 40, 40)
    expected = semfov.foveate(image, torch.tensor([8.0, 9.0]), sigma=20.0, levels=3)
    torch.testing.assert_close(sensor(image, torch.tensor([8.0, 9.0])), expected)
    assert load("observation").classes[0] == "person"


AGENTS = {
    "recommended": ({"grid": (6, 5)}, observers.SemanticSearch, "non-predictive", "closer-look"),
    "published": ({"search": "predictive"}, observers.Semantic, "predictive", "kl"),
    "raw": ({"sensor": "published-narrow"}, observers.Semantic, "non-predictive", "random"),
}


@pytest.mark.parametrize("kind", AGENTS)
def test_agents_are_those_of_the_package(kind):
    options, observer, search, explore = AGENTS[kind]
    agent = load("agent", kind=kind, **options)
    assert type(agent.searching.observer) is observer
    assert agent.searching.policy.name == search
    assert type(agent.exploring.observer) is (observers.SemanticMap if kind == "recommended" else observers.Semantic)
    assert agent.exploring.policy.name == explore
    assert (agent.columns, agent.rows) == options.get("grid", (10, 10))


def test_the_recommended_agent_is_the_default():
    assert type(load("agent").searching.observer) is observers.SemanticSearch
    kinds = "recommended, published, raw"
    with pytest.raises(semfov.InputError, match=f"kind: expected {kinds}, got 'best'"):
        load("agent", kind="best")

"""Policies and saliency of a run, and the key under which its outcomes are stored."""

from dataclasses import replace

import pytest
import torch

from eval.comparison.settings import SaliencyConfig
from eval.explore.run import ExploreConfig, ExploreRun
from eval.search.run import SearchConfig, SearchRun
from semfov.runs.config import DataConfig, PolicyConfig, ProtocolConfig
from tests.refusals import refused
from tests.small import run_settings

pytestmark = pytest.mark.weights

GUIDED = PolicyConfig("predictive", saliency="vocus2")


@pytest.fixture
def config(tmp_path):
    return SearchConfig(**run_settings(tmp_path), policies=("random",))


def test_policies_of_a_run_are_named_by_their_labels(config):
    central = PolicyConfig("non-predictive", tempering=0.25, footprint="box_centre")
    run = SearchRun(replace(config, policies=("random", central, "recommended")))
    assert run.policies == {
        "random": PolicyConfig("random"),
        "non-predictive-raw, tempering 0.25, footprint box_centre": central,
        "target-evidence": PolicyConfig("target-evidence"),
    }
    assert list(run.strategies) == list(run.policies)
    assert run.candidate("target-evidence", 0).strategy is run.strategies["target-evidence"]
    refused("did you mean 'random'", run.candidate, "randm", 0)


def test_a_run_has_one_store_for_each_saliency_model(config):
    calibrated, sought = replace(GUIDED, scores="calibrated"), PolicyConfig("target-evidence", saliency="itti-koch")
    run = SearchRun(replace(config, policies=("vocus2", "random", GUIDED, sought, calibrated)))
    assert list(run.saliency_stores) == ["vocus2", "itti-koch"]
    explored = ExploreConfig(data=config.data, belief=config.belief, cache=config.cache, out=config.out)
    alike = ExploreRun(replace(explored, policies=("vocus2-raw", "vocus2-calibrated")))
    assert list(alike.saliency_stores) == ["vocus2"]
    mild = PolicyConfig("closer-look", tempering=0.5)
    assert ExploreRun(replace(explored, policies=("kl-raw", mild))).saliency_stores == {}


def test_saliency_guides_a_policy_alone_or_beside_another(config):
    run = SearchRun(replace(config, policies=("vocus2", GUIDED, "random"), saliency=SaliencyConfig(weight=0.3)))
    alone, beside, none = (run.candidate(name, 0) for name in run.policies)
    assert beside.weight == 0.3
    assert torch.equal(alone.saliency, run.saliency("vocus2", 0))
    assert torch.equal(beside.saliency, alone.saliency)
    assert none.saliency is None


@pytest.mark.slow
def test_the_key_changes_only_with_settings_that_affect_outcomes(config):
    key = SearchRun(config).key
    for same in (
        {"workers": 3},
        {"store": False},
        {"scanpaths": 0},
        {"policies": (PolicyConfig("random"),)},
        {"protocol": replace(config.protocol, batch=2)},
    ):
        assert SearchRun(replace(config, **same)).key == key
    others = [
        {"policies": ("random", "target-evidence")},
        {"policies": (PolicyConfig("random", tempering=0.25),)},
        {"policies": ("vocus2",)},
        {"policies": ("vocus2",), "saliency": SaliencyConfig(reduction="mean")},
        {"policies": ("vocus2",), "saliency": SaliencyConfig(weight=0.5)},
        {"belief": replace(config.belief, prior=0.25)},
        {"protocol": ProtocolConfig(seed=1)},
        {"data": DataConfig(limit=2)},
    ]
    keys = {key, *(SearchRun(replace(config, **other)).key for other in others)}
    assert len(keys) == 1 + len(others)

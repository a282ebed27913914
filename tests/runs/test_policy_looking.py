"""From a policy's settings to observer, policy and models."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from eval.comparison.looking import Candidate
from eval.explore.run import ExploreConfig
from eval.search.run import SearchConfig, SearchRun
from semfov import (
    DirichletBelief,
    Eye,
    FovealObservationModel,
    Foveation,
    Grid,
    InputError,
    observers,
    policies,
)
from semfov.gaze.acquisition import (
    FUNCTIONS,
    ExpectedAccuracy,
    PredictedTargetPosterior,
    SaliencyPrior,
    Static,
    TargetPosterior,
)
from semfov.runs import policy_looking
from semfov.runs.config import BeliefConfig, DataConfig, PolicyConfig
from semfov.runs.policy_looking import (
    _belief_settings,
    _LoadedModels,
    _make_strategy,
)
from semfov.runs.presets import presets, resolve
from semfov.strategy import Strategy
from tests.small import Blobs

GRID = Grid(4, 3, (40, 30))
FOVEA = 100 / 640


@pytest.fixture
def model():
    return FovealObservationModel.identity(["cup", "cat"], [0.2], miss_rate=torch.full((3, 2), 0.5))


def strategy(policy, task="search", belief=None, fovea=FOVEA, **models):
    """The strategy of a policy for two classes, made with the given models."""
    return _make_strategy(resolve(policy, task), task, belief or BeliefConfig(), 3, models.__getitem__, fovea)


@pytest.mark.parametrize("task", ["search", "exploration"])
def test_policies_with_equal_settings_of_the_belief_have_equal_observers(task, model):
    models = {"observation": model, "search": model, "map": model}
    seen = {}
    for name in presets(task):
        plain = resolve(name, task)
        for policy in (
            (plain,)
            if plain.scores == "learned"
            else (plain, replace(plain, tempering=0.5), replace(plain, misses=True))
        ):
            observer = strategy(policy, task, **models).observer
            look = type(observer), repr(observer), [id(part) for part in observer.children()]
            assert seen.setdefault(_belief_settings(policy), look) == look
    assert 3 < len(seen) < 3 * len(presets(task))


@pytest.mark.parametrize(
    "name",
    [name for name, kind in FUNCTIONS.items() if not kind.by_belief and kind.__module__.startswith("semfov.")],
)
def test_policies_that_do_not_depend_on_the_belief_value_cells_alike_for_any(name):
    made, cell = Strategy(observers.Semantic(3), policies.Policy(name)), torch.tensor([1, 5])
    saliency = torch.rand(12, 12) if name == "saliency" else None
    values = Candidate(made, saliency).acquisition(1, GRID, cell)
    beliefs = (DirichletBelief(0.5 + torch.rand(2, 12, components)) for components in (1, 3))
    first, second = (values(belief, torch.zeros(2, 12, dtype=torch.bool)) for belief in beliefs)
    assert torch.equal(first, second)


def test_prediction_calibration_and_misses_need_an_observation_model(model):
    every = {"search": model, "map": model, "observation": model}

    def needs_model(belief, *choices, task="search"):
        asked = set()
        for choice in choices:
            given = resolve(choice, task), task, belief or BeliefConfig(), 3
            _make_strategy(*given, lambda name: asked.add(name) or every[name], FOVEA)
        return "observation" in asked

    soft = PolicyConfig("non-predictive", footprint="soft")
    assert not needs_model(None, "random", "recommended", "vocus2", "non-predictive-raw", soft)
    assert not needs_model(None, "random-raw", "closer-look-raw", "itti-koch-raw", "recommended", task="exploration")
    assert needs_model(None, PolicyConfig("non-predictive", misses=True))
    assert needs_model(None, "random", "non-predictive-calibrated")
    assert needs_model(None, "closer-look-calibrated", task="exploration")
    assert needs_model(BeliefConfig(misses=True), "non-predictive-raw")
    assert not needs_model(BeliefConfig(misses=True), PolicyConfig("non-predictive", misses=False))
    ahead = ("predictive", "neighbourhood", "foveal-hit", "place-information", "entropy-limit", "ideal-observer")
    assert all(needs_model(None, PolicyConfig(name)) for name in ahead)
    without = {"random", "closer-look", "saliency", "expected-gain"}
    for name in policies.policy_names("exploration"):
        given = PolicyConfig(name, saliency="vocus2" if name == "saliency" else None)
        assert needs_model(None, given, task="exploration") == (name not in without)


def test_models_are_loaded_by_the_names_in_the_settings(monkeypatch):
    monkeypatch.setattr(policy_looking, "make_observation", lambda name, eye: ("observation", name))
    monkeypatch.setattr(policy_looking, "make_map", lambda name, eye: ("map", name))
    monkeypatch.setattr(policy_looking, "make_searching", lambda name, eye: ("search", name))
    belief = BeliefConfig(model="mine", search_model="sought", map_model="everything")
    models = _LoadedModels(belief, SimpleNamespace())
    assert [models(name) for name in ("observation", "search", "map")] == [
        ("observation", "mine"),
        ("search", "sought"),
        ("map", "everything"),
    ]
    assert models("map") is models.loaded["map"]  # loaded once


def test_a_run_has_the_models_that_its_policies_need(model, monkeypatch, tmp_path):
    looked = SearchConfig(policies=("random",), data=DataConfig(limit=1, min_instances=0), cache=tmp_path)
    monkeypatch.setattr("semfov.runs.looking.make_eye", lambda detector, sensor: Eye(Foveation(9.0), Blobs()))
    for make in ("make_observation", "make_searching", "make_map"):
        monkeypatch.setattr(policy_looking, make, lambda name, eye: model)
    assert not any(SearchRun(looked).models)
    guided = (PolicyConfig("non-predictive", "learned", saliency="vocus2"), "random")
    models = SearchRun(replace(looked, policies=guided)).models
    assert models.observation is models.map is None
    assert models.search is model
    for config in (SearchConfig, ExploreConfig):
        with pytest.raises(InputError, match="policies: expected at least one"):
            SearchRun(config(policies=()))


def test_strategies_follow_their_settings(model):
    ahead = strategy(PolicyConfig("predictive", misses=True, tempering=0.25), observation=model)
    assert ahead.observer.misses is model
    assert ahead.observer.observation is None
    assert ahead.observer.tempering == 0.25
    assert isinstance(ahead.policy(1, GRID), PredictedTargetPosterior)
    explorer = strategy(PolicyConfig("expected-accuracy", "calibrated", misses=True), "exploration", observation=model)
    assert explorer.observer.observation is model
    assert explorer.observer.misses is model
    assert isinstance(explorer.policy(None, GRID), ExpectedAccuracy)


def test_settings_that_a_policy_leaves_out_come_from_the_run(model):
    run = BeliefConfig(prior=0.3, fusion="sum", footprint="soft", tempering=0.7, memory="closest", misses=True)
    plain = strategy("non-predictive-raw", belief=run, observation=model).observer
    settings = plain.prior, plain.fusion, plain.footprint, plain.tempering, plain.memory, plain.misses
    assert settings == (0.3, "sum", "soft", 0.7, "closest", model)
    own = PolicyConfig("non-predictive", tempering=1.0, footprint="box_centre", memory="all", misses=False)
    changed = strategy(own, belief=run, observation=model).observer
    settings = changed.prior, changed.fusion, changed.footprint, changed.tempering, changed.memory, changed.misses
    assert settings == (0.3, "sum", "box_centre", 1.0, "all", None)
    explorer = strategy("kl-raw", "exploration", BeliefConfig(prior=0.25), observation=model)
    assert explorer.policy(None, GRID).prior == explorer.observer.prior == 0.25
    assert strategy("closer-look-raw", "exploration", fovea=0.07).policy.fovea == 0.07


def test_learned_scores_bring_their_own_belief_and_saliency_keeps_that_of_the_run(model):
    sought = strategy("recommended", search=model)
    assert isinstance(sought.observer, observers.SemanticSearch)
    assert sought.observer.model is model
    assert sought.policy.name == "non-predictive"
    made = strategy(PolicyConfig("saliency", "calibrated", saliency="vocus2"), "exploration", observation=model)
    assert made.policy.name == "saliency"
    assert made.observer.observation is model


@pytest.mark.parametrize("rows", [1, 12], ids=["of the picture", "from every cell"])
def test_saliency_replaces_a_policy_or_is_combined_with_it(rows):
    cell, visited = torch.tensor([5, 0]), torch.zeros(2, 12, dtype=torch.bool)
    table = torch.rand(rows, 12, generator=torch.Generator().manual_seed(0))
    seen = table[cell] if rows > 1 else table.expand(2, -1)
    belief = DirichletBelief(0.5 + torch.rand(2, 12, 3, generator=torch.Generator().manual_seed(1)))
    salient = Strategy(observers.Semantic(3), policies.Policy("saliency"))
    alone = Candidate(salient, table).acquisition(1, GRID, cell)
    assert isinstance(alone, Static)
    torch.testing.assert_close(alone(belief, visited), seen)
    sought = Strategy(observers.Semantic(3), policies.Policy("non-predictive"))
    beside = Candidate(sought, saliency=table, weight=0.4).acquisition(1, GRID, cell)
    assert isinstance(beside, SaliencyPrior)
    raised = seen + 1e-3 * seen.amax(-1, keepdim=True)
    expected = belief.probability(1).log() + 0.4 * (raised / raised.sum(-1, keepdim=True)).log()
    torch.testing.assert_close(beside(belief, visited), expected)
    plain = Candidate(sought)
    assert plain.observer is sought.observer
    assert isinstance(plain.acquisition(1, GRID, cell), TargetPosterior)


@pytest.mark.parametrize("name", ["foveal-hit", "place-information", "entropy-limit", "ideal-observer"])
def test_policies_that_need_a_target_position_work_with_the_learned_belief(model, name):
    """The belief is that of the agent, and the policy searches for the position that it estimates."""
    sought = FovealObservationModel.identity(["cup", "cat"], [0.2], miss_odds=torch.full((3, 2), 0.3))
    made = strategy(PolicyConfig(name, "learned"), observation=model, search=sought)
    assert isinstance(made.observer, observers.SemanticSearch)
    assert made.observer.model is sought
    assert made.policy.name == name
    belief = made.observer.start(2, GRID, torch.zeros(()))
    visited = torch.zeros(2, 12, dtype=torch.bool)
    assert made.policy(torch.tensor([1, 2]), GRID)(belief, visited).shape == (2, 12)

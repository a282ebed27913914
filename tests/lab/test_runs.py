"""Runs of searches and explorations: what they are made of, their replay, and their page."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import eval.comparison.report_page as module
from eval.comparison.replay import replay
from eval.comparison.report_page import _choose_episodes, write_run_report
from eval.comparison.settings import SaliencyConfig
from eval.explore import episodes
from eval.explore import report as explore_report
from eval.explore.run import ExploreConfig, ExploreRun
from eval.search import report as search_report
from eval.search.run import SearchConfig, SearchRun
from semfov import ActivePerception, FovealObservationModel, rollout
from semfov.belief.observers import SemanticMap
from semfov.runs import protocols
from semfov.runs.config import BeliefConfig, DataConfig, PolicyConfig, ProtocolConfig
from tests.refusals import refused
from tests.small import run_settings

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
        "non-predictive-learned": PolicyConfig("non-predictive", "learned"),
    }
    assert list(run.strategies) == list(run.policies)
    assert run.candidate("non-predictive-learned", 0).strategy is run.strategies["non-predictive-learned"]
    refused("did you mean 'random'", run.candidate, "randm", 0)


def test_a_run_has_one_store_for_each_saliency_model(config):
    calibrated = replace(GUIDED, scores="calibrated")
    sought = PolicyConfig("non-predictive", "learned", saliency="itti-koch")
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
        {"policies": ("random", "non-predictive-learned")},
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


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return run_settings(tmp_path_factory.mktemp("report"), 2, starts=2, shifts=5)


@pytest.fixture(scope="module")
def reported(settings):
    run = SearchRun(SearchConfig(**settings, policies=("random", "non-predictive-raw")))
    return run, [record for index in range(2) for record in run.outcomes(index)[0]]


def write_search(run, records, **options):
    policies = list(run.policies)
    curves = {"all targets": search_report.performance(records, policies, 5, "all targets")}
    path = write_run_report(
        run,
        records,
        curves,
        titles=search_report._AVERAGES,
        label="targets found (%)",
        shifts=search_report._SEARCH_SHIFTS,
        others={"random, by formula": search_report._expected_random(records, 5, 12)},
        **options,
    )
    page = path.read_text(encoding="utf-8")
    return curves, page, json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])


@pytest.mark.slow
def test_the_page_of_a_search_run_shows_curves_and_episodes(reported):
    run, records = reported
    curves, page, data = write_search(run, records)
    chosen = _choose_episodes(records, list(run.policies), 18)
    assert len(chosen) == 4
    for episode, record in zip(data["episodes"], chosen, strict=True):
        assert [each["cell"] for each in episode["fixations"]] == record["cells"]
        assert record["policy"] in episode["name"]
        assert episode["target"] == record["target_name"]
        assert episode["found"] == (record["found_at"] >= 0)
    policies = [record["policy"] for record in chosen]
    assert policies == ["random", "non-predictive-raw"] * 2
    curve = curves["all targets"]["random"]
    assert f"{100 * curve.mean[5]:.1f} ± {100 * curve.over_images[5]:.1f}" in page
    assert "random, by formula" in page
    assert "min_instances" in page


def test_the_size_limit_leaves_one_episode(reported, monkeypatch):
    run, records = reported
    monkeypatch.setattr(module, "_MOST_BYTES", 1)
    _, _, data = write_search(run, records)
    assert len(data["episodes"]) == 1


def test_the_page_of_an_exploration_run_shows_episodes_as_recorded(settings):
    run = ExploreRun(ExploreConfig(**settings, policies=("random-raw", "kl-calibrated")))
    records = run.outcomes(0)[0]
    curves = {"all classes": explore_report.success(records, list(run.policies), "all classes")}
    path = write_run_report(
        run,
        records,
        curves,
        titles={"all classes": "all classes"},
        label="cells with the right class (%)",
        shifts=explore_report._EXPLORATION_SHIFTS,
    )
    data = json.loads(re.search(r'id="data">(.*?)</script>', path.read_text(encoding="utf-8"), re.S)[1])
    assert [episode["target"] for episode in data["episodes"]] == [None, None]
    kl = next(record for record in records if record["policy"] == "kl-calibrated" and record["repetition"] == 0)
    assert [each["cell"] for each in data["episodes"][1]["fixations"]] == kl["cells"]
    # The replayed values explain the gaze: the next cell has the greatest value of those not yet visited.
    fixations = data["episodes"][1]["fixations"]
    for number, each in enumerate(fixations[:-1]):
        values = np.array(each["values"], dtype=float)
        values[[earlier["cell"] for earlier in fixations[: number + 1]]] = -np.inf
        assert values[each["next"]] == pytest.approx(values.max(), rel=1e-3)


SOUGHT = "non-predictive-learned"
SEMANTIC = (
    "non-predictive-raw",
    PolicyConfig("predictive", "calibrated", tempering=0.25, memory="closest"),
    PolicyConfig("non-predictive", footprint="soft", saliency="vocus2"),
    "vocus2",
)


@pytest.fixture(scope="module")
def run(settings):
    return SearchRun(SearchConfig(**settings, policies=(*SEMANTIC, SOUGHT)))


def run_and_record_steps(run):
    """Records of the first scene by policy, each with the steps of all its episodes."""
    calls = []

    def spy(*given, **options):
        steps = []
        calls.append(steps)
        for step in rollout(*given, **options):
            steps.append(step)
            yield step

    with pytest.MonkeyPatch.context() as patch:
        for module in (protocols, episodes):
            patch.setattr(module, "rollout", spy)
        records, _ = run.outcomes(0)
    assert len(calls) == len(run.policies)
    by_policy = {name: [record for record in records if record["policy"] == name] for name in run.policies}
    return {name: (by_policy[name], steps) for name, steps in zip(run.policies, calls, strict=True)}


@pytest.fixture(scope="module")
def searched(run):
    return run_and_record_steps(run)


def steps_of(steps, episode):
    """Belief and values of one episode at each fixation at which it looked."""
    for step in steps:
        row = (step.episodes == episode).nonzero()[:, 0]
        if len(row):
            yield step.belief[row], step.values[row][0]


@pytest.mark.slow
def test_a_replayed_semantic_search_has_the_original_beliefs_and_values(run, searched):
    for name in list(run.policies)[: len(SEMANTIC)]:
        records, steps = searched[name]
        assert len(records) > 2
        for number, record in enumerate(records):
            path = replay(run, 0, record)
            assert path.cells.tolist() == record["cells"]
            recorded = list(steps_of(steps, number))
            # A search stops without a look when it reaches the target; its replay has that look.
            assert len(recorded) == len(path) - (record["found_at"] >= 0 or len(path) == 6)
            for shift, (belief, values) in enumerate(recorded):
                torch.testing.assert_close(path.values[shift], values)
                if not run.strategies[name].policy.function.by_belief:  # such a search keeps no belief
                    continue
                torch.testing.assert_close(path.probabilities[shift], belief.probabilities[0])
                torch.testing.assert_close(path.posterior[shift], belief.probability(record["cue"])[0])


def test_a_replayed_search_by_the_learned_belief_also_has_the_recommended_map(run, searched):
    records, steps = searched[SOUGHT]
    looks, grid = run.detections(0), run.grid(0)
    mapper = SemanticMap(FovealObservationModel.from_pretrained(run.eye.detector.name))
    for number, record in enumerate(records):
        path = replay(run, 0, record)
        assert path.seconds == (), "from the store it takes no time"
        for shift, (belief, values) in enumerate(steps_of(steps, number)):
            torch.testing.assert_close(path.posterior[shift], belief.probability(record["cue"])[0])
            torch.testing.assert_close(path.values[shift], values)
        known = mapper.start(1, grid, looks.scores)
        for shift, cell in enumerate(record["cells"]):
            known = mapper(known, looks[torch.tensor([cell])], grid.centres[[cell]], grid)
            torch.testing.assert_close(path.probabilities[shift], known.probabilities[0])


def test_the_map_of_a_replayed_search_is_that_of_the_recommended_agent(run):
    agent, scene = ActivePerception.recommended(), run.scenes[0]
    # The models were fitted on other grids, which does not matter for comparing two beliefs.
    agent.columns, agent.rows = 4, 3
    assert agent.eye.settings() == run.eye.settings()
    target = run.scenes.targets(0)[0]
    boxes = scene.boxes[scene.labels == target]
    free = (~run.grid(0).footprint(boxes).any(0)).nonzero()[:, 0]
    with torch.inference_mode():
        kept = agent.search(scene.image, target, start=int(free[-1]), shifts=5, boxes=boxes)
    assert len(kept) > 1
    record = {
        "policy": SOUGHT,
        "scene": run.scenes.ids[0],
        "target": target,
        "cue": target,
        "cells": kept.cells.tolist(),
        "found_at": kept.shifts if kept.found else -1,
    }
    path = replay(run, 0, record)
    assert (path.classes, path.target, path.found) == (kept.classes, kept.target, kept.found)
    for name in ("cells", "fixations", "probabilities", "posterior", "values"):
        torch.testing.assert_close(getattr(path, name), getattr(kept, name))
    for mine, theirs in zip(path.detections, kept.detections, strict=True):
        torch.testing.assert_close(mine.scores[mine.mask], theirs.scores[theirs.mask])
        torch.testing.assert_close(mine.boxes[mine.mask], theirs.boxes[theirs.mask], rtol=1e-5, atol=1e-3)


def test_misses_of_a_run_do_not_change_the_map_of_a_replay(run, searched, settings):
    belief = BeliefConfig(columns=4, rows=3, misses=True)
    everywhere = SearchRun(SearchConfig(**{**settings, "belief": belief}, policies=(SOUGHT,)))
    record = searched[SOUGHT][0][0]
    expected = replay(run, 0, record).probabilities
    torch.testing.assert_close(replay(everywhere, 0, record).probabilities, expected)


def test_a_search_with_a_wrong_cue_is_replayed_with_the_belief_about_the_cue(run, searched):
    """In the control the cue is another class than the target."""
    record = {**searched["non-predictive-raw"][0][0], "cue": 7}
    path = replay(run, 0, record)
    assert path.target == record["target"] != 7
    torch.testing.assert_close(path.posterior, path.probabilities[..., 7])


def test_a_replayed_exploration_has_the_original_beliefs_and_values(settings):
    policies = ("kl-calibrated", "recommended", "vocus2-raw", PolicyConfig("surprise", misses=True))
    run = ExploreRun(replace(ExploreConfig(**settings), policies=policies))
    for records, steps in run_and_record_steps(run).values():
        for number, record in enumerate(records):
            path = replay(run, 0, record)
            assert path.cells.tolist() == record["cells"]
            assert (path.target, path.found, path.posterior) == (None, False, None)
            recorded = list(steps_of(steps, number))
            assert len(recorded) == len(path) == 6
            for shift, (belief, values) in enumerate(recorded):
                torch.testing.assert_close(path.probabilities[shift], belief.probabilities[0])
                torch.testing.assert_close(path.values[shift], values)

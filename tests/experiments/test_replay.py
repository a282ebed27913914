"""A replayed episode has the beliefs and the values that it had when it was run, and the map that the agent keeps."""

from dataclasses import replace

import pytest
import torch

from semfov import ActivePerception
from semfov.belief import MapEvidence
from semfov.belief.observers import LearnedMap
from semfov.episode import rollout
from semfov.experiments import exploration_protocol, search_protocol
from semfov.experiments.config import (
    BeliefConfig,
    DataConfig,
    ExploreConfig,
    PolicyConfig,
    ProtocolConfig,
    SearchConfig,
)
from semfov.experiments.replay import replay
from semfov.experiments.runs import ExploreRun, SearchRun

pytestmark = pytest.mark.weights

SOUGHT = "target-evidence"
SEMANTIC = (
    "non-predictive-raw",
    PolicyConfig("predictive", "calibrated", tempering=0.25, memory="closest"),
    PolicyConfig("non-predictive", footprint="soft", saliency="vocus2"),
    "learned",
    "vocus2",
)
TOGETHER = PolicyConfig(SOUGHT, context="both")


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay")
    return {
        "data": DataConfig(limit=1),
        "belief": BeliefConfig(columns=4, rows=3),
        "protocol": ProtocolConfig(starts=2, shifts=5),
        "cache": folder / "cache",
        "out": folder / "out",
        "workers": 1,
    }


@pytest.fixture(scope="module")
def run(settings):
    return SearchRun(SearchConfig(**settings, policies=(*SEMANTIC, SOUGHT, TOGETHER)))


def watched(run, module):
    """Records of the first scene by policy, each with the steps of all its episodes as they were run."""
    calls = []

    def spy(*given, **options):
        steps = []
        calls.append(steps)
        for step in rollout(*given, **options):
            steps.append(step)
            yield step

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "rollout", spy)
        records, _ = run.outcomes(0)
    assert len(calls) == len(run.policies)
    by_policy = {name: [record for record in records if record["policy"] == name] for name in run.policies}
    return {name: (by_policy[name], steps) for name, steps in zip(run.policies, calls, strict=True)}


@pytest.fixture(scope="module")
def searched(run):
    return watched(run, search_protocol)


def steps_of(steps, episode):
    """Belief and values of one episode at each of its fixations, as long as it looked."""
    for step in steps:
        row = (step.episodes == episode).nonzero()[:, 0]
        if len(row):
            yield step.belief[row], step.values[row][0]


@pytest.mark.slow
def test_a_semantic_search_has_the_beliefs_and_values_that_it_had(run, searched):
    for name in list(run.policies)[: len(SEMANTIC)]:
        records, steps = searched[name]
        assert len(records) > 2
        for number, record in enumerate(records):
            path = replay(run, 0, record)
            assert path.cells.tolist() == record["cells"]
            had = list(steps_of(steps, number))
            # A search that ends on its target does not look from there; its replay does.
            assert len(had) == len(path) - (record["found_at"] >= 0 or len(path) == 6)
            for shift, (belief, values) in enumerate(had):
                torch.testing.assert_close(path.probabilities[shift], belief.probabilities[0])
                torch.testing.assert_close(path.values[shift], values)
                torch.testing.assert_close(path.posterior[shift], belief.probability(record["cue"])[0])


@pytest.mark.parametrize("policy", [SOUGHT, f"{SOUGHT}, context both"])
def test_a_search_by_target_evidence_has_the_recommended_map_beside_it(run, searched, policy):
    records, steps = searched[policy]
    looks, grid = run.detections(0), run.grid(0)
    mapper = LearnedMap(MapEvidence.from_pretrained(run.eye.detector.name))
    for number, record in enumerate(records):
        path = replay(run, 0, record)
        for shift, (belief, values) in enumerate(steps_of(steps, number)):
            torch.testing.assert_close(path.posterior[shift], belief.probability(record["cue"])[0])
            torch.testing.assert_close(path.values[shift], values)
        known = mapper.start(1, grid, looks.scores)
        for shift, cell in enumerate(record["cells"]):
            known = mapper(known, looks[torch.tensor([cell])], grid.centres[[cell]], grid)
            torch.testing.assert_close(path.probabilities[shift], known.probabilities[0])


def test_the_map_beside_target_evidence_is_the_one_that_the_recommended_agent_keeps(run):
    agent, scene = ActivePerception.recommended(), run.scenes[0]
    # Models are fitted on other grids, which makes no difference to whether two beliefs are one.
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


def test_what_a_run_adds_to_its_searches_does_not_change_the_map_beside_them(run, searched, settings):
    """Context is of searches, and misses need a model that such a run may not have."""
    belief = BeliefConfig(columns=4, rows=3, context="both", misses=True)
    everywhere = SearchRun(SearchConfig(**{**settings, "belief": belief}, policies=(SOUGHT,)))
    alone = PolicyConfig("non-predictive", misses=False, context="both")
    without = SearchRun(SearchConfig(**{**settings, "belief": belief}, policies=(alone,)))
    assert without.models.observation is None
    record = searched[SOUGHT][0][0]
    expected = replay(run, 0, record).probabilities
    torch.testing.assert_close(replay(everywhere, 0, record).probabilities, expected)
    (name,) = without.policies
    torch.testing.assert_close(replay(without, 0, {**record, "policy": name}).probabilities, expected)


def test_a_search_for_another_class_is_replayed_as_it_believed(run, searched):
    """In the control the searcher is told another class than the one that counts."""
    record = {**searched["non-predictive-raw"][0][0], "cue": 7}
    path = replay(run, 0, record)
    assert path.target == record["target"] != 7
    torch.testing.assert_close(path.posterior, path.probabilities[..., 7])


def test_reading_a_store_is_no_time_of_the_eyes(run, searched):
    assert replay(run, 0, searched[SOUGHT][0][0]).seconds == ()


def test_an_exploration_has_the_beliefs_and_values_that_it_had(settings):
    policies = ("kl-calibrated", "recommended", "vocus2-raw", PolicyConfig("surprise", misses=True))
    run = ExploreRun(replace(ExploreConfig(**settings), policies=policies))
    for records, steps in watched(run, exploration_protocol).values():
        for number, record in enumerate(records):
            path = replay(run, 0, record)
            assert path.cells.tolist() == record["cells"]
            assert (path.target, path.found, path.posterior) == (None, False, None)
            had = list(steps_of(steps, number))
            assert len(had) == len(path) == 6
            for shift, (belief, values) in enumerate(had):
                torch.testing.assert_close(path.probabilities[shift], belief.probabilities[0])
                torch.testing.assert_close(path.values[shift], values)

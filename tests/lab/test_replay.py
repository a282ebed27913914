"""Replayed episodes have the same beliefs, values and maps as when they were run."""

from dataclasses import replace

import pytest
import torch

from eval.comparison.replay import replay
from eval.explore.run import ExploreConfig, ExploreRun
from eval.search.run import SearchConfig, SearchRun
from semfov import ActivePerception, MapEvidence, rollout
from semfov.belief.observers import LearnedMap
from semfov.runs import protocols
from semfov.runs.config import BeliefConfig, PolicyConfig
from tests.small import run_settings

pytestmark = pytest.mark.weights

SOUGHT = "target-evidence"
SEMANTIC = (
    "non-predictive-raw",
    PolicyConfig("predictive", "calibrated", tempering=0.25, memory="closest"),
    PolicyConfig("non-predictive", footprint="soft", saliency="vocus2"),
    "vocus2",
)


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return run_settings(tmp_path_factory.mktemp("replay"), starts=2, shifts=5)


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
        patch.setattr(protocols, "rollout", spy)
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


def test_a_replayed_search_by_target_evidence_also_has_the_recommended_map(run, searched):
    records, steps = searched[SOUGHT]
    looks, grid = run.detections(0), run.grid(0)
    mapper = LearnedMap(MapEvidence.from_pretrained(run.eye.detector.name))
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

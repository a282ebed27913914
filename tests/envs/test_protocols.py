"""Policies as agents in environments make the same fixations as those recorded in the evaluations."""

import gymnasium
import pytest

from eval.explore.run import ExploreConfig, ExploreRun
from eval.search.run import SearchConfig, SearchRun
from semfov.envs import GazeExplore, GazeSearch, GazeVectorEnv, open_scenery
from semfov.runs.config import BeliefConfig, DataConfig, PolicyConfig, ProtocolConfig
from tests.envs.agents import PolicyAgent, run_agent

pytestmark = [pytest.mark.slow, pytest.mark.lab]

SEARCHES = [
    "recommended",
    "random",
    PolicyConfig("non-predictive", "calibrated", tempering=0.25, memory="closest", footprint="soft", misses=True),
]
EXPLORATIONS = ["recommended", "kl-calibrated"]


def settings(kind, world, policy="recommended"):
    """Settings of the evaluation in the same world."""
    columns, rows = world["grid"]
    return kind(
        data=DataConfig(limit=world["count"], min_instances=0),
        belief=BeliefConfig(columns=columns, rows=rows),
        protocol=ProtocolConfig(world["starts"], world["shifts"]),
        policies=(policy,),
        cache=world["cache"],
    )


def evaluated(run):
    """Records of the evaluation with the same settings, scene by scene: a separate run without the environment."""
    return [record for scene in range(len(run.scenes)) for record in run.outcomes(scene)[0]]


def all_episodes(scenery):
    return [episode for scene in scenery.scenes for episode in scenery.episodes(scene)]


def run_one_at_a_time(env, episodes):
    """Fixated cells, the shift that found the target, and the results of every look."""
    agent, ran = PolicyAgent(env), []
    for episode in episodes:
        _, info = env.reset(options={"episode": episode})
        cells, results, found, over = [episode.start], [info["result"]], -1, False
        while not over:
            action = agent(info)
            _, _, terminated, truncated, info = env.step(action)
            cells.append(int(action))
            results.append(info["result"])
            over = terminated or truncated
            found = len(cells) - 1 if terminated else -1
        ran.append((cells, found, results))
    return ran


@pytest.mark.parametrize("policy", SEARCHES, ids=str)
def test_searches_equal_the_records_of_the_evaluation(world, policy):
    scenery = open_scenery("search", **world, policy=policy)
    records, episodes = evaluated(SearchRun(settings(SearchConfig, world, policy))), all_episodes(scenery)
    assert len(records) == len(episodes) >= 12
    wanted = [(record["cells"], record["found_at"]) for record in records]
    assert len({found for _, found in wanted}) > 1  # The searches end at different times.
    assert [(cells, found) for cells, found, _ in run_one_at_a_time(GazeSearch(scenery), episodes)] == wanted
    envs = GazeVectorEnv("search", 5, scenery, autoreset_mode="Disabled")
    assert [(list(ran.cells), ran.found_at) for ran in run_agent(envs, PolicyAgent(envs), episodes)] == wanted


@pytest.mark.parametrize("policy", EXPLORATIONS)
def test_explorations_equal_the_records_of_the_evaluation(world, policy):
    world = {**world, "count": 4}  # the aeroplane fills cells
    scenery = open_scenery("exploration", **world, policy=policy)
    records, episodes = evaluated(ExploreRun(settings(ExploreConfig, world, policy))), all_episodes(scenery)
    records = [record for record in records if record["policy"] == scenery.policy]
    assert len(records) == len(episodes) == 12
    wanted = [(record["cells"], [right / record["object_cells"] for right in record["right"]]) for record in records]
    assert len({rate for _, rates in wanted for rate in rates}) > 1  # not the same everywhere
    for (cells, _, results), (path, rates) in zip(
        run_one_at_a_time(GazeExplore(scenery), episodes), wanted, strict=True
    ):
        assert cells == path
        assert results == pytest.approx(rates, abs=1e-6)
    envs = GazeVectorEnv("exploration", 4, scenery, autoreset_mode="Disabled")
    for ran, (path, rates) in zip(run_agent(envs, PolicyAgent(envs), episodes), wanted, strict=True):
        assert list(ran.cells) == path
        assert list(ran.results) == pytest.approx(rates, abs=1e-6)


def test_the_policy_agent_accepts_wrapped_environments(sceneries):
    env = gymnasium.wrappers.TimeLimit(GazeSearch(sceneries["search"]), 3)
    _, info = env.reset(seed=0)
    assert info["action_mask"][PolicyAgent(env)(info)] == 1


def test_an_environment_can_be_made_from_the_settings_of_an_evaluation(world):
    scenery = open_scenery("search", config=settings(SearchConfig, world, "random"))
    assert scenery.policy == "random"
    assert scenery.shape == (4, 5)

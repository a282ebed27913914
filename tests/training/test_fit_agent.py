"""`python -m train.fit_agent`, small, and its adapter to Stable-Baselines3 against the one of that library."""

import json

import numpy as np
import pytest
import torch
from safetensors import safe_open
from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv

from semfov import InputError
from semfov.envs import GazeSearch, GazeVectorEnv, open_scenery
from semfov.envs.stable_baselines3 import StableVecEnv
from semfov.training.agent_network import CellPolicy
from train.fit_agent import main

pytestmark = [pytest.mark.weights, pytest.mark.slow]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("agent") / "cache"


@pytest.fixture(scope="module")
def scenery(cache):
    return open_scenery("search", count=2, grid=(5, 4), shifts=6, cache=cache)


def test_an_agent_learns_to_search_scenes_that_it_was_not_trained_on(cache, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [
        "--data.limit", "2", "--judged.limit", "1", "--columns", "5", "--rows", "4", "--shifts", "10",
        "--steps", "5000", "--environments", "16", "--starts", "8", "--cache", str(cache), "--out", str(out),
    ]  # fmt: skip
    threads = torch.get_num_threads()
    assert main(arguments) == 0
    torch.set_num_threads(threads)
    written = json.loads((out / "judged.json").read_text())
    found = {name: np.array(each) for name, each in written["found_at"].items()}
    assert {len(each) for each in found.values()} == {len(found["trained"])}
    first = {name: ((each > 0) & (each <= 2)).mean() for name, each in found.items()}
    assert first["trained"] > first["random"] + 0.2
    assert first["hand-made"] > first["random"] + 0.2
    assert written["returns"][-1] > written["returns"][0]
    report = (out / "report.md").read_text()
    assert report in capsys.readouterr().out
    assert "other scenes" in report
    with safe_open(out / "agent.safetensors", framework="pt") as file:
        kept = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    envs = StableVecEnv(GazeVectorEnv("search", 2, count=1, grid=(5, 4), cache=cache, belief=True,
                                      autoreset_mode="SameStep"), key="belief")  # fmt: skip
    policy = MaskablePPO(CellPolicy, envs, device="cpu").policy
    missing, unexpected = policy.load_state_dict(kept, strict=False)
    assert all(name.startswith("features") for name in missing)
    assert not unexpected


def test_evaluation_on_the_training_scenes_is_refused(cache, capsys):
    alike = ["--data.limit", "1", "--judged.limit", "1", "--judged.scene_seed", "0", "--cache", str(cache)]
    assert main(alike) == 1
    assert "judged: expected scenes other than those of `data`" in capsys.readouterr().err


def test_the_adapter_matches_that_of_stable_baselines(scenery):
    """Step by step, over the ends of several episodes."""
    ours = StableVecEnv(
        GazeVectorEnv("search", 3, scenery, belief=True, together=False, autoreset_mode="SameStep"), key="belief"
    )
    theirs = DummyVecEnv([lambda: GazeSearch(scenery, belief=True)] * 3)
    ours.seed(5)
    theirs.seed(5)
    assert ours.observation_space == theirs.observation_space["belief"]
    assert np.array_equal(ours.reset(), theirs.reset()["belief"])
    assert np.array_equal(np.stack(ours.env_method("action_masks")), np.stack(theirs.env_method("action_masks")))
    random, ends, truncated = np.random.default_rng(0), 0, 0
    for _ in range(20):
        actions = random.integers(20, size=3)
        mine, other = ours.step(actions), theirs.step(actions)
        assert np.array_equal(mine[0], other[0]["belief"])
        assert mine[1] == pytest.approx(other[1])
        assert np.array_equal(mine[2], other[2])
        for row in np.flatnonzero(mine[2]):
            info, expected = mine[3][row], other[3][row]
            assert np.array_equal(info["terminal_observation"], expected["terminal_observation"]["belief"])
            assert info["TimeLimit.truncated"] == expected["TimeLimit.truncated"]
            assert info["result"] == expected["result"]
            truncated += info["TimeLimit.truncated"]
            ends += 1
    assert 0 < truncated < ends


def test_the_checker_of_stable_baselines_has_no_complaints(scenery):
    """The belief is left out: the checker would object that it is not an image."""
    check_env(GazeSearch(scenery, glimpse=64))


def test_the_adapter_refuses_environments_without_same_step_reset(scenery):
    with pytest.raises(InputError, match="autoreset_mode='SameStep'"):
        StableVecEnv(GazeVectorEnv("search", 2, scenery))
    with pytest.raises(InputError, match="a GazeVectorEnv"):
        StableVecEnv(GazeSearch(scenery))

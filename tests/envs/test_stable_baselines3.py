"""The adapter to Stable-Baselines3 against the one of that library."""

import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv

from semfov import InputError
from semfov.envs import GazeSearch, GazeVectorEnv, open_scenery
from semfov.envs.stable_baselines3 import StableVecEnv

pytestmark = [pytest.mark.weights, pytest.mark.slow]


@pytest.fixture(scope="module")
def scenery(tmp_path_factory):
    cache = tmp_path_factory.mktemp("agent") / "cache"
    return open_scenery("search", count=2, grid=(5, 4), shifts=6, cache=cache)


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

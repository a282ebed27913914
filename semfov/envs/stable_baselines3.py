"""Vectorised environments for Stable-Baselines3; they need `pip install "semfov[agents]"`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from semfov.envs.vector import GazeVectorEnv
from semfov.errors import DataError, check

try:
    import sb3_contrib as _contrib  # noqa: F401
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    raise DataError(
        'semfov.envs.stable_baselines3 needs Stable-Baselines3 and sb3-contrib: pip install "semfov[agents]"'
    ) from None


class StableVecEnv(VecEnv):
    """A `GazeVectorEnv` for Stable-Baselines3, with the action masks that `sb3_contrib.MaskablePPO` needs."""

    def __init__(self, envs: GazeVectorEnv, key: str | None = None) -> None:
        check(isinstance(envs, GazeVectorEnv), "envs", "a GazeVectorEnv", type(envs).__name__)
        mode = envs.metadata["autoreset_mode"]
        check(mode == AutoresetMode.SAME_STEP, "envs", "autoreset_mode='SameStep'", mode.value)
        self.envs, self.key = envs, key
        space: Any = envs.single_observation_space
        super().__init__(envs.num_envs, space if key is None else space[key], envs.single_action_space)
        self._actions: NDArray[np.int64] = np.zeros(envs.num_envs, dtype=np.int64)
        self._returns, self._lengths = np.zeros(envs.num_envs), np.zeros(envs.num_envs, dtype=int)

    def reset(self) -> Any:
        """Start all episodes, with the seeds that were given to `seed`."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observations, _ = self.envs.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0, 0
        return self._part(observations)

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Keep the actions until `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Make a step in all environments; returns observations, rewards, which episodes are over, and infos."""
        observations, rewards, terminated, truncated, details = self.envs.step(self._actions)
        over = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(over):
            infos[row] = {
                "terminal_observation": self._part(details["final_obs"][row]),
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "episode": {"r": float(self._returns[row]), "l": int(self._lengths[row])},
                "result": float(details["final_info"]["result"][row]),
            }
        self._returns[over], self._lengths[over] = 0, 0
        return self._part(observations), rewards.astype(np.float32), over, infos

    def _part(self, observations: Any) -> Any:
        return observations if self.key is None else observations[self.key]

    def close(self) -> None:
        """Release the resources of the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The value of an attribute, once for each environment."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise an error, because the environments share their attributes."""
        raise AttributeError(f"{attr_name}: cannot be set, because the environments share their attributes")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Results of a method, one for each environment; `action_masks` is the only one."""
        check(method_name == "action_masks", "method_name", "'action_masks'", repr(method_name))
        masks = self.envs.action_masks()
        return [masks[row] for row in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """Whether the environments have an attribute."""
        return hasattr(self.envs, attr_name)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """False for all, as the environments are not wrapped."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[Any]:
        """None for all, as only a `GazeEnv` can draw pictures."""
        return [None] * self.num_envs

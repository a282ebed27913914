"""Observations of one kind: what is believed, or what is seen."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorObservationWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from semfov.envs.environment import GazeEnv
from semfov.envs.observation import Arrays, belief_space, believed, glimpse_space
from semfov.envs.vector import GazeVectorEnv
from semfov.envs.zoom import ZoomEnv
from semfov.errors import InputError


class BeliefObservation(gymnasium.ObservationWrapper[Any, Any, Arrays]):
    """The belief as the observation: planes for convolutions over the cells.

    With cells as actions they are `(C + 2, Y, X)`: the probability of the target (of every class, in an exploration),
    which cells were fixated, and where the gaze is. With windows they are `(2, Y, X)`: the probability that closer
    looks find an object, and how close each place was looked at.

    Args:
        env: a `GazeEnv` or a `ZoomEnv`, wrapped or not.

    Example::

        env = BeliefObservation(gymnasium.make("semfov.envs:semfov/GazeSearch-v0"))
    """

    def __init__(self, env: gymnasium.Env[Arrays, Any]) -> None:
        super().__init__(env)
        self._inner = _own(env.unwrapped, GazeEnv, ZoomEnv)
        self.observation_space = self._inner.belief_space

    def observation(self, observation: Arrays) -> NDArray[np.float32]:
        """The planes."""
        found: NDArray[np.float32] = self._inner.planes()
        return found


class GlimpseObservation(gymnasium.ObservationWrapper[Any, Any, Arrays]):
    """What the eye is shown as the observation: a picture `(side, side, 3)`.

    Args:
        env: a `GazeEnv` or a `ZoomEnv`, wrapped or not.
        side: pixels.
    """

    def __init__(self, env: gymnasium.Env[Arrays, Any], side: int = 84) -> None:
        super().__init__(env)
        self._inner, self._side = _own(env.unwrapped, GazeEnv, ZoomEnv), side
        self.observation_space = glimpse_space(side)

    def observation(self, observation: Arrays) -> NDArray[np.uint8]:
        """The picture."""
        found: NDArray[np.uint8] = self._inner.glimpse(self._side)
        return found


class VectorBeliefObservation(VectorObservationWrapper):
    """`BeliefObservation` of a `GazeVectorEnv`: `(num_envs, C + 2, Y, X)`.

    The last observations of episodes that restart in the same step are not made again: infos keep them as they were.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._inner = _own(env.unwrapped, GazeVectorEnv)
        self.single_observation_space = belief_space(self._inner.scenery, self._inner.task)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def observations(self, observations: Arrays) -> NDArray[np.float32]:
        """The planes of every episode."""
        return believed(self._inner.gazes, torch.arange(self.num_envs))


def _own(env: Any, *kinds: type[Any]) -> Any:
    if not isinstance(env, kinds):
        raise InputError(f"env: expected a {' or a '.join(k.__name__ for k in kinds)}, got {type(env).__name__}")
    return env

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
from semfov.envs.observation import Arrays, belief_space, believed, glimpse_space, glimpses
from semfov.envs.vector import GazeVectorEnv
from semfov.errors import InputError

_ROW = torch.tensor([0])


class BeliefObservation(gymnasium.ObservationWrapper[Any, np.int64, Arrays]):
    """The belief as the observation: `(C + 2, Y, X)`, for convolutions over the cells.

    The planes are the probability of the target (of every class, in an exploration), which cells were fixated, and
    where the gaze is.

    Args:
        env: a `GazeEnv`, wrapped or not.

    Example::

        env = BeliefObservation(gymnasium.make("semfov/GazeSearch-v0"))
    """

    def __init__(self, env: gymnasium.Env[Arrays, np.int64]) -> None:
        super().__init__(env)
        self._inner = _own(env.unwrapped, GazeEnv)
        self.observation_space = belief_space(self._inner.scenery, self._inner.task)

    def observation(self, observation: Arrays) -> NDArray[np.float32]:
        """The planes."""
        found: NDArray[np.float32] = believed(self._inner.gazes, _ROW)[0]
        return found


class GlimpseObservation(gymnasium.ObservationWrapper[Any, np.int64, Arrays]):
    """What the eye is shown as the observation: a picture `(side, side, 3)`.

    Args:
        env: a `GazeEnv`, wrapped or not.
        side: pixels.
    """

    def __init__(self, env: gymnasium.Env[Arrays, np.int64], side: int = 84) -> None:
        super().__init__(env)
        self._inner, self._side = _own(env.unwrapped, GazeEnv), side
        self.observation_space = glimpse_space(side)

    def observation(self, observation: Arrays) -> NDArray[np.uint8]:
        """The picture."""
        found: NDArray[np.uint8] = glimpses(self._inner.gazes, _ROW, self._side)[0]
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


def _own(env: Any, kind: type[Any]) -> Any:
    if not isinstance(env, kind):
        raise InputError(f"env: expected a {kind.__name__}, got {type(env).__name__}")
    return env

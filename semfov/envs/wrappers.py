"""Wrappers that replace the observation by the belief or by the foveated image."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorObservationWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from semfov.envs.environment import GazeEnv, ZoomEnv
from semfov.envs.gazes import Arrays, glimpse_space
from semfov.envs.vector import GazeVectorEnv
from semfov.errors import InputError


class BeliefObservation(gymnasium.ObservationWrapper[Any, Any, Arrays]):
    """The belief as the observation: planes over the cells, as input of a convolutional network.

    Where actions are cells, the planes are `(C + 2, Y, X)`: the probability of the target (in an exploration of every
    class), the cells that were fixated, and the cell of the gaze. Where actions are windows, they are `(2, Y, X)`: the
    probability that closer looks find an object, and how closely each place was looked at.

    Args:
        env: a `GazeEnv` or a `ZoomEnv`, wrapped or not.

    Raises:
        InputError: the environment is of another kind.

    Example::

        env = BeliefObservation(gymnasium.make("semfov.envs:semfov/GazeSearch-v0"))
    """

    def __init__(self, env: gymnasium.Env[Arrays, Any]) -> None:
        super().__init__(env)
        self._inner = _own(env.unwrapped, GazeEnv, ZoomEnv)
        self.observation_space = self._inner.belief_space

    def observation(self, observation: Arrays) -> NDArray[np.float32]:
        """Replace an observation by the planes.

        Args:
            observation: observation of the environment; ignored.

        Returns:
            `(C + 2, Y, X)` or `(2, Y, X)`, float32 in [0, 1].
        """
        planes: NDArray[np.float32] = self._inner.planes()
        return planes


class GlimpseObservation(gymnasium.ObservationWrapper[Any, Any, Arrays]):
    """The foveated image as the observation, `(side, side, 3)`.

    Args:
        env: a `GazeEnv` or a `ZoomEnv`, wrapped or not.
        side: width and height in pixels.

    Raises:
        InputError: the environment is of another kind, or there is no such side.

    Example::

        env = GlimpseObservation(gymnasium.make("semfov.envs:semfov/GazeSearch-v0"), side=84)
    """

    def __init__(self, env: gymnasium.Env[Arrays, Any], side: int = 84) -> None:
        super().__init__(env)
        self._inner, self._side = _own(env.unwrapped, GazeEnv, ZoomEnv), side
        self.observation_space = glimpse_space(side)

    def observation(self, observation: Arrays) -> NDArray[np.uint8]:
        """Replace an observation by the image.

        Args:
            observation: observation of the environment; ignored.

        Returns:
            `(side, side, 3)`, RGB, uint8.
        """
        image: NDArray[np.uint8] = self._inner.glimpse(self._side)
        return image


class VectorBeliefObservation(VectorObservationWrapper):
    """`BeliefObservation` for a `GazeVectorEnv`: `(num_envs, C + 2, Y, X)`.

    The last observations of episodes that restart in the same step are not replaced; infos keep them unchanged.

    Args:
        env: a `GazeVectorEnv`, wrapped or not.

    Raises:
        InputError: the environment is of another kind.

    Example::

        envs = VectorBeliefObservation(GazeVectorEnv("search", 64))
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._inner = _own(env.unwrapped, GazeVectorEnv)
        self.single_observation_space = self._inner.gazes.belief_space
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def observations(self, observations: Arrays) -> NDArray[np.float32]:
        """Replace observations by the planes of every episode.

        Args:
            observations: observations of the environments; ignored.

        Returns:
            `(num_envs, C + 2, Y, X)`, float32 in [0, 1].
        """
        planes: NDArray[np.float32] = self._inner.gazes.planes(torch.arange(self.num_envs))
        return planes


def _own(env: Any, *kinds: type[Any]) -> Any:
    if not isinstance(env, kinds):
        raise InputError(f"env: expected a {' or a '.join(k.__name__ for k in kinds)}, got {type(env).__name__}")
    return env

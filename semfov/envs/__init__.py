"""Gymnasium environments of search and exploration: `pip install "semfov[envs]"`.

`gymnasium.make("semfov/GazeSearch-v0")` and `gymnasium.make("semfov/GazeExplore-v0")` work once semfov is installed
with this extra, and in a checkout once `semfov.envs` was imported.
"""

from semfov.errors import DataError

try:
    import gymnasium as _gymnasium  # noqa: F401
except ImportError:
    raise DataError('semfov.envs: needs Gymnasium; pip install "semfov[envs]"') from None

from semfov.envs.agents import MaskedRandom, PolicyAgent, run_agent
from semfov.envs.environment import GazeEnv, GazeExplore, GazeSearch
from semfov.envs.registration import register
from semfov.envs.scenery import Scenery, open_scenery
from semfov.envs.vector import GazeVectorEnv
from semfov.envs.wrappers import BeliefObservation, GlimpseObservation, VectorBeliefObservation

register()

__all__ = [
    "BeliefObservation",
    "GazeEnv",
    "GazeExplore",
    "GazeSearch",
    "GazeVectorEnv",
    "GlimpseObservation",
    "MaskedRandom",
    "PolicyAgent",
    "Scenery",
    "VectorBeliefObservation",
    "open_scenery",
    "register",
    "run_agent",
]

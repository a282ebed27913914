"""Gymnasium environments of visual search and scene exploration; they need `pip install "semfov[envs]"`.

`gymnasium.make("semfov.envs:semfov/GazeSearch-v0")` and `gymnasium.make("semfov.envs:semfov/GazeExplore-v0")` make one.
After `import semfov.envs` the names work without `semfov.envs:`.
"""

from semfov.errors import DataError

try:
    import gymnasium as _gymnasium  # noqa: F401
except ImportError:
    raise DataError('semfov.envs needs Gymnasium: pip install "semfov[envs]"') from None

from semfov.envs.environment import EpisodeEnv, GazeEnv, GazeExplore, GazeSearch, ZoomEnv
from semfov.envs.registration import register
from semfov.envs.scenery import open_scenery, open_zoom_scenery
from semfov.envs.state import EnvState
from semfov.envs.vector import GazeVectorEnv

register()

__all__ = [
    "EnvState",
    "EpisodeEnv",
    "GazeEnv",
    "GazeExplore",
    "GazeSearch",
    "GazeVectorEnv",
    "ZoomEnv",
    "open_scenery",
    "open_zoom_scenery",
    "register",
]

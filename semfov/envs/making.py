"""Entry points of `gymnasium.make` and `gymnasium.make_vec`."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from semfov.envs.environment import GazeExplore, GazeSearch
from semfov.envs.vector import GazeVectorEnv
from semfov.envs.zoom import ZoomExplore, ZoomSearch
from semfov.envs.zoom_scenery import open_zoom_scenery
from semfov.errors import lookup

Action = Literal["cell", "window"]
"""Kind of actions: a cell to fixate, or a window of a large picture as `(x, y, magnification)`."""

Env = gymnasium.Env[Any, Any]


def make_search(action: Action = "cell", **options: Any) -> Env:
    """Make a search environment; options of `GazeSearch`, or of `ZoomSearch` where actions are windows."""
    return ZoomSearch(**options) if _zooms(action) else GazeSearch(**options)


def make_explore(action: Action = "cell", **options: Any) -> Env:
    """Make an exploration environment; options of `GazeExplore`, or of `ZoomExplore` where actions are windows."""
    return ZoomExplore(**options) if _zooms(action) else GazeExplore(**options)


def make_search_vector(num_envs: int = 1, action: Action = "cell", **options: Any) -> VectorEnv[Any, Any, Any]:
    """Make searches side by side; options of `GazeVectorEnv`, or of `ZoomSearch` where actions are windows."""
    return (
        _side_by_side(ZoomSearch, num_envs, options) if _zooms(action) else GazeVectorEnv("search", num_envs, **options)
    )


def make_explore_vector(num_envs: int = 1, action: Action = "cell", **options: Any) -> VectorEnv[Any, Any, Any]:
    """Make explorations side by side; options of `GazeVectorEnv`, or of `ZoomExplore` where actions are windows."""
    if _zooms(action):
        return _side_by_side(ZoomExplore, num_envs, options)
    return GazeVectorEnv("exploration", num_envs, **options)


def _zooms(action: str) -> bool:
    return lookup(action, ["cell", "window"], "action") == "window"


def _side_by_side(kind: type[Any], num_envs: int, options: dict[str, Any]) -> VectorEnv[Any, Any, Any]:
    """Single environments with shared looks, since a belief of the zoom is about one picture."""
    mode = AutoresetMode(options.pop("autoreset_mode", AutoresetMode.NEXT_STEP))
    shared = {name: options.pop(name) for name in list(options) if name not in kind.OWN}
    scenery = shared.pop("scenery", None) or open_zoom_scenery(**shared)
    return SyncVectorEnv([lambda: kind(scenery, **options) for _ in range(num_envs)], autoreset_mode=mode)

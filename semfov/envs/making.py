"""What `gymnasium.make` and `gymnasium.make_vec` call: cells of a grid, or windows of large pictures."""

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
"""A cell to fixate, or `(x, y, magnification)`."""

Env = gymnasium.Env[Any, Any]


def make_search(action: Action = "cell", **options: Any) -> Env:
    """A search; options of `GazeSearch`, or of `ZoomSearch` where actions are windows."""
    return ZoomSearch(**options) if _zooms(action) else GazeSearch(**options)


def make_explore(action: Action = "cell", **options: Any) -> Env:
    """An exploration; options of `GazeExplore`, or of `ZoomExplore` where actions are windows."""
    return ZoomExplore(**options) if _zooms(action) else GazeExplore(**options)


def make_search_vector(num_envs: int = 1, action: Action = "cell", **options: Any) -> VectorEnv[Any, Any, Any]:
    """Searches side by side; options of `GazeVectorEnv`, or of `ZoomSearch` where actions are windows."""
    return (
        _side_by_side(ZoomSearch, num_envs, options) if _zooms(action) else GazeVectorEnv("search", num_envs, **options)
    )


def make_explore_vector(num_envs: int = 1, action: Action = "cell", **options: Any) -> VectorEnv[Any, Any, Any]:
    """Explorations side by side; options of `GazeVectorEnv`, or of `ZoomExplore` where actions are windows."""
    if _zooms(action):
        return _side_by_side(ZoomExplore, num_envs, options)
    return GazeVectorEnv("exploration", num_envs, **options)


def _zooms(action: str) -> bool:
    return lookup(action, ["cell", "window"], "action") == "window"


def _side_by_side(kind: type[Any], num_envs: int, options: dict[str, Any]) -> VectorEnv[Any, Any, Any]:
    """Environments one after another, which share what was seen: the zoom's belief is of one picture at a time."""
    mode = AutoresetMode(options.pop("autoreset_mode", AutoresetMode.NEXT_STEP))
    shared = {name: options.pop(name) for name in list(options) if name not in kind.OWN}
    scenery = shared.pop("scenery", None) or open_zoom_scenery(**shared)
    return SyncVectorEnv([lambda: kind(scenery, **options) for _ in range(num_envs)], autoreset_mode=mode)

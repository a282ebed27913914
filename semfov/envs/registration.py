"""Registration of the environments with Gymnasium, and the entry points of `gymnasium.make` and `make_vec`."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from semfov.envs.environment import EpisodeEnv, GazeExplore, GazeSearch, GazeVectorEnv, ZoomEnv
from semfov.envs.scenery import open_zoom_scenery
from semfov.errors import lookup

_IDS = {"search": "semfov/GazeSearch-v0", "exploration": "semfov/GazeExplore-v0"}

_KINDS: dict[str, dict[str, Callable[..., EpisodeEnv]]] = {
    "cell": {"search": GazeSearch, "exploration": GazeExplore},
    "window": {task: partial(ZoomEnv, task) for task in ("search", "exploration")},
}
"""Makers by kind of actions: a cell to fixate, or a window of a large picture as `(x, y, magnification)`."""


def register() -> None:
    """Register the environments by their names, unless they are registered already.

    >>> register()
    >>> sorted(name for name in gymnasium.registry if name.startswith("semfov/"))
    ['semfov/GazeExplore-v0', 'semfov/GazeSearch-v0']
    """
    for task, name in _IDS.items():
        if name not in gymnasium.registry:
            one, many = f"{__name__}:_make", f"{__name__}:_make_vector"
            gymnasium.register(name, entry_point=one, vector_entry_point=many, kwargs={"task": task})


def _make(task: str, action: str = "cell", **options: Any) -> EpisodeEnv:
    """Make an environment; options of `GazeEnv`, or of `ZoomEnv` where actions are windows."""
    return _KINDS[lookup(action, _KINDS, "action")][task](**options)


def _make_vector(task: str, num_envs: int = 1, action: str = "cell", **options: Any) -> VectorEnv[Any, Any, Any]:
    """Make environments side by side; options of `GazeVectorEnv`, or of `ZoomEnv` where actions are windows."""
    if lookup(action, _KINDS, "action") == "cell":
        return GazeVectorEnv(task, num_envs, **options)
    # Single environments with shared looks, since a belief about windows is about one picture.
    mode = AutoresetMode(options.pop("autoreset_mode", AutoresetMode.NEXT_STEP))
    own = inspect.signature(ZoomEnv).parameters.keys() - {"task", "scenery"}
    common = {name: options.pop(name) for name in list(options) if name not in own}
    scenery = common.pop("scenery", None) or open_zoom_scenery(**common)
    return SyncVectorEnv([lambda: _make(task, action, scenery=scenery, **options)] * num_envs, autoreset_mode=mode)

"""Registration of the environments with Gymnasium, and the entry points of `gymnasium.make` and `make_vec`."""

from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from semfov.envs.environment import EpisodeEnv, GazeExplore, GazeSearch, ZoomEnv
from semfov.envs.gazes import Arrays
from semfov.envs.scenery import ZoomScenery, open_zoom_scenery, scenery_or_open
from semfov.envs.vector import GazeVectorEnv
from semfov.errors import lookup, rename_former
from semfov.gaze.acquisition.base import Task

_IDS: dict[Task, str] = {"search": "semfov/GazeSearch-v0", "exploration": "semfov/GazeExplore-v0"}

_Vectors = VectorEnv[Arrays, NDArray[np.int64], NDArray[np.generic]]

_MAKERS: dict[str, dict[Task, Callable[..., EpisodeEnv]]] = {
    "cell": {"search": GazeSearch, "exploration": GazeExplore},
    "window": {"search": partial(ZoomEnv, "search"), "exploration": partial(ZoomEnv, "exploration")},
}
"""Makers by kind of actions: a cell to fixate, or a window of a large picture as `(x, y, magnification)`."""


def register() -> None:
    """Register the environments by their names, unless they are registered already.

    >>> register()
    >>> sorted(name for name in gymnasium.registry if name.startswith("semfov/"))
    ['semfov/GazeExplore-v0', 'semfov/GazeSearch-v0']
    """
    for task, name in _IDS.items():
        if name in gymnasium.registry:
            continue
        gymnasium.register(
            name,
            entry_point=f"{__name__}:_make",
            vector_entry_point=f"{__name__}:_make_vector",
            kwargs={"task": task},
        )


def _make(task: Task, action: str = "cell", **options: Any) -> EpisodeEnv:
    """Make an environment; options of `GazeEnv`, or of `ZoomEnv` where actions are windows."""
    return _MAKERS[lookup(action, _MAKERS, "action")][task](**options)


def _make_vector(task: Task, num_envs: int = 1, action: str = "cell", **options: Any) -> _Vectors:
    """Make environments side by side; options of `GazeVectorEnv`, or of `ZoomEnv` where actions are windows."""
    if lookup(action, _MAKERS, "action") == "cell":
        return GazeVectorEnv(task, num_envs, **options)
    return _make_zoom_vector(task, num_envs, **options)


def _make_zoom_vector(
    task: Task,
    num_envs: int,
    scenery: ZoomScenery | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    **options: Any,
) -> _Vectors:
    """Make single environments with shared looks, since a belief about windows is about one picture."""
    names = signature(ZoomEnv).parameters.keys()
    rename_former(options, names)
    env_options = {name: option for name, option in options.items() if name in names}
    scenery_options = {name: option for name, option in options.items() if name not in names}
    scenery = scenery_or_open(scenery, open_zoom_scenery, scenery_options)

    def make() -> EpisodeEnv:
        return _make(task, "window", scenery=scenery, **env_options)

    return SyncVectorEnv([make] * num_envs, autoreset_mode=AutoresetMode(autoreset_mode))

"""States of environments, which a search in the tree of actions saves and restores."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from semfov.envs.gazes import SavedGazes
from semfov.envs.scenery import Scenery, ZoomScenery
from semfov.errors import InputError, type_of
from semfov.gaze.acquisition.base import Task


@dataclass(frozen=True, repr=False)
class EnvState:
    """A state of an environment, from `save_state`, for `restore`.

    A copy, also by `pickle`, has the key of the scenes in their place: a worker restores it in an environment of its
    own, opened with the same settings, and no detector is loaded for it. Scenes of your own need a `fingerprint` for
    the key; of a folder without annotations the first copy hashes every file.

    Attributes:
        kind: the kind of environment: a single one, or several side by side.
        scenery: the scenes; of a copy, their key.
        task: `search` or `exploration`.
        gazes: the episodes.
        randoms: copies of the generators of random numbers, one for each episode.
        over: how the episodes have ended, as the environment keeps it.

    Example::

        state = env.save_state()
        env.step(3)
        env.restore(state)
    """

    kind: str
    scenery: Scenery | ZoomScenery | str
    task: Task
    gazes: SavedGazes
    randoms: tuple[np.random.Generator, ...]
    over: tuple[Any, ...]

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "scenery": self.scene_key()}

    def scene_key(self) -> str:
        """Compute the key of the scenes; scenes that are opened with the same settings have the same key.

        Returns:
            64 hexadecimal digits.

        Raises:
            InputError: the scenes have no `fingerprint`.
        """
        return self.scenery if isinstance(self.scenery, str) else self.scenery.key


def check_state(state: object, kind: str, scenery: Scenery | ZoomScenery, task: Task, count: int) -> None:
    """Raise `InputError` unless a state is one of a kind of environment with these scenes, this task and episodes."""
    expected = "what `save_state` of this environment gave"
    if not isinstance(state, EnvState):
        raise InputError(f"state: expected {expected}, got {type_of(state)}")
    if state.kind != kind:
        raise InputError(f"state: expected {expected}, a {kind}, got one of a {state.kind}")
    if state.scenery is not scenery and state.scene_key() != scenery.key:
        raise InputError(
            f"state: expected {expected}, got one of other scenes; open both environments with the same settings, or "
            "share the scenes by scenery="
        )
    got = (state.task, len(state.randoms))
    if got != (task, count):
        raise InputError(f"state: expected {expected} ({task}, episodes: {count}), got {got[0]}, episodes: {got[1]}")

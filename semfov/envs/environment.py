"""One episode at a time: search and exploration with a fovea that moves from cell to cell."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from semfov.envs.observation import (
    GAZES,
    Arrays,
    belief_space,
    believed,
    first,
    glimpses,
    observation_space,
    observe,
    tell,
)
from semfov.envs.rendering import Film
from semfov.envs.scenery import Scenery, open_scenery
from semfov.errors import InputError, check, check_whole

_ROW = torch.tensor([0])


class GazeEnv(gymnasium.Env[Arrays, np.int64]):
    """Base of `GazeSearch` and `GazeExplore`.

    Args:
        scenery: scenes, looks and belief (`open_scenery`), to be shared by several environments; None opens one.
        price: of a look.
        find: what is to be found is worth.
        belief: observations have the belief.
        glimpse: observations have what the eye is shown, so many pixels wide and high; None leaves it out.
        render_mode: `rgb_array` or None.
        options: of `open_scenery`, where none is given.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 (Gymnasium has it so)
    task: ClassVar[str]
    default_price: ClassVar[float]

    def __init__(
        self,
        scenery: Scenery | None = None,
        *,
        price: float | None = None,
        find: float = 1.0,
        belief: bool = False,
        glimpse: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        check(render_mode in (None, "rgb_array"), "render_mode", "'rgb_array' or None", repr(render_mode))
        check(scenery is None or not options, "scenery", "no other options beside it", ", ".join(options))
        self.scenery = open_scenery(self.task, **options) if scenery is None else scenery
        worth = {"price": self.default_price if price is None else price, "find": find}
        self.gazes = GAZES[self.task](self.scenery, 1, **worth, together=False)
        self.shown: dict[str, Any] = {"belief": belief, "glimpse": glimpse}
        self.observation_space = observation_space(self.scenery, self.task, belief=belief, glimpse=glimpse)
        self.action_space = spaces.Discrete(self.scenery.shape[0] * self.scenery.shape[1])
        self.render_mode = render_mode
        self._film: Film | None = None
        self._over = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Arrays, Arrays]:
        """Start an episode, with a look from its start.

        Args:
            seed: of all draws from now on.
            options: `episode`, one of the protocol (`Scenery.episodes`), or `scene`, an index, to draw one in it.
        """
        super().reset(seed=seed)
        episode = choose(self.scenery, self.np_random, options or {})
        self.gazes.begin(_ROW, [episode])
        self._film = None if self.render_mode is None else Film(self.gazes)
        self._over = False
        return self._told()

    def step(self, action: np.int64) -> tuple[Arrays, float, bool, bool, Arrays]:
        """Shift the gaze to a cell, and look."""
        check_whole(action, "action", 0, int(self.action_space.n) - 1)  # type: ignore[attr-defined]
        if self._over:
            raise InputError("step: expected a call of reset before it, for no episode is going on")
        moved = self.gazes.move(_ROW, torch.tensor([int(action)]))
        if self._film is not None:
            self._film.add()
        terminated, truncated = bool(moved.terminated), bool(moved.truncated)
        self._over = terminated or truncated
        observation, info = self._told()
        return observation, float(moved.reward), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The last look as a picture `(H, W, 3)`: the path of the gaze, what the eye sees, what is believed."""
        if self._film is None:
            return None
        return self._film.draw()

    def action_masks(self) -> NDArray[np.bool_]:
        """Which cells were not fixated, as `sb3_contrib.MaskablePPO` asks for it."""
        free: NDArray[np.bool_] = (~self.gazes.memory.visited[0]).numpy()
        return free

    @property
    def belief_space(self) -> spaces.Box:
        """Of `planes`."""
        return belief_space(self.scenery, self.task)

    def planes(self) -> NDArray[np.float32]:
        """The belief as planes `(C + 2, Y, X)`: probabilities, which cells were fixated, and where the gaze is."""
        found: NDArray[np.float32] = believed(self.gazes, _ROW)[0]
        return found

    def glimpse(self, side: int) -> NDArray[np.uint8]:
        """What the eye is shown, `(side, side, 3)`."""
        found: NDArray[np.uint8] = glimpses(self.gazes, _ROW, side)[0]
        return found

    def _told(self) -> tuple[Arrays, Arrays]:
        return first(observe(self.gazes, _ROW, **self.shown)), first(tell(self.gazes, _ROW, detections=True))


class GazeSearch(GazeEnv):
    """Search for an object of a class: look around until the gaze is on it.

    The reward of a step is `find` where the gaze lands on a cell that an object of the class overlaps, minus `price`.
    The episode then is over, or after the most gaze shifts.

    Args:
        scenery: see `GazeEnv`, as all arguments.
    """

    task = "search"
    default_price = 0.05


class GazeExplore(GazeEnv):
    """Learn what is where: look around until the map names the class of every cell.

    The reward of a step is `find` times the rise in the map's success, the share of the cells with objects that it
    gives the class of one of them, minus `price`.

    Args:
        scenery: see `GazeEnv`, as all arguments.
    """

    task = "exploration"
    default_price = 0.01


def choose(scenery: Scenery, random: np.random.Generator, options: dict[str, Any]) -> Any:
    """The episode that options of a reset ask for, or one at random."""
    unknown = options.keys() - {"episode", "scene"}
    check(not unknown, "options", "episode or scene", ", ".join(sorted(unknown)))
    if "episode" in options:
        return options["episode"]
    if "scene" in options:
        check_whole(options["scene"], "scene", 0, len(scenery.run.scenes) - 1)
        found = scenery.episodes(int(options["scene"]))
        check(len(found) > 0, "scene", "one with anything to look for", options["scene"])
        return found[random.integers(len(found))]
    return scenery.draw(random)

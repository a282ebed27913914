"""Search and exploration with a fovea that moves from cell to cell, one episode at a time."""

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
    belief_planes,
    belief_space,
    first,
    glimpses,
    infos_of,
    observation_space,
    observations_of,
)
from semfov.envs.rendering import Film
from semfov.envs.scenery import Scenery, open_scenery
from semfov.errors import InputError, check, check_whole

_ROW = torch.tensor([0])


class GazeEnv(gymnasium.Env[Arrays, np.int64]):
    """Base of `GazeSearch` and `GazeExplore`.

    An action is a cell to fixate. The observation has `gaze` (the fixated point as fractions of width and height),
    `target` (the class index, 0 in an exploration) and `step` (the number of gaze shifts), and on request `belief` and
    `glimpse`.

    Args:
        scenery: scenes, looks and belief (`open_scenery`), which several environments may share; None opens one.
        price: cost of a look, subtracted from the reward; None takes the default of the task.
        find: reward for finding the target, or for a complete map.
        belief: whether observations contain the belief (`planes`).
        glimpse: side in pixels of the foveated image that observations contain (`glimpse`); None leaves it out.
        render_mode: `rgb_array` or None.
        options: options of `open_scenery`, where no scenery is given.

    Raises:
        InputError: an argument is out of range, or both a scenery and options are given.
        DataError: the scenes or the weights of the detector cannot be read.

    Example::

        env = GazeSearch(count=2, grid=(5, 4))
        observation, info = env.reset(seed=0)
        action = env.action_space.sample(info["action_mask"])
        observation, reward, terminated, truncated, info = env.step(action)
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
        check(scenery is None or not options, "scenery", "no options of `open_scenery` beside it", ", ".join(options))
        self.scenery = open_scenery(self.task, **options) if scenery is None else scenery
        reward = {"price": self.default_price if price is None else price, "find": find}
        self.gazes = GAZES[self.task](self.scenery, 1, **reward, together=False)
        self.shown: dict[str, Any] = {"belief": belief, "glimpse": glimpse}
        self.observation_space = observation_space(self.scenery, self.task, belief=belief, glimpse=glimpse)
        self.action_space = spaces.Discrete(self.scenery.shape[0] * self.scenery.shape[1])
        self.render_mode = render_mode
        self._film: Film | None = None
        self._over = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Arrays, Arrays]:
        """Start an episode with a look from its start.

        Args:
            seed: of all random draws from now on; None continues the present generator.
            options: `episode`, an episode of the protocol (`Scenery.episodes`), or `scene`, the index of a scene to
                draw an episode in. Without options an episode is drawn in any scene.

        Returns:
            The observation, and an info with `detections`, `passes` of the detector, `pixels` shown to it,
            `action_mask`, `result` and `scene`.

        Raises:
            InputError: an option is unknown, or the scene has nothing to look for.
        """
        super().reset(seed=seed)
        episode = choose(self.scenery, self.np_random, options or {})
        self.gazes.begin(_ROW, [episode])
        self._film = None if self.render_mode is None else Film(self.gazes)
        self._over = False
        return self._observed()

    def step(self, action: np.int64) -> tuple[Arrays, float, bool, bool, Arrays]:
        """Move the gaze to a cell, and look.

        Args:
            action: the cell, from 0 to X·Y - 1.

        Returns:
            The observation, the reward, whether the episode is over because the task is done (`terminated`) or because
            the gaze shifts are used up (`truncated`), and the info as from `reset`.

        Raises:
            InputError: there is no such cell, or no episode is in progress.
        """
        check_whole(action, "action", 0, int(self.action_space.n) - 1)  # type: ignore[attr-defined]
        if self._over:
            raise InputError("step: expected an episode in progress, got none; call reset first")
        moved = self.gazes.move(_ROW, torch.tensor([int(action)]))
        if self._film is not None:
            self._film.add()
        terminated, truncated = bool(moved.terminated), bool(moved.truncated)
        self._over = terminated or truncated
        observation, info = self._observed()
        return observation, float(moved.reward), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the last look: the scanpath, the foveated view, and the belief.

        Returns:
            RGB pixels `(H, W, 3)`; None where `render_mode` is None.
        """
        if self._film is None:
            return None
        return self._film.draw()

    def action_masks(self) -> NDArray[np.bool_]:
        """Mask of the cells that were not fixated, under the name that `sb3_contrib.MaskablePPO` expects.

        Returns:
            `(X·Y,)`, boolean.
        """
        free: NDArray[np.bool_] = (~self.gazes.memory.visited[0]).numpy()
        return free

    @property
    def belief_space(self) -> spaces.Box:
        """Space of `planes`."""
        return belief_space(self.scenery, self.task)

    def planes(self) -> NDArray[np.float32]:
        """The belief as planes over the cells.

        Returns:
            `(C + 2, Y, X)`, float32 in [0, 1]: the probability of the target (in an exploration of each class,
            background first), the cells that were fixated, and the cell of the gaze.
        """
        found: NDArray[np.float32] = belief_planes(self.gazes, _ROW)[0]
        return found

    def glimpse(self, side: int) -> NDArray[np.uint8]:
        """The foveated image that the eye sees.

        Args:
            side: width and height in pixels.

        Returns:
            `(side, side, 3)`, RGB, uint8.
        """
        found: NDArray[np.uint8] = glimpses(self.gazes, _ROW, side)[0]
        return found

    def _observed(self) -> tuple[Arrays, Arrays]:
        return first(observations_of(self.gazes, _ROW, **self.shown)), first(
            infos_of(self.gazes, _ROW, detections=True)
        )


class GazeSearch(GazeEnv):
    """Search for an object of a class: look around until the gaze is on one.

    The reward of a step is `find` if the gaze lands on a cell that an object of the class overlaps, minus `price`. The
    episode ends with the find, or after the largest number of gaze shifts.

    Args:
        scenery: this and all other arguments are those of `GazeEnv`.

    Example::

        env = GazeSearch(count=4, targets=["cat", "cup"], belief=True)
        observation, info = env.reset(seed=0)
        print(env.scenery.classes[observation["target"]], observation["belief"].shape)
    """

    task = "search"
    default_price = 0.05


class GazeExplore(GazeEnv):
    """Explore a scene: look around until the map names the class of every cell with objects.

    The reward of a step is `find` times the increase of the map's success rate, minus `price`. The success rate is the
    fraction of the cells with objects whose most probable class is that of one of these objects.

    Args:
        scenery: this and all other arguments are those of `GazeEnv`.

    Example::

        env = GazeExplore(count=4, belief=True)
        observation, info = env.reset(seed=0)
        print(info["result"], observation["belief"].shape)  # success rate after the first look, (83, 10, 10)
    """

    task = "exploration"
    default_price = 0.01


def choose(scenery: Scenery, random: np.random.Generator, options: dict[str, Any]) -> Any:
    """The episode that the options of a reset ask for, or one at random.

    Args:
        scenery: where the episode takes place.
        random: generator to draw with.
        options: `episode`, `scene`, or neither.

    Returns:
        The episode.

    Raises:
        InputError: an option is unknown, or the scene has nothing to look for.
    """
    unknown = options.keys() - {"episode", "scene"}
    check(not unknown, "options", "episode or scene", ", ".join(sorted(unknown)))
    if "episode" in options:
        return options["episode"]
    if "scene" in options:
        check_whole(options["scene"], "scene", 0, len(scenery.run.scenes) - 1)
        found = scenery.episodes(int(options["scene"]))
        check(len(found) > 0, "scene", "a scene with objects to look for", options["scene"])
        return found[random.integers(len(found))]
    return scenery.draw(random)

"""The environments for `gymnasium.make`: one episode at a time, with cells or with windows as actions."""

import copy
from collections.abc import Mapping
from typing import ClassVar, get_args

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from semfov.envs.cells import CellGazes
from semfov.envs.gazes import Arrays, GazeSettings, check_options_of_reset
from semfov.envs.scenery import Scenery, ZoomScenery, open_scenery, open_zoom_scenery, scenery_or_open
from semfov.envs.state import EnvState, check_state
from semfov.envs.windows import WindowGaze
from semfov.errors import InputError, check, former_keywords, lookup
from semfov.gaze.acquisition.base import Task

_ROW = torch.tensor([0])  # the only row of a batch of one episode


_KIND = "single environment"


class EpisodeEnv(gymnasium.Env[Arrays, object], EzPickle):
    """One episode at a time; base of `GazeEnv` and `ZoomEnv`, which differ in their actions.

    A copy, also by `pickle`, is a new environment of the same settings and scenes, which begins with a reset.

    Invariant: `_over` is false exactly while an episode is in progress: from a reset to the step that ends it.

    Args:
        gazes: a batch of one episode.
        render_mode: `rgb_array` or None.

    Attributes:
        gazes: as given.

    Raises:
        InputError: `render_mode` is something else.

    Example::

        env = gymnasium.make("semfov.envs:semfov/GazeSearch-v0")
        observation, info = env.reset(seed=0)
        assert isinstance(env.unwrapped, EpisodeEnv)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 (Gymnasium has it so)
    gazes: CellGazes | WindowGaze
    scenery: Scenery | ZoomScenery

    def __init__(self, gazes: CellGazes | WindowGaze, render_mode: str | None = None) -> None:
        check(render_mode in (None, "rgb_array"), "render_mode", "'rgb_array' or None", repr(render_mode))
        self.gazes = gazes
        self.render_mode = render_mode
        self.observation_space: spaces.Dict = gazes.observation_space
        self.action_space = gazes.action_space
        self._over = True

    def reset(self, *, seed: int | None = None, options: Mapping[str, object] | None = None) -> tuple[Arrays, Arrays]:
        """Start an episode with its first look: from its start, or at the whole picture.

        Args:
            seed: of all random draws from now on; None continues the present generator.
            options: `scene`, the index of a scene to draw an episode in. Also, where actions are cells, `episode`, an
                episode of the protocol (`Scenery.episodes`); where they are windows, `target`, the index of a class to
                search for in the scene. Without options an episode is drawn in any scene.

        Returns:
            The observation, and an info with `detections`, `passes` of the detector, `pixels` shown to it,
            `action_mask` over the cells or windows, `result` and `scene`.

        Raises:
            InputError: an option is unknown, or the scene has nothing to look for.
            DataError: no scene has anything to look for.
        """
        super().reset(seed=seed)
        check_options_of_reset(options)
        self.gazes.start(_ROW, [self.np_random], options or {})
        self._over = False
        return self._observed()

    def step(self, action: object) -> tuple[Arrays, float, bool, bool, Arrays]:
        """Move the gaze, and look.

        Args:
            action: a cell, from 0 to X·Y - 1; or `(x, y, magnification)`, each from 0 to 1.

        Returns:
            The observation, the reward, whether the episode is over because the task is done (`terminated`) or because
            the looks are used up (`truncated`), and the info as from `reset`.

        Raises:
            InputError: there is no such action, or no episode is in progress.
        """
        checked_action = self.gazes.action(action)
        if self._over:
            raise InputError("step: expected an episode in progress, got none; call reset first")
        outcome = self.gazes.move(_ROW, checked_action)
        terminated = bool(outcome.terminated)
        truncated = bool(outcome.truncated)
        self._over = terminated or truncated
        observation, info = self._observed()
        return observation, float(outcome.reward), terminated, truncated, info

    def save_state(self) -> EnvState:
        """Save the episode in progress, and the random numbers to come, for a search in the tree of actions.

        Returns:
            The state, which later steps leave as it is.

        Raises:
            InputError: no episode was started.

        Example::

            state = env.save_state()
            for action in range(env.action_space.n):
                env.restore(state)
                _, reward, *_ = env.step(action)
        """
        randoms = (copy.deepcopy(self.np_random),)
        return EnvState(_KIND, self.scenery, self.gazes.task, self.gazes.save(), randoms, (self._over,))

    def restore(self, state: EnvState) -> None:
        """Go back to a saved state; all that follows is the same, bit by bit.

        Args:
            state: a state of this environment, or of one with the same scenery and task, also where the state was
                pickled in another process. It can be restored again.

        Raises:
            InputError: it is the state of another environment.
        """
        check_state(state, _KIND, self.scenery, self.gazes.task, 1)
        self.gazes.check_saved(state.gazes)
        self.gazes.restore(state.gazes)
        self.np_random = copy.deepcopy(state.randoms[0])
        self._over = state.over[0]

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the last look: the scanpath, the foveated view and the belief, or the windows and found objects.

        Returns:
            RGB pixels `(H, W, 3)`; None where `render_mode` is None.
        """
        if self.render_mode is None or not self.gazes.episodes:
            return None
        return self.gazes.draw()

    def _observed(self) -> tuple[Arrays, Arrays]:
        """Take the observation and the info of the last look."""
        return _first(self.gazes.observe(_ROW)), _first(self.gazes.infos(_ROW))


class GazeEnv(EpisodeEnv):
    """Base of `GazeSearch` and `GazeExplore`.

    An action is a cell to fixate. The observation has `gaze` (the fixated point as fractions of width and height),
    `target` (the class index, 0 in an exploration) and `step` (the number of gaze shifts), and on request `belief` and
    `glimpse`.

    Args:
        scenery: scenes, looks and belief (`open_scenery`), which several environments may share; None opens one.
        look_cost: cost of a look, subtracted from the reward; None takes the default of the task.
        find: reward for finding the target, or for a complete map.
        belief: whether observations contain the belief, as planes `(C, Y, X)` in [0, 1].
        glimpse: side in pixels of the foveated image that observations contain; None leaves it out.
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

    task: ClassVar[Task]
    gazes: CellGazes
    scenery: Scenery

    @former_keywords
    def __init__(
        self,
        scenery: Scenery | None = None,
        *,
        look_cost: float | None = None,
        find: float = 1.0,
        belief: bool = False,
        glimpse: int | None = None,
        render_mode: str | None = None,
        **options: object,
    ) -> None:
        self.scenery = scenery_or_open(scenery, open_scenery, options, self.task)
        settings = GazeSettings(look_cost, find, belief, glimpse)
        pictures = render_mode is not None
        super().__init__(CellGazes(self.scenery, self.task, settings, pictures=pictures), render_mode)
        # The scenery instead of the options: a copy shares what the scenery has opened.
        EzPickle.__init__(
            self, self.scenery, look_cost=look_cost, find=find, belief=belief, glimpse=glimpse, render_mode=render_mode
        )

    def action_masks(self) -> NDArray[np.bool_]:
        """Mask of the cells that were not fixated, under the name that `sb3_contrib.MaskablePPO` expects.

        Returns:
            `(X·Y,)`, boolean.
        """
        return self.gazes.mask(_ROW)[0]


class GazeSearch(GazeEnv):
    """Search for an object of a class: look around until the gaze is on one.

    The reward of a step is `find` if the gaze lands on a cell that an object of the class overlaps, minus `look_cost`.
    The episode ends with the find, or after the largest number of gaze shifts.

    Args:
        scenery: this and all other arguments are those of `GazeEnv`.

    Example::

        env = GazeSearch(count=4, targets=["cat", "cup"], belief=True)
        observation, info = env.reset(seed=0)
        print(env.scenery.classes[observation["target"]], observation["belief"].shape)
    """

    task = "search"


class GazeExplore(GazeEnv):
    """Explore a scene: look around to find the classes of all cells with objects.

    The reward of a step is `find` times the increase of the map's success rate, minus `look_cost`. The success rate is
    the fraction of the cells with objects whose most probable class is that of one of these objects.

    Args:
        scenery: this and all other arguments are those of `GazeEnv`.

    Example::

        env = GazeExplore(count=4, belief=True)
        observation, info = env.reset(seed=0)
        print(info["result"], observation["belief"].shape)  # success rate after the first look, (83, 10, 10)
    """

    task = "exploration"


class ZoomEnv(EpisodeEnv):
    """Search a large picture for an object of a class, or find all objects of the class, by looks at windows.

    An action is `(x, y, magnification)`, each from 0 to 1: the middle of the window as fractions of width and height,
    and the magnification from the whole picture (0) to the closest look (1), in equal steps of an octave. The eye looks
    at the nearest window of `semfov.zoom.Lattice`. The first look of an episode is the whole picture.

    The reward of a step is `find` if an object of the class is found (a box with a score of 0.1 and an overlap of 0.5),
    or in an exploration `find` times the increase of the fraction of objects that are found; minus `look_cost`. A
    search ends with the find, or after the largest number of looks.

    Args:
        task: `search` or `exploration`.
        scenery: pictures and looks (`open_zoom_scenery`), which several environments may share; None opens one.
        look_cost: cost of a look, subtracted from the reward; None takes the default of the task.
        find: reward for finding the target, or all objects.
        belief: whether observations contain the belief, as planes `(C, Y, X)` in [0, 1].
        grid: number of columns and rows of the belief's planes.
        glimpse: side in pixels of the window's image that observations contain; None leaves it out.
        render_mode: `rgb_array` or None.
        options: options of `open_zoom_scenery`, where no scenery is given.

    Raises:
        InputError: an argument is out of range, or both a scenery and options are given.
        DataError: the pictures or the weights of the detector cannot be read.

    Example::

        env = ZoomEnv("search", scenes="aerial/", targets=["person"], detector="yolox-nano")
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    """

    gazes: WindowGaze
    scenery: ZoomScenery

    @former_keywords
    def __init__(
        self,
        task: Task,
        scenery: ZoomScenery | None = None,
        *,
        look_cost: float | None = None,
        find: float = 1.0,
        belief: bool = False,
        grid: tuple[int, int] = (10, 10),
        glimpse: int | None = None,
        render_mode: str | None = None,
        **options: object,
    ) -> None:
        lookup(task, get_args(Task), "task")
        self.scenery = scenery_or_open(scenery, open_zoom_scenery, options)
        settings = GazeSettings(look_cost, find, belief, glimpse)
        super().__init__(WindowGaze(self.scenery, task, settings, grid), render_mode)
        EzPickle.__init__(
            self,
            task,
            self.scenery,
            look_cost=look_cost,
            find=find,
            belief=belief,
            grid=grid,
            glimpse=glimpse,
            render_mode=render_mode,
        )

    def close(self) -> None:
        """Store the looks of an episode that is not over."""
        if self.gazes.done:
            self.gazes.source.save()


def _first(arrays: Arrays) -> Arrays:
    """Take the first row of each array; single numbers become numbers of Python."""
    first: Arrays = {}
    for name, array in arrays.items():
        if isinstance(array, dict):
            first[name] = _first(array)
        else:
            value = array[0]
            first[name] = value.item() if isinstance(value, np.generic) else value
    return first

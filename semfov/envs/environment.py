"""The environments for `gymnasium.make`: one episode at a time, with cells or with windows as actions."""

from collections.abc import Callable, Sequence
from inspect import signature
from typing import Any, ClassVar, TypeVar, get_args

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from semfov.envs.cells import CellGazes
from semfov.envs.gazes import Arrays, Gazes
from semfov.envs.scenery import Scenery, ZoomScenery, open_scenery, open_zoom_scenery
from semfov.envs.windows import WindowGaze
from semfov.errors import InputError, check, check_options, check_whole, lookup
from semfov.gaze.acquisition.base import Task

_Scenery = TypeVar("_Scenery", Scenery, ZoomScenery)

_ROW = torch.tensor([0])


class EpisodeEnv(gymnasium.Env[Arrays, Any], EzPickle):
    """One episode at a time; base of `GazeEnv` and `ZoomEnv`, which differ in their actions.

    A copy, also by `pickle`, is a new environment of the same settings and scenes, which begins with a reset.

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
    gazes: Gazes

    def __init__(self, gazes: Gazes, render_mode: str | None = None) -> None:
        check(render_mode in (None, "rgb_array"), "render_mode", "'rgb_array' or None", repr(render_mode))
        self.gazes, self.render_mode = gazes, render_mode
        self.observation_space: spaces.Dict = gazes.observation_space
        self.action_space = gazes.action_space
        self._over = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Arrays, Arrays]:
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
        check(options is None or isinstance(options, dict), "options", "a dictionary", f"a {type(options).__name__}")
        self.gazes.begin(_ROW, [self.gazes.choose(self.np_random, options or {})])
        self._over = False
        return self._observed()

    def step(self, action: Any) -> tuple[Arrays, float, bool, bool, Arrays]:
        """Move the gaze, and look.

        Args:
            action: a cell, from 0 to X·Y - 1; or `(x, y, magnification)`, each from 0 to 1.

        Returns:
            The observation, the reward, whether the episode is over because the task is done (`terminated`) or because
            the looks are used up (`truncated`), and the info as from `reset`.

        Raises:
            InputError: there is no such action, or no episode is in progress.
        """
        chosen = self.gazes.action(action)
        if self._over:
            raise InputError("step: expected an episode in progress, got none; call reset first")
        reward, *ends = self.gazes.move(_ROW, chosen)
        terminated, truncated = map(bool, ends)
        self._over = terminated or truncated
        observation, info = self._observed()
        return observation, float(reward), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the last look: the scanpath, the foveated view and the belief, or the windows and found objects.

        Returns:
            RGB pixels `(H, W, 3)`; None where `render_mode` is None.
        """
        if self.render_mode is None or self.gazes.episodes[0] is None:
            return None
        return self.gazes.draw()

    def _observed(self) -> tuple[Arrays, Arrays]:
        return _first(self.gazes.observe(_ROW)), _first(self.gazes.infos(_ROW))


class GazeEnv(EpisodeEnv):
    """Base of `GazeSearch` and `GazeExplore`.

    An action is a cell to fixate. The observation has `gaze` (the fixated point as fractions of width and height),
    `target` (the class index, 0 in an exploration) and `step` (the number of gaze shifts), and on request `belief` and
    `glimpse`.

    Args:
        scenery: scenes, looks and belief (`open_scenery`), which several environments may share; None opens one.
        price: cost of a look, subtracted from the reward; None takes the default of the task.
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
        self.scenery = _scenery_or_open(scenery, open_scenery, options, self.task)
        rewards: dict[str, Any] = {"price": price, "find": find, "belief": belief, "glimpse": glimpse}
        super().__init__(CellGazes(self.scenery, self.task, **rewards, pictures=render_mode is not None), render_mode)
        EzPickle.__init__(self, self.scenery, **rewards, render_mode=render_mode)

    def action_masks(self) -> NDArray[np.bool_]:
        """Mask of the cells that were not fixated, under the name that `sb3_contrib.MaskablePPO` expects.

        Returns:
            `(X·Y,)`, boolean.
        """
        return self.gazes.mask(_ROW)[0]


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


class ZoomEnv(EpisodeEnv):
    """Search a large picture for an object of a class, or find all objects of it, by windows.

    An action is `(x, y, magnification)`, each from 0 to 1: the middle of the window as fractions of width and height,
    and the magnification from the whole picture (0) to the closest look (1), in equal steps of an octave. The eye looks
    at the nearest window of `semfov.zoom.Lattice`. The first look of an episode is the whole picture.

    The reward of a step is `find` if an object of the class is found (a box with a score of 0.1 and an overlap of 0.5),
    or in an exploration `find` times the increase of the fraction of objects that are found; minus `price`. A search
    ends with the find, or after the largest number of looks.

    Args:
        task: `search` or `exploration`.
        scenery: pictures and looks (`open_zoom_scenery`), which several environments may share; None opens one.
        price: cost of a look, subtracted from the reward; None takes the default of the task.
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

    def __init__(
        self,
        task: Task,
        scenery: ZoomScenery | None = None,
        *,
        price: float | None = None,
        find: float = 1.0,
        belief: bool = False,
        grid: tuple[int, int] = (10, 10),
        glimpse: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        lookup(task, get_args(Task), "task")
        self.scenery = _scenery_or_open(scenery, open_zoom_scenery, options)
        rewards: dict[str, Any] = {"price": price, "find": find, "belief": belief, "glimpse": glimpse, "grid": grid}
        super().__init__(WindowGaze(self.scenery, task, **rewards), render_mode)
        EzPickle.__init__(self, task, self.scenery, **rewards, render_mode=render_mode)

    def close(self) -> None:
        """Store the looks of an episode that is not over."""
        if self.gazes.done:
            self.gazes.source.save()


def _scenery_or_open(
    scenery: _Scenery | None, open_it: Callable[..., _Scenery], options: dict[str, Any], *task: str
) -> _Scenery:
    """Take the scenery that is given, or open one; raises an error if both a scenery and options are given."""
    expected = f"no options of `{open_it.__name__}` beside it"
    check(scenery is None or not options, "scenery", expected, ", ".join(options))
    made = scenery is None or hasattr(scenery, "classes")
    check(made, "scenery", f"what `{open_it.__name__}` makes", f"a {type(scenery).__name__}")
    check_options(options, signature(open_it).parameters.keys() - {"task"}, f"`{open_it.__name__}`")
    return open_it(*task, **options) if scenery is None else scenery


def _first(arrays: Arrays) -> Arrays:
    one = {name: _first(value) if isinstance(value, dict) else value[0] for name, value in arrays.items()}
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in one.items()}


class GazeVectorEnv(VectorEnv[Arrays, NDArray[np.int64], NDArray[Any]], EzPickle):
    """Many episodes side by side, each in a scene of its own; a step of all is one step of the batched loop.

    With seed s, environment i does the same as a `GazeEnv` with seed s + i. With `together`, the default, learned
    beliefs of all episodes are computed at once. This is faster, but the rounding then depends on the batch.

    Args:
        task: `search` or `exploration`.
        num_envs: number of episodes.
        scenery: scenes, looks and belief, which several environments may share; None opens one.
        price: cost of a look, subtracted from the reward; None takes the default of the task.
        find: reward for finding the target, or for a complete map.
        belief: whether observations contain the belief.
        glimpse: side in pixels of the foveated image that observations contain; None leaves it out.
        detections: whether infos contain the detections.
        together: whether learned beliefs of all episodes are computed at once.
        autoreset_mode: when finished episodes restart: in the next step (`NextStep`, Gymnasium's default), in the same
            step (`SameStep`), or when a reset names them (`Disabled`).
        options: options of `open_scenery`, where no scenery is given.

    Raises:
        InputError: an argument is out of range, or both a scenery and options are given.
        DataError: the scenes or the weights of the detector cannot be read.

    Example::

        envs = GazeVectorEnv("search", 64, count=8, belief=True)
        observations, infos = envs.reset(seed=0)
        print(observations["belief"].shape)  # (64, 3, 10, 10)
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        scenery: Scenery | None = None,
        *,
        price: float | None = None,
        find: float = 1.0,
        belief: bool = False,
        glimpse: int | None = None,
        detections: bool = True,
        together: bool = True,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        check_whole(num_envs, "num_envs", 1, 1_000_000)
        known, name = [mode.value for mode in AutoresetMode], getattr(autoreset_mode, "value", autoreset_mode)
        mode = AutoresetMode(lookup(str(name), known, "autoreset_mode"))
        self.metadata = {"render_modes": [], "autoreset_mode": mode}
        self.num_envs, self.task = num_envs, lookup(task, get_args(Task), "task")
        self.scenery = _scenery_or_open(scenery, open_scenery, options, task)
        # A copy is a new environment of the same settings and scenes, which begins with a reset.
        rewards: dict[str, Any] = {"price": price, "find": find, "belief": belief, "glimpse": glimpse}
        modes = {"detections": detections, "together": together, "autoreset_mode": mode}
        EzPickle.__init__(self, task, num_envs, self.scenery, **rewards, **modes)
        self.gazes = CellGazes(self.scenery, task, num_envs, **rewards, together=together)
        self.single_observation_space = self.gazes.observation_space
        self.single_action_space = self.gazes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._detections = detections
        self._rows = torch.arange(num_envs)
        # Whether each episode was terminated, and whether it was truncated, in an earlier step.
        self._ended = torch.zeros(2, num_envs, dtype=torch.bool)
        self._randoms: list[np.random.Generator] = [seeding.np_random()[0] for _ in range(num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Arrays, Arrays]:
        """Start an episode in every environment, or in some of them.

        Args:
            seed: s, for the seeds s, s + 1, … of the environments; or one seed for each environment.
            options: `reset_mask`, a boolean for each environment, to reset only some; `episodes`, an episode of the
                protocol (`Scenery.episodes`) for each environment that is reset; or the options of `GazeEnv.reset`.

        Returns:
            The observations and infos of all environments. Each info has a mask of the environments that it applies to,
            as in Gymnasium.

        Raises:
            InputError: there are too few or too many seeds or episodes, or an option is unknown.
        """
        if seed is not None:
            seeds = (
                [int(seed) + row for row in range(self.num_envs)] if isinstance(seed, int | np.integer) else list(seed)
            )
            check(len(seeds) == self.num_envs, "seed", f"{self.num_envs} seeds, one for each environment", len(seeds))
            for row, one in enumerate(seeds):
                if one is not None:
                    self._randoms[row] = seeding.np_random(one)[0]
        check(options is None or isinstance(options, dict), "options", "a dictionary", f"a {type(options).__name__}")
        remaining = dict(options or {})
        mask = remaining.pop("reset_mask", None)
        if mask is not None:
            flags = np.asarray(mask)
            fits = flags.shape == (self.num_envs,) and flags.dtype == np.bool_ and flags.any()
            expected = f"{self.num_envs} booleans, one for each environment, at least one of them true"
            check(bool(fits), "reset_mask", expected, repr(mask))
        rows = self._rows if mask is None else torch.from_numpy(np.flatnonzero(mask))
        episodes = remaining.pop("episodes", None)
        if episodes is None:
            episodes = [self.gazes.choose(self._randoms[row], remaining) for row in rows.tolist()]
        expected = f"{len(rows)} episodes, one for each environment that is reset"
        check(len(episodes) == len(rows), "episodes", expected, len(episodes))
        episodes = [self.gazes.choose(self._randoms[0], {"episode": each}) for each in episodes]
        self.gazes.begin(rows, episodes)
        self._ended[:, rows] = False
        return self._observed()

    def step(self, actions: NDArray[np.int64]) -> tuple[Arrays, NDArray[Any], NDArray[Any], NDArray[Any], Arrays]:
        """Move the gaze of every episode, and look.

        Args:
            actions: `(num_envs,)`, cells.

        Returns:
            Observations, rewards, terminated, truncated and infos, each for all environments. What a finished episode
            does depends on `autoreset_mode`.

        Raises:
            InputError: the actions are not `num_envs` cells.
        """
        cells = int(self.gazes.action_space.n)
        inside = self.action_space.contains(np.asarray(actions))
        check(inside, "actions", f"{self.num_envs} cells from 0 to {cells - 1}", repr(actions))
        chosen = torch.as_tensor(np.asarray(actions), dtype=torch.int64)
        mode, over = self.metadata["autoreset_mode"], self._ended.any(0)
        reward, last = torch.zeros(self.num_envs, dtype=torch.float64), {}
        going, resting = (~over).nonzero()[:, 0], over.nonzero()[:, 0]
        if len(going):
            reward[going], *ends = self.gazes.move(going, chosen[going])
            self._ended[:, going] = torch.stack(ends)
        if mode == AutoresetMode.NEXT_STEP:
            self._restart(resting)
            self._ended[:, resting] = False
        terminated, truncated = self._ended.numpy().copy()
        if mode == AutoresetMode.SAME_STEP:
            ended = self._ended.any(0).nonzero()[:, 0]
            if len(ended):  # Gymnasium keeps the last observations and infos where a reset follows at once
                observations = self.gazes.observe(ended)
                each = np.full(self.num_envs, None, dtype=object)
                for number, row in enumerate(ended.tolist()):
                    each[row] = {name: value[number] for name, value in observations.items()}
                infos = self.gazes.infos(self._rows, detections=self._detections)
                last = _marked({"final_obs": each, "final_info": infos}, self._ended.any(0).numpy())
                self._restart(ended)
                self._ended[:] = False
        observation, info = self._observed()
        return observation, reward.numpy(), terminated, truncated, info | last

    def action_masks(self) -> NDArray[np.bool_]:
        """Mask of the cells that were not fixated.

        Returns:
            `(num_envs, X·Y)`, boolean.
        """
        return self.gazes.mask(self._rows)

    def _restart(self, rows: Tensor) -> None:
        if len(rows):
            self.gazes.begin(rows, [self.gazes.choose(self._randoms[row], {}) for row in rows.tolist()])

    def _observed(self) -> tuple[Arrays, Arrays]:
        infos = self.gazes.infos(self._rows, detections=self._detections)
        return self.gazes.observe(self._rows), _marked(infos, np.ones(self.num_envs, dtype=bool))


def _marked(infos: Arrays, which: NDArray[np.bool_]) -> Arrays:
    """Infos, each with a mask of the environments that it applies to."""
    marked: Arrays = {}
    for name, value in infos.items():
        marked[name] = _marked(value, which) if isinstance(value, dict) else value
        marked[f"_{name}"] = which.copy()
    return marked

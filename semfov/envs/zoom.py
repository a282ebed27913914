"""Large pictures, one episode at a time: a look is a choice of where to look and how closely."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch.nn.functional import adaptive_avg_pool2d, adaptive_max_pool2d, interpolate

from semfov.envs.observation import Arrays, detection_arrays, first, glimpse_space
from semfov.envs.zoom_scenery import ZoomScenery, open_zoom_scenery
from semfov.errors import InputError, check, check_number, check_whole
from semfov.experiments.zoom_orders import overview
from semfov.viz.animation import render
from semfov.viz.zoom import plot_zoom_path
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.glances import Glance, Window, on_lattice
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge
from semfov.zoom.path import ZoomPath
from semfov.zoom.policy import best_find, best_hit

Action = NDArray[np.float32]

_SHOWN_SIDE = 1280  # longer side in pixels of rendered pictures


class ZoomEnv(gymnasium.Env[Arrays, Action]):
    """Base of `ZoomSearch` and `ZoomExplore`.

    An action is `(x, y, magnification)`, each from 0 to 1: the middle of the window as fractions of width and height,
    and the magnification from the whole picture (0) to the closest look (1), in equal steps of an octave. The eye looks
    at the nearest window of `semfov.zoom.Lattice`. The first look of an episode is the whole picture.

    Args:
        scenery: pictures and looks (`open_zoom_scenery`), which several environments may share; None opens one.
        price: cost of a look, subtracted from the reward; None takes the default of the task.
        find: reward for finding the target, or all objects.
        belief: whether observations contain the belief (`planes`).
        grid: number of columns and rows of the belief's planes.
        glimpse: side in pixels of the window's image that observations contain (`glimpse`); None leaves it out.
        render_mode: `rgb_array` or None.
        options: options of `open_zoom_scenery`, where no scenery is given.

    Raises:
        InputError: an argument is out of range, or both a scenery and options are given.
        DataError: the pictures or the weights of the detector cannot be read.

    Example::

        env = ZoomSearch(scenes="aerial/", targets=["person"], detector="yolox-nano")
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 (Gymnasium has it so)
    task: ClassVar[str]
    default_price: ClassVar[float]
    OWN: ClassVar[tuple[str, ...]] = ("price", "find", "belief", "grid", "glimpse", "render_mode")

    def __init__(
        self,
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
        check(render_mode in (None, "rgb_array"), "render_mode", "'rgb_array' or None", repr(render_mode))
        alone = scenery is None or not options
        check(alone, "scenery", "no options of `open_zoom_scenery` beside it", ", ".join(options))
        self.scenery = open_zoom_scenery(**options) if scenery is None else scenery
        self.price, self.find = self.default_price if price is None else price, find
        check_number(self.price, "price", 0, 1e9)
        check_number(find, "find", 0, 1e9)
        self.shape = grid[1], grid[0]
        self.render_mode, self._glimpse = render_mode, glimpse
        shown: dict[str, spaces.Space[Any]] = {
            "gaze": spaces.Box(0, 1, (3,), np.float32),
            "target": spaces.Discrete(len(self.scenery.classes)),
            "step": spaces.Discrete(self.scenery.passes),
        }
        if belief:
            shown["belief"] = self.belief_space
        if glimpse is not None:
            shown["glimpse"] = glimpse_space(glimpse)
        self.observation_space = spaces.Dict(shown)
        self.action_space = spaces.Box(0, 1, (3,), np.float32)
        self.seen: list[Glance] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Arrays, Arrays]:
        """Start an episode with a look at the whole picture.

        Args:
            seed: of all random draws from now on; None continues the present generator.
            options: `scene`, the index of a picture to draw an episode in, and `target`, the index of a class to search
                for in it.

        Returns:
            The observation, and an info with `detections`, `passes` of the detector, `pixels` shown to it,
            `action_mask` over the windows, `result` and `scene`.

        Raises:
            InputError: an option is unknown, or the picture cannot be searched for the class.
            DataError: no picture has anything to look for.
        """
        super().reset(seed=seed)
        asked = dict(options or {})
        scene, target = asked.pop("scene", None), asked.pop("target", None)
        check(not asked, "options", "scene or target", ", ".join(asked))
        if scene is None or target is None:
            self.scene, self.target = self.scenery.draw(self.np_random, self.task, scene)
        else:
            check_whole(scene, "scene", 0, len(self.scenery.run.scenes) - 1)
            self.scene, self.target = int(scene), int(target)
            allowed = self.scenery.episodes(self.scene) if self.task == "search" else [0]
            check(self.target in allowed, "target", f"one of {allowed}", self.target)
        self.glances = self.scenery.glances(self.scene)
        self.belief = ZoomBelief(self.glances.lattice, self.scenery.run.evidence, self.target)
        self.seen, self.done, self.passes = [], set[Window](), 0
        self._look(overview(self.glances))
        self.result, self._over = self._rate(), False
        return self._observe(), self._info()

    def step(self, action: Action) -> tuple[Arrays, float, bool, bool, Arrays]:
        """Look at a window.

        Args:
            action: `(x, y, magnification)`, each from 0 to 1.

        Returns:
            The observation, the reward, whether the episode is over because the target was found (`terminated`) or
            because the looks are used up (`truncated`), and the info as from `reset`.

        Raises:
            InputError: the action is out of range, or no episode is in progress.
        """
        given = np.asarray(action, dtype=np.float64)
        fits = given.shape == (3,) and bool(((given >= 0) & (given <= 1)).all())
        check(fits, "action", "(x, y, magnification), each from 0 to 1", action)
        if not self.seen or self._over:
            raise InputError("step: expected an episode in progress, got none; call reset first")
        self._look(window_of(self.glances.lattice, given))
        before, self.result = self.result, self._rate()
        terminated = self.task == "search" and self.result == 1
        truncated = not terminated and self.passes >= self.scenery.passes
        self._over = terminated or truncated
        if self._over:
            self.glances.save()
        reward = self.find * (self.result - before) - self.price
        return self._observe(), reward, terminated, truncated, self._info()

    def close(self) -> None:
        """Save the looks of an episode that is not over."""
        if self.seen:
            self.glances.save()

    def _look(self, window: Window) -> None:
        """Look at a window; a second look at the same window shows nothing new."""
        self.passes += 1
        self.window = window
        if window in self.done:
            return
        glance = self.glances.see([window])[0]
        self.seen.append(glance)
        self.done.add(window)
        self.belief.add(glance)

    def _rate(self) -> float:
        if self.task == "search":
            return float(self.scenery.found(self.seen, self.scene, self.target))
        return self.scenery.share(self.seen, self.scene)

    def _observe(self) -> Arrays:
        shown: Arrays = {"gaze": self.action_of(self.window), "target": self.target, "step": self.passes - 1}
        if "belief" in self.observation_space.spaces:  # type: ignore[attr-defined]
            shown["belief"] = self.planes()
        if self._glimpse is not None:
            shown["glimpse"] = self.glimpse(self._glimpse)
        return shown

    def _info(self) -> Arrays:
        lattice = self.glances.lattice
        free = np.zeros(self.scenery.windows, dtype=np.int8)
        free[: len(lattice)] = 1
        for window in self.done:
            free[lattice.number(window.level, *window.cells[:2])] = 0
        seen = next(glance for glance in self.seen if glance.window == self.window).detections
        return {
            "passes": self.passes,
            "pixels": self.passes * self.scenery.pixels,
            "action_mask": free,
            "result": self.result,
            "scene": self.scene,
            "detections": first(detection_arrays(seen, self.scenery.run.eye.detector)),
        }

    @property
    def belief_space(self) -> spaces.Box:
        """Space of `planes`."""
        return spaces.Box(0, 1, (2, *self.shape), np.float32)

    def planes(self) -> NDArray[np.float32]:
        """The belief as planes over the picture.

        Returns:
            `(2, Y, X)`, float32 in [0, 1]: the probability that closer looks find an object, and how closely each place
            was looked at.
        """
        lattice = self.glances.lattice
        expected = [self.belief.expected(level) for level in range(1, lattice.levels)]
        most = torch.stack(expected).amax(0) if expected else torch.zeros(lattice.rows, lattice.columns)
        # Objects of each place: the mean of its cells times their number.
        count = adaptive_avg_pool2d(most[None], self.shape) * most.numel() / (self.shape[0] * self.shape[1])
        looked = torch.zeros(1, lattice.rows, lattice.columns)
        for window in self.done:
            x1, y1, x2, y2 = window.cells
            looked[0, y1:y2, x1:x2] = looked[0, y1:y2, x1:x2].clamp(min=(window.level + 1) / lattice.levels)
        near = adaptive_max_pool2d(looked, self.shape)
        found: NDArray[np.float32] = torch.cat([1 - torch.exp(-count), near]).clamp(0, 1).numpy()
        return found

    def glimpse(self, side: int) -> NDArray[np.uint8]:
        """The image of the present window that the eye sees.

        Args:
            side: width and height in pixels.

        Returns:
            `(side, side, 3)`, RGB, uint8.
        """
        eye = self.scenery.run.eye
        view = eye.open(self.scenery.image(self.scene))
        canvas = eye.glimpse(view, torch.tensor([self.window.fixation], dtype=torch.float64))[0]
        shown = interpolate(canvas, (side, side), mode="bilinear", antialias=True)[0].clamp(0, 1)
        return np.ascontiguousarray(shown.mul(255).round().byte().permute(1, 2, 0).numpy())

    def action_of(self, window: Window) -> Action:
        """The action that looks at a window.

        Args:
            window: window of the lattice.

        Returns:
            `(x, y, magnification)`, each from 0 to 1.
        """
        lattice, (x, y, _) = self.glances.lattice, window.fixation
        level = window.level / max(lattice.levels - 1, 1)
        return np.clip([(x + 0.5) / lattice.size[0], (y + 0.5) / lattice.size[1], level], 0, 1).astype(np.float32)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the windows that were looked at, and the objects that were found.

        Returns:
            RGB pixels `(H, W, 3)`; None where `render_mode` is None.
        """
        if self.render_mode is None:
            return None
        target = self.target or None
        path = ZoomPath(
            lattice=self.glances.lattice,
            classes=self.scenery.classes,
            target=target,
            glances=tuple(self.seen),
            values=(float("inf"),) * len(self.seen),
            objects=merge(self.seen, target),
        )
        image = self.scenery.image(self.scene)[None]
        share = min(1.0, _SHOWN_SIDE / max(image.shape[-2:]))
        size = [max(1, round(n * share)) for n in image.shape[-2:]]
        return render([plot_zoom_path(path, interpolate(image, size, mode="bilinear", antialias=True)[0])])[0]


class ZoomSearch(ZoomEnv):
    """Search a large picture for an object of a class: look closer until a look shows one.

    The reward of a step is `find` if an object of the class is found (a box with a score of 0.1 and an overlap of 0.5),
    minus `price`. The episode ends with the find, or after the largest number of looks.

    Args:
        scenery: this and all other arguments are those of `ZoomEnv`.

    Example::

        env = ZoomSearch(mosaics=2, targets=["cat"])
        observation, info = env.reset(seed=0)
        print(env.scenery.classes[observation["target"]], info["passes"])
    """

    task = "search"
    default_price = 0.05


class ZoomExplore(ZoomEnv):
    """Find all objects of a large picture.

    The reward of a step is `find` times the increase of the fraction of objects that are found, minus `price`.

    Args:
        scenery: this and all other arguments are those of `ZoomEnv`.

    Example::

        env = ZoomExplore(mosaics=2)
        observation, info = env.reset(seed=0)
        print(info["result"])  # fraction of the objects that the whole picture shows
    """

    task = "exploration"
    default_price = 0.01


class ZoomPolicyAgent:
    """The choice of windows of `semfov.zoom` as an agent.

    Args:
        env: a `ZoomEnv`, wrapped or not.

    Raises:
        InputError: the environment is of another kind.

    Example::

        env = gymnasium.make("semfov.envs:semfov/GazeSearch-v0", action="window")
        agent = ZoomPolicyAgent(env)
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(agent(observation, info))
    """

    def __init__(self, env: Any) -> None:
        inner = env.unwrapped
        if not isinstance(inner, ZoomEnv):
            raise InputError(f"env: expected a ZoomEnv, got {type(inner).__name__}")
        self._env = inner

    def __call__(self, observation: Any = None, info: Any = None) -> Action:
        """Choose the next action; the whole picture again where no other window is expected to show anything."""
        env, belief = self._env, self._env.belief
        searching = env.task == "search"
        choice = best_hit(belief, env.done) if searching else best_find(belief, env.done, belief.foresight)
        return env.action_of(overview(env.glances) if choice is None else choice[0])


def window_of(lattice: Lattice, action: NDArray[np.float64]) -> Window:
    """The window of the lattice that is nearest to an action.

    Args:
        lattice: windows of the picture.
        action: `(x, y, magnification)`, each from 0 to 1.

    Returns:
        The window.

    >>> window_of(Lattice.over((2560, 1920), (416, 416)), np.array([0.5, 0.5, 1.0])).cells
    (12, 8, 20, 16)
    """
    level = round(float(action[2]) * (lattice.levels - 1))
    places, pitch, window = lattice.places(level), lattice.pitch, lattice.window(level)
    column, row = (
        min(
            max(round((float(action[axis]) * lattice.size[axis] - window[axis] / 2) / pitch[axis]), 0), places[axis] - 1
        )
        for axis in (0, 1)
    )
    return on_lattice(lattice, (level, column, row))

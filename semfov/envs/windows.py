"""Gazes that move from window to window of a large picture: a choice of where to look and how closely."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, adaptive_max_pool2d, interpolate

from semfov.agents.episode import Goal
from semfov.agents.window_episode import GivenWindows
from semfov.detection.detections import Detections
from semfov.envs.gazes import Gazes
from semfov.envs.scenery import ZoomScenery
from semfov.errors import check, check_whole
from semfov.viz.animation import render
from semfov.viz.scanpath import plot_scanpath
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window

_PICTURE_SIDE = 1280  # longer side in pixels of rendered pictures


class _WindowEpisode(NamedTuple):
    """A search in a large picture, or its exploration, for which the target is 0."""

    scene: int
    target: int


class WindowGaze(Gazes):
    """An episode in a large picture, whose first look is the whole picture; one at a time, as it has its own belief."""

    coordinates = 3
    scenery: ZoomScenery
    looking: GivenWindows

    def __init__(self, scenery: ZoomScenery, task: str, *, grid: tuple[int, int] = (10, 10), **options: Any) -> None:
        self.task, self.shape = task, (grid[1], grid[0])
        # Place and magnification; a space of this type holds numbers of any other kind.
        self.action_space = spaces.Box(0, 1, (3,), np.float64)
        self.belief_space = spaces.Box(0, 1, (2, *self.shape), np.float32)
        super().__init__(scenery, task, **options)
        self.done: set[Window] = set()

    def choose(self, random: np.random.Generator, options: dict[str, Any]) -> _WindowEpisode:
        unknown = [name for name in options if name not in ("scene", "target")]
        check(not unknown, "options", "scene or target", ", ".join(unknown))
        scene, target = options.get("scene"), options.get("target")
        if scene is None or target is None:
            return _WindowEpisode(*self.scenery.draw(random, self.task, scene))
        check_whole(scene, "scene", 0, len(self.scenery.pictures) - 1)
        allowed = self.scenery.episodes(int(scene)) if self.task == "search" else [0]
        check(int(target) in allowed, "target", f"one of {allowed}", int(target))
        return _WindowEpisode(int(scene), int(target))

    def action(self, action: Any) -> Tensor:
        try:
            place = np.asarray(action, dtype=np.float64)
        except (ValueError, TypeError):  # it has no numbers
            place = np.empty(0)
        fits = self.action_space.contains(action if isinstance(action, np.ndarray) else place)
        check(fits, "action", "(x, y, magnification), each from 0 to 1", repr(action))
        return torch.from_numpy(place)[None]

    def move(self, rows: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Look at another window; the looks are stored at the end of an episode."""
        reward, terminated, truncated = super().move(rows, actions)
        if terminated or truncated:
            self.source.save()
        return reward, terminated, truncated

    def planes(self, rows: Tensor) -> NDArray[np.float32]:
        """Lay out the probability that closer looks find an object, and how closely each place was looked at."""
        lattice, belief = self.source.lattice, self.looking.session.belief
        assert belief is not None
        expected = [torch.from_numpy(belief.expected(level)) for level in range(1, lattice.levels)]
        most = torch.stack(expected).amax(0) if expected else torch.zeros(lattice.rows, lattice.columns)
        # Objects of each place: the mean of its cells times their number.
        count = adaptive_avg_pool2d(most[None], self.shape) * most.numel() / (self.shape[0] * self.shape[1])
        closeness = torch.zeros(1, lattice.rows, lattice.columns)
        for window in self.done:
            x1, y1, x2, y2 = window.cells
            closeness[0, y1:y2, x1:x2] = closeness[0, y1:y2, x1:x2].clamp(min=(window.level + 1) / lattice.levels)
        near = adaptive_max_pool2d(closeness, self.shape)
        return torch.cat([1 - torch.exp(-count), near]).clamp(0, 1).numpy()[None]

    def places(self, rows: Tensor) -> Tensor:
        return torch.from_numpy(_action_of(self.source.lattice, self.window))[None]

    def mask(self, rows: Tensor) -> NDArray[np.bool_]:
        """Windows of the picture that were not looked at, padded to the largest number of windows of any picture."""
        lattice = self.source.lattice
        free = np.zeros((1, self.scenery.windows), dtype=bool)
        free[0, : len(lattice)] = True
        for window in self.done:
            free[0, lattice.number(window.level, *window.cells[:2])] = False
        return free

    def detections(self, rows: Tensor) -> Detections:
        return next(look for look in self.looking.looks if look.shown.window == self.window).detections

    def draw(self) -> NDArray[np.uint8]:
        image = self.scenery.image(self.episodes[0].scene)[None]
        share = min(1.0, _PICTURE_SIDE / max(image.shape[-2:]))
        size = [max(1, round(n * share)) for n in image.shape[-2:]]
        small = interpolate(image, size, mode="bilinear", antialias=True)[0]
        return render([plot_scanpath(self.looking.record(), small)])[0]

    def begin(self, rows: Tensor, episodes: Sequence[_WindowEpisode]) -> None:
        super().begin(rows, episodes)
        (episode,) = episodes
        self.targets[rows] = episode.target
        self.source = self.scenery.looks_at(episode.scene)
        goal = Goal.of(self.scenery.classes, episode.target or None)
        self.looking = GivenWindows(goal, self.scenery.evidence, self.source)
        self.done = set()
        self._see(Window.overview(self.source.lattice))

    def _look(self, rows: Tensor, actions: Tensor) -> Tensor:
        self._see(_window_of(self.source.lattice, actions[0].numpy()))
        return (self.result == 1) & self.searching

    def _see(self, window: Window) -> None:
        """Look at a window, unless it was looked at, and rate the looks."""
        self.window = window
        if window not in self.done:
            self.looking.look(window)
            self.done.add(window)
        scene, target = self.episodes[0]
        looks = [look.shown for look in self.looking.looks]
        result = self.scenery.found(looks, scene, target) if target else self.scenery.share(looks, scene)
        self.result = torch.tensor([result], dtype=torch.float64)

    def _view(self, row: int) -> Tensor:
        eye = self.scenery.eye
        view = eye.open(self.scenery.image(self.episodes[row].scene))
        return eye.glimpse(view, torch.tensor([self.window.fixation], dtype=torch.float64))[0]


def _window_of(lattice: Lattice, action: NDArray[np.float64]) -> Window:
    """Find the window of the lattice that is nearest to an action."""
    level = round(float(action[2]) * (lattice.levels - 1))
    places, pitch, window = lattice.places(level), lattice.pitch, lattice.window(level)
    column, row = (
        min(
            max(round((float(action[axis]) * lattice.size[axis] - window[axis] / 2) / pitch[axis]), 0), places[axis] - 1
        )
        for axis in (0, 1)
    )
    return Window.on(lattice, (level, column, row))


def _action_of(lattice: Lattice, window: Window) -> NDArray[np.float32]:
    """Find the action that looks at a window; → `(x, y, magnification)`."""
    x, y, _ = window.fixation
    level = window.level / max(lattice.levels - 1, 1)
    return np.clip([(x + 0.5) / lattice.size[0], (y + 0.5) / lattice.size[1], level], 0, 1).astype(np.float32)

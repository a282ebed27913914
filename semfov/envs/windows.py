"""Gazes that move from window to window of a large picture: a choice of where to look and how closely."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, SupportsInt

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, adaptive_max_pool2d, interpolate

from semfov.agents.episode import Goal
from semfov.agents.window_episode import GivenWindows
from semfov.detection.detections import Detections
from semfov.envs.gazes import Gazes, GazeSettings, Outcome, scene_number
from semfov.envs.scenery import ZoomScenery
from semfov.errors import InputError, check
from semfov.gaze.acquisition.base import Task
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.viz.animation import render
from semfov.viz.scanpath import plot_scanpath
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window

_PICTURE_SIDE = 1280  # longer side in pixels of rendered pictures


class _WindowEpisode(NamedTuple):
    """A search in a large picture, or its exploration, for which the target is 0."""

    scene: int
    target: int


class _SavedLooks(NamedTuple):
    """Looks from window to window: the present window, and the different windows in their order."""

    window: Window
    windows: tuple[Window, ...]


class WindowGaze(Gazes[_WindowEpisode]):
    """An episode in a large picture, which begins with a look at the whole picture.

    Args:
        scenery: the pictures.
        task: `search` or `exploration`.
        settings: cost and reward of looks, and what observations contain.
        grid: number of columns and rows of the belief's planes.

    Attributes:
        shape: numbers of rows and columns of the belief's planes.
        source: the looks at the picture of the episode.
        looking: the looks of the episode, and its belief.
        window: the window of the last look.
        done: all windows that were looked at.

    Invariant: `source`, `looking` and `window` are there from the first start on, and `done` is empty before it.
    """

    coordinates = 3
    action_space: spaces.Box
    scenery: ZoomScenery
    source: StoredWindowLooks
    looking: GivenWindows
    window: Window

    def __init__(self, scenery: ZoomScenery, task: Task, settings: GazeSettings, grid: tuple[int, int]) -> None:
        columns, rows = grid
        self.shape = (rows, columns)
        # Place and magnification; a space of this type holds numbers of any other kind.
        self.action_space = spaces.Box(0, 1, (3,), np.float64)
        self.belief_space = spaces.Box(0, 1, (2, rows, columns), np.float32)
        super().__init__(scenery, task, settings)
        self.done: set[Window] = set()

    def choose(self, random: np.random.Generator, options: Mapping[str, object]) -> _WindowEpisode:
        unknown = options.keys() - {"scene", "target"}
        check(not unknown, "options", "scene or target", ", ".join(sorted(unknown)))
        target = options.get("target")
        if options.get("scene") is None:
            check(target is None, "target", "a scene to search for it in (scene=)", target)
            return _WindowEpisode(*self.scenery.draw(random, self.task))
        scene = scene_number(options["scene"], self.scenery)
        if target is None:
            return _WindowEpisode(*self.scenery.draw(random, self.task, scene))
        allowed = self.scenery.episodes(scene) if self.searching else [0]
        if isinstance(target, SupportsInt) and int(target) in allowed:
            return _WindowEpisode(scene, int(target))
        raise InputError(f"target: expected one of {allowed}, got {target}")

    def action(self, action: object) -> Tensor:
        place = _numbers_of(action)
        # The space warns of lists. An array is checked with its own type of numbers, but one of booleans is none.
        is_array = isinstance(action, np.ndarray) and place.size > 0
        is_action = self.action_space.contains(action if is_array else place)
        check(is_action, "action", "(x, y, magnification), each from 0 to 1", repr(action))
        return torch.from_numpy(place)[None]

    def move(self, rows: Tensor, actions: Tensor) -> Outcome:
        """Look at another window; the looks are stored at the end of an episode."""
        outcome = super().move(rows, actions)
        if outcome.terminated or outcome.truncated:
            self.source.save()
        return outcome

    def planes(self, rows: Tensor) -> NDArray[np.float32]:
        """Make planes of the probability that smaller windows show an object, and of the magnification so far."""
        # Of a number of objects that is Poisson distributed, the probability that it is not 0.
        probability = 1 - torch.exp(-self._expected_objects())  # (1, Y, X)
        closeness = adaptive_max_pool2d(self._closeness(), self.shape)  # (1, Y, X)
        return torch.cat([probability, closeness]).clamp(0, 1).numpy()[None]

    @torch.no_grad()
    def _expected_objects(self) -> Tensor:
        """Compute how many objects a closer look is expected to find in each place of the planes, `(1, Y, X)`."""
        lattice = self.source.lattice
        belief = self.looking.session.belief
        assert belief is not None
        expected = torch.zeros(lattice.rows, lattice.columns)
        if lattice.levels > 1:
            # Level 0 is the whole picture, which was looked at first.
            by_level = [belief.expected(level) for level in range(1, lattice.levels)]
            expected = torch.stack(by_level).amax(0)  # (rows, columns) of the lattice
        # Objects of each place: the mean of its cells times their number.
        rows, columns = self.shape
        mean = adaptive_avg_pool2d(expected[None], self.shape)
        return mean * expected.numel() / (rows * columns)

    def _closeness(self) -> Tensor:
        """Compute how closely each lattice cell was looked at, `(1, rows, columns)`, 1 at the closest level."""
        lattice = self.source.lattice
        closeness = torch.zeros(1, lattice.rows, lattice.columns)
        for window in self.done:
            x1, y1, x2, y2 = window.cells
            cells = closeness[0, y1:y2, x1:x2]  # a view, so that clamping it in place changes the whole
            cells.clamp_(min=(window.level + 1) / lattice.levels)
        return closeness

    def places(self, rows: Tensor) -> Tensor:
        """Compute the action that looks at the present window, `(1, 3)`."""
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
        """Picture of the windows that were looked at, and of the objects that were found."""
        image = self.scenery.image(self.episodes[0].scene)[None]
        shape = image.shape[-2:]
        reduction = min(1.0, _PICTURE_SIDE / max(shape))
        size = [max(1, round(side * reduction)) for side in shape]
        reduced = interpolate(image, size, mode="bilinear", antialias=True)[0]
        return render([plot_scanpath(self.looking.record(), reduced)])[0]

    def begin(self, rows: Tensor, episodes: Sequence[_WindowEpisode]) -> None:
        super().begin(rows, episodes)
        self._open()
        self._see(Window.overview(self.source.lattice))

    def _open(self) -> None:
        """Open the picture of the episode, before its first look."""
        (episode,) = self.episodes
        self.targets[:] = episode.target
        self.source = self.scenery.looks_at(episode.scene)
        goal = Goal.of(self.scenery.classes, episode.target or None)
        self.looking = GivenWindows(goal, self.scenery.evidence, self.source)
        self.done = set()

    def _saved_looks(self) -> _SavedLooks:
        return _SavedLooks(self.window, tuple(look.shown.window for look in self.looking.looks))

    def _restore_looks(self, looks: _SavedLooks) -> None:
        self._open()
        # The detector looks at no window again, because all looks at a picture are kept.
        for window in looks.windows:
            self.looking.look(window)
        self.done = set(looks.windows)
        self.window = looks.window

    def _look(self, rows: Tensor, actions: Tensor) -> Tensor:
        self._see(_window_of(self.source.lattice, actions[0].numpy()))
        return (self.result == 1) & self.searching

    def _see(self, window: Window) -> None:
        """Look at a window, unless it was looked at, and rate the looks."""
        self.window = window
        if window not in self.done:
            self.looking.look(window)
            self.done.add(window)
        episode = self.episodes[0]
        looks = [look.shown for look in self.looking.looks]
        if self.searching:
            result = float(self.scenery.found(looks, episode.scene, episode.target))
        else:
            result = self.scenery.share(looks, episode.scene)
        self.result = torch.tensor([result], dtype=torch.float64)

    def _view(self, row: int) -> Tensor:
        eye = self.scenery.eye
        view = eye.open(self.scenery.image(self.episodes[row].scene))
        return eye.glimpse(view, torch.tensor([self.window.fixation], dtype=torch.float64))[0]


def _numbers_of(action: object) -> NDArray[np.float64]:
    """Convert an action to numbers; empty if it has none."""
    try:
        values = np.asarray(action.detach().cpu() if isinstance(action, Tensor) else action)
    except (ValueError, TypeError):  # it has no numbers in a row
        return np.empty(0)
    return values.astype(np.float64) if values.dtype.kind in "iuf" else np.empty(0)


def _window_of(lattice: Lattice, action: NDArray[np.float64]) -> Window:
    """Find the window of the lattice that is nearest to an action `(x, y, magnification)`."""
    x, y, magnification = action.tolist()
    # Each level magnifies twice as much as the one before, and takes an equal step of the action.
    level = round(magnification * (lattice.levels - 1))
    column = _nearest_place(lattice, level, 0, x)
    row = _nearest_place(lattice, level, 1, y)
    return Window.on(lattice, (level, column, row))


def _nearest_place(lattice: Lattice, level: int, axis: int, middle: float) -> int:
    """Find the place of the window whose middle is nearest to one on an axis, a fraction of the picture's side."""
    low = middle * lattice.size[axis] - lattice.window(level)[axis] / 2
    place = round(low / lattice.pitch[axis])
    # At the borders windows lie inside the picture, so that their middles cannot reach it.
    return min(max(place, 0), lattice.places(level)[axis] - 1)


def _action_of(lattice: Lattice, window: Window) -> NDArray[np.float32]:
    """Find the action that looks at a window; → `(x, y, magnification)`."""
    x, y, _ = window.fixation
    width, height = lattice.size
    magnification = window.level / max(lattice.levels - 1, 1)
    return np.clip([(x + 0.5) / width, (y + 0.5) / height, magnification], 0, 1).astype(np.float32)

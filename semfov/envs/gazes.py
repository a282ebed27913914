"""Batches of episodes that environments step through: starts, gaze shifts, observations and rewards."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from semfov.detection.detections import Detections
from semfov.envs.scenery import Scenery, ZoomScenery
from semfov.errors import InputError, check, check_number, check_whole, type_of
from semfov.gaze.acquisition.base import Task

Arrays = dict[str, Any]
"""Arrays by name, or dictionaries of them, as Gymnasium takes observations and infos."""

_LOOK_COSTS: dict[Task, float] = {"search": 0.05, "exploration": 0.01}  # cost of a look by default


@dataclass(frozen=True)
class GazeSettings:
    """Settings of rewards and observations: cost of a look, value of a find, parts of an observation.

    A new setting is also a keyword of the environments (`semfov.envs.environment`, `semfov.envs.vector`).

    Args:
        look_cost: cost of a look, subtracted from the reward; None takes the default of the task.
        find: reward for finding the target, or for a complete result.
        belief: whether observations contain the belief.
        glimpse: side in pixels of the image that observations contain; None leaves it out.

    Raises:
        InputError: a cost, a reward or a side is out of range.
    """

    look_cost: float | None = None
    find: float = 1.0
    belief: bool = False
    glimpse: int | None = None

    def __post_init__(self) -> None:
        if self.look_cost is not None:
            check_number(self.look_cost, "look_cost", 0, 1e9)
        check_number(self.find, "find", 0, 1e9)
        if self.glimpse is not None:
            check_whole(self.glimpse, "glimpse", 1, 4096)


class _InScene(Protocol):
    """An episode in one of the scenes."""

    @property
    def scene(self) -> int:
        """Number of the scene."""


_Episode = TypeVar("_Episode", bound=_InScene)


class Outcome(NamedTuple):
    """Results of one step of n episodes: their rewards, and whether they have ended.

    Attributes:
        reward: `(n,)`.
        terminated: `(n,)` boolean, whether the task is done.
        truncated: `(n,)` boolean, whether the task is not done, and the looks are used up.
    """

    reward: Tensor
    terminated: Tensor
    truncated: Tensor


class SavedGazes(NamedTuple):
    """State of a batch of episodes.

    Attributes:
        episodes: the episodes of the rows.
        shift: `(B,)`, number of gaze shifts so far.
        result: `(B,)`, results of the last looks.
        looks: what the kind of gazes keeps of its looks.
    """

    episodes: tuple[Any, ...]
    shift: Tensor
    result: Tensor
    looks: Any


class Gazes(ABC, Generic[_Episode]):
    """A batch of B episodes, each in a row of its own.

    Invariant: `episodes` is empty before the first start, which starts all rows; from then on every row has an episode
    with at least one look, and all other attributes are those after its last look.

    Args:
        scenery: the scenes.
        task: `search` or `exploration`.
        settings: cost and reward of looks, and what observations contain.
        count: B.

    Attributes:
        episodes: the episodes of the rows.
        targets: `(B,)`, class 1..K that each row searches for; 0 in explorations.
        shift: `(B,)`, number of gaze shifts so far.
        result: `(B,)`, 1 once the target is found, or the fraction of the map that is right, or of the objects that are
            found.
        look_cost: cost of a look.
        find: reward for an increase of `result` by 1.
    """

    coordinates: ClassVar[int]
    """Number of coordinates of a gaze."""

    action_space: spaces.Space[Any]
    """Space of the actions of one episode."""

    belief_space: spaces.Box
    """Space of `planes` of one episode."""

    def __init__(self, scenery: Scenery | ZoomScenery, task: Task, settings: GazeSettings, count: int = 1) -> None:
        self.scenery = scenery
        self.task = task
        self.searching = task == "search"
        self.look_cost = _LOOK_COSTS[task] if settings.look_cost is None else settings.look_cost
        self.find = settings.find
        self.count = count
        self.episodes: list[_Episode] = []
        self.targets = torch.zeros(count, dtype=torch.int64)
        self.shift = torch.zeros(count, dtype=torch.int64)
        self.result = torch.zeros(count)
        self._side = settings.glimpse
        entries: dict[str, spaces.Space[Any]] = {
            "gaze": spaces.Box(0, 1, (self.coordinates,), np.float32),
            "target": spaces.Discrete(len(scenery.classes)),
            "step": spaces.Discrete(scenery.shifts + 1),
        }
        if settings.belief:
            entries["belief"] = self.belief_space
        if settings.glimpse is not None:
            entries["glimpse"] = spaces.Box(0, 255, (settings.glimpse, settings.glimpse, 3), np.uint8)
        self.observation_space = spaces.Dict(entries)

    @abstractmethod
    def choose(self, random: np.random.Generator, options: Mapping[str, object]) -> _Episode:
        """Choose the episode that the options of a reset ask for, or one at random."""

    @abstractmethod
    def action(self, action: object) -> Tensor:
        """Check the action of a single episode; returns a batch of one."""

    def start(self, rows: Tensor, randoms: Sequence[np.random.Generator], options: Mapping[str, object]) -> None:
        """Choose an episode for each of the rows, and start it.

        Args:
            rows: `(n,)`.
            randoms: n generators, from which episodes are drawn.
            options: options of the reset.

        Raises:
            InputError: an option is unknown, or no episode has it.
        """
        self.begin(rows, [self.choose(random, options) for random in randoms])

    def begin(self, rows: Tensor, episodes: Sequence[_Episode]) -> None:
        """Start given episodes; a kind of gazes sets the targets, makes the first looks and rates them.

        Args:
            rows: `(n,)`; at the first start all rows.
            episodes: n episodes.

        Raises:
            InputError: the first start leaves out a row.
        """
        if not self.episodes:
            check(len(rows) == self.count, "rows", f"all {self.count} rows at the first start", rows.tolist())
            self.episodes = list(episodes)
        for row, episode in zip(rows.tolist(), episodes, strict=True):
            self.episodes[row] = episode
        self.shift[rows] = 0

    def move(self, rows: Tensor, actions: Tensor) -> Outcome:
        """Move the gaze of some rows, and look.

        Args:
            rows: `(n,)`.
            actions: `(n, ...)`, as `action` gives them.

        Returns:
            The outcome of the step.
        """
        self.shift[rows] += 1
        result_before = self.result[rows]  # (n,), a copy: the look changes the results
        done = self._look(rows, actions)  # (n,)
        gain = self.result[rows] - result_before
        # An episode whose last look finds the target is done, and not cut short.
        truncated = ~done & (self.shift[rows] >= self.scenery.shifts)
        return Outcome(self.find * gain.double() - self.look_cost, done, truncated)

    def save(self) -> SavedGazes:
        """Save the state of all episodes.

        Returns:
            The state. Later steps leave it as it is.

        Raises:
            InputError: no episode was started.
        """
        if not self.episodes:
            raise InputError("save_state: expected an episode, got none; call reset first")
        return SavedGazes(tuple(self.episodes), self.shift.clone(), self.result.clone(), self._saved_looks())

    def check_saved(self, saved: SavedGazes) -> None:
        """Raise `InputError` where a saved state lacks something that these episodes need."""

    def restore(self, saved: SavedGazes) -> None:
        """Go back to a state that `save` returned.

        Args:
            saved: the state, which can be restored again.
        """
        self.episodes = list(saved.episodes)
        self._restore_looks(saved.looks)
        self.shift = saved.shift.clone()
        self.result = saved.result.clone()

    def observe(self, rows: Tensor) -> Arrays:
        """Observe some rows.

        Args:
            rows: `(n,)`.

        Returns:
            The observations, each array `(n, ...)`.
        """
        entries: Arrays = {
            "gaze": self.places(rows).float().numpy(),
            "target": self.targets[rows].numpy(),
            "step": self.shift[rows].numpy(),
        }
        if "belief" in self.observation_space.spaces:
            entries["belief"] = self.planes(rows)
        if self._side is not None:
            entries["glimpse"] = self._glimpses(rows, self._side)
        return entries

    @torch.inference_mode()
    def _glimpses(self, rows: Tensor, side: int) -> NDArray[np.uint8]:
        """Show what the eye sees in the rows `(n,)`, `(n, side, side, 3)`."""
        glimpses = []
        for row in rows.tolist():
            # Scenes have sizes of their own, so that each view is resized alone.
            glimpse = interpolate(self._view(row), (side, side), mode="bilinear", antialias=True)
            glimpses.append(glimpse)
        pixels = torch.cat(glimpses).clamp(0, 1).mul(255).round().byte()  # (n, 3, side, side)
        channels_last = pixels.permute(0, 2, 3, 1)
        return np.ascontiguousarray(channels_last.numpy())

    def infos(self, rows: Tensor, *, detections: bool = True) -> Arrays:
        """Make the entries of `info` for some rows.

        Args:
            rows: `(n,)`.
            detections: whether the detections of the present looks are among the infos.

        Returns:
            The infos, each array `(n, ...)`.
        """
        passes = self.shift[rows] + 1  # with the first look, to which no gaze shift leads
        entries: Arrays = {
            "passes": passes.numpy(),
            "pixels": (passes * self.scenery.pixels).numpy(),
            "action_mask": self.mask(rows).astype(np.int8),
            "result": self.result[rows].numpy(),
            "scene": np.array([self.episodes[row].scene for row in rows.tolist()]),
        }
        if detections:
            # Gymnasium requires infos of constant shape: as many rows as the detector can give.
            entries["detections"] = _padded(self.detections(rows), self.scenery.eye.detector.selection.limit)
        return entries

    @abstractmethod
    def _saved_looks(self) -> object:
        """Save what the looks of the episodes have shown."""

    @abstractmethod
    def _restore_looks(self, looks: Any) -> None:
        """Go back to what `_saved_looks` gave; `episodes` are those of that time."""

    @abstractmethod
    def planes(self, rows: Tensor) -> NDArray[np.float32]:
        """Lay out the belief of the rows `(n,)` as planes over the scene, `(n, C, Y, X)`."""

    @abstractmethod
    def places(self, rows: Tensor) -> Tensor:
        """Where the rows `(n,)` look, each coordinate from 0 to 1."""

    @abstractmethod
    def mask(self, rows: Tensor) -> NDArray[np.bool_]:
        """Places that the rows `(n,)` have not looked at."""

    @abstractmethod
    def detections(self, rows: Tensor) -> Detections:
        """Take the detections of the present looks, a batch of n."""

    @abstractmethod
    def draw(self) -> NDArray[np.uint8]:
        """Picture of the first episode, RGB `(H, W, 3)`."""

    @abstractmethod
    def _look(self, rows: Tensor, actions: Tensor) -> Tensor:
        """Make the next looks, and rate them; returns whether the task is done, `(n,)`."""

    @abstractmethod
    def _view(self, row: int) -> Tensor:
        """Show the image that the eye sees in a row, `(1, 3, h, w)`."""


def check_options_of_reset(options: object) -> None:
    """Raise `InputError` unless the options of a reset are a dictionary, or None."""
    check(options is None or isinstance(options, Mapping), "options", "a dictionary", type_of(options))


def scene_number(value: object, scenery: Scenery | ZoomScenery) -> int:
    """Check the number of a scene that an option of a reset asks for.

    Args:
        value: the option.
        scenery: the scenes.

    Returns:
        The number.

    Raises:
        InputError: there is no such scene.
    """
    check_whole(value, "scene", 0, len(scenery.pictures) - 1)
    return int(np.asarray(value))


def _padded(detections: Detections, limit: int) -> dict[str, NDArray[np.generic]]:
    """Convert n sets of detections to arrays `(n, limit, ...)`, which end in zeros; longer sets are kept whole."""
    arrays = {"boxes": detections.boxes, "scores": detections.scores, "mask": detections.mask}
    count = detections.mask.shape[1]
    padded: dict[str, NDArray[np.generic]] = {}
    for name, values in arrays.items():
        sizes = (len(values), max(limit, count), *values.shape[2:])
        array = np.zeros(sizes, bool if name == "mask" else np.float32)
        array[:, :count] = values.numpy()
        padded[name] = array
    return padded

"""Batches of episodes that environments step through: starts, gaze shifts, observations and rewards."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from semfov.detection.detections import Detections
from semfov.envs.scenery import Scenery, ZoomScenery
from semfov.errors import check, check_number, check_whole

Arrays = dict[str, Any]

_PRICES = {"search": 0.05, "exploration": 0.01}  # cost of a look by default, for each task


class Gazes(ABC):
    """A batch of B episodes; `result` `(B,)` is 1 once the target is found, or the fraction that is right or found."""

    coordinates: ClassVar[int]
    """Number of coordinates of a gaze."""

    action_space: Any
    """Space of the actions of one episode."""

    belief_space: spaces.Box
    """Space of `planes` of one episode."""

    def __init__(
        self,
        scenery: Scenery | ZoomScenery,
        task: str,
        count: int = 1,
        *,
        price: float | None = None,
        find: float = 1.0,
        belief: bool = False,
        glimpse: int | None = None,
        pictures: bool = False,
    ) -> None:
        price = _PRICES[task] if price is None else price
        check_number(price, "price", 0, 1e9)
        check_number(find, "find", 0, 1e9)
        self.scenery, self.price, self.find, self.pictures = scenery, price, find, pictures
        self.searching = task == "search"
        self._side, self._begun = glimpse, False
        self.episodes: list[Any] = [None] * count
        self.targets, self.shift = torch.zeros(2, count, dtype=torch.int64)
        self.result = torch.zeros(count)
        entries: dict[str, spaces.Space[Any]] = {
            "gaze": spaces.Box(0, 1, (self.coordinates,), np.float32),
            "target": spaces.Discrete(len(scenery.classes)),
            "step": spaces.Discrete(scenery.shifts + 1),
        }
        if belief:
            entries["belief"] = self.belief_space
        if glimpse is not None:
            check_whole(glimpse, "glimpse", 1, 4096)
            entries["glimpse"] = spaces.Box(0, 255, (glimpse, glimpse, 3), np.uint8)
        self.observation_space = spaces.Dict(entries)

    @abstractmethod
    def choose(self, random: np.random.Generator, options: dict[str, Any]) -> Any:
        """Choose the episode that the options of a reset ask for, or one at random."""

    @abstractmethod
    def action(self, action: Any) -> Tensor:
        """Check the action of a single episode; returns a batch of one."""

    def begin(self, rows: Tensor, episodes: Sequence[Any]) -> None:
        """Start episodes in the rows `(n,)`; a kind of gazes sets the targets, makes the first looks and rates them."""
        every = self._begun or len(rows) == len(self.episodes)
        check(every, "rows", f"all {len(self.episodes)} rows at the first start", rows.tolist())
        for row, episode in zip(rows.tolist(), episodes, strict=True):
            self.episodes[row] = episode
        self.shift[rows], self._begun = 0, True

    def move(self, rows: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Move the gaze of the rows `(n,)`, and look; reward, terminated and truncated, each `(n,)`."""
        self.shift[rows] += 1
        before = self.result[rows]
        over = self._look(rows, actions)
        gain = self.result[rows] - before
        truncated = ~over & (self.shift[rows] >= self.scenery.shifts)
        return self.find * gain.double() - self.price, over, truncated

    def observe(self, rows: Tensor) -> Arrays:
        """Observations of the rows `(n,)`, each array `(n, ...)`."""
        entries: Arrays = {
            "gaze": self.places(rows).float().numpy(),
            "target": self.targets[rows].numpy(),
            "step": self.shift[rows].numpy(),
        }
        if "belief" in self.observation_space.spaces:
            entries["belief"] = self.planes(rows)
        if self._side is not None:
            with torch.inference_mode():
                size = self._side, self._side
                views = [interpolate(self._view(row), size, mode="bilinear", antialias=True) for row in rows.tolist()]
                pixels = torch.cat(views).clamp(0, 1).mul(255).round().byte().permute(0, 2, 3, 1)
            entries["glimpse"] = np.ascontiguousarray(pixels.numpy())
        return entries

    def infos(self, rows: Tensor, *, detections: bool = True) -> Arrays:
        """Infos of the rows `(n,)`, each array `(n, ...)`."""
        passes = self.shift[rows] + 1
        entries: Arrays = {
            "passes": passes.numpy(),
            "pixels": (passes * self.scenery.pixels).numpy(),
            "action_mask": self.mask(rows).astype(np.int8),
            "result": self.result[rows].numpy(),
            "scene": np.array([self.episodes[row].scene for row in rows.tolist()]),
        }
        if detections:
            # Padded to the largest number that the detector gives: Gymnasium requires infos of constant shape.
            seen = self.detections(rows)
            limit, count = max(self.scenery.eye.detector.selection.limit, seen.mask.shape[1]), seen.mask.shape[1]
            entries["detections"] = {
                name: np.zeros((len(rows), limit, *each.shape[2:]), bool if name == "mask" else np.float32)
                for name, each in (("boxes", seen.boxes), ("scores", seen.scores), ("mask", seen.mask))
            }
            for name, array in entries["detections"].items():
                array[:, :count] = getattr(seen, name).numpy()
        return entries

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

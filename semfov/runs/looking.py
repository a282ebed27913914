"""Looks at scenes from every cell of a grid, kept on disk."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Observer
from semfov.data.scene import Scenes
from semfov.detection.detections import Detections
from semfov.episode import EpisodeLook, Looks
from semfov.errors import DataError
from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.runs.config import EyeSettings, LookingConfig
from semfov.runs.looks import photograph_looks
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import SceneRun, store_folder
from semfov.runs.setup import check_sources, make_eye, make_scenes
from semfov.runs.store import RememberedLooks, cell_store


class LookingSettings(EyeSettings, Protocol):
    """Settings of looks from every cell, as an `EyeConfig` with `cells` has them."""

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the grid."""

    @property
    def cache(self) -> Path | None:
        """Folder of the store; None: the user's cache."""

    @property
    def workers(self) -> int | None:
        """Number of processes; None: one per CPU core."""


class Looking(SceneRun):
    """Scenes, and an eye that looks at each from every cell.

    Attributes:
        config: the settings.
        cells: columns and rows of the grid.
        eye: sensor and detector.
        scenes: the scenes.
        store: the looks on disk.
    """

    config: LookingSettings

    def __init__(self, config: LookingSettings) -> None:
        self.config = config
        self.cells = config.cells
        columns, rows = config.cells
        self.check_sources()
        self.eye = make_eye(config.detector, config.sensor)
        self.scenes: Scenes = self.open_scenes()
        if not len(self.scenes):
            raise DataError("data: the settings select no scene; lower data.min_instances or raise data.limit")
        components = len(self.scenes.classes) + 1
        self.store = cell_store(store_folder(config.cache) / "looks", self.eye.settings(), columns, rows, components)

    def check_sources(self) -> None:
        """Check that the files of the scenes and of the detector exist, before any of them is loaded."""
        check_sources(self.config.data, self.config.detector)

    def open_scenes(self) -> Scenes:
        """Open the scenes of the settings; a subclass may open others."""
        return make_scenes(self.config.data, self.eye.detector.classes)

    def depends_on(self) -> dict[str, Any]:
        """List the settings of the eye, and the cells."""
        return {"eye": self.eye.settings(), "cells": [*self.cells]}

    def grid(self, index: int) -> Grid:
        """Lay the cells over a scene."""
        return Grid(*self.cells, self.scenes.annotation(index).size)

    def detections(self, index: int) -> Detections:
        """Look at a scene from every cell, or read the looks from the store.

        Args:
            index: number of the scene.

        Returns:
            The detections, a batch with a row for each cell.
        """
        looks = self.looks(index)
        detections = Detections.stack([looks(cell) for cell in range(len(self.grid(index)))])
        looks.save()
        return detections

    def looks(self, index: int) -> RememberedLooks[int | tuple[float, ...], Detections]:
        """Open a scene for looks from some of its cells or closely at boxes, or read them from the store.

        Args:
            index: number of the scene.

        Returns:
            A function from a cell, or from a box, to the detections, a batch of one; its `save` keeps the looks.
        """
        keeps_none = isinstance(self.config, LookingConfig) and not self.config.store
        return RememberedLooks(
            lambda: photograph_looks(self.eye, lambda: self.scenes[index].image[None], self.grid(index)),
            None if keeps_none else self.store,
            lambda: self.digest(index),
        )

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Look at a scene; there are no episodes, so there are no records."""
        self.detections(index)
        return [], {}

    def stored(self, index: int) -> bytes | None:
        """Return the file of the looks at a scene, which fits read."""
        tensors = self.store.read(self.digest(index))
        return None if tensors is None else pack_tensors(tensors)

    def keep(self, index: int, stored: bytes) -> None:
        """Store the looks at a scene, if this process does not see all of them."""
        if len(self.store.load(self.digest(index))) < len(self.grid(index)):
            self.store.write(self.digest(index), unpack_tensors(stored))


class CellLooks(Looks):
    """Looks at one image from the centres of its cells; each is weighed when an episode makes it.

    Attributes:
        look: gives the detections from a cell, by number.
        grid: the cells.
        like: a tensor of the type and on the device of beliefs.
        target: class that is searched for, 1..K; None for all.
    """

    def __init__(self, look: Callable[[int], Detections], grid: Grid, like: Tensor, target: int | None = None) -> None:
        self.look = look
        self.grid = grid
        self.like = like
        self.target = target

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Look, and weigh; the fixations are the centres of the cells."""
        detections = Detections.stack([self.look(number) for number in cell.tolist()])
        return EpisodeLook(observer.weigh(detections, fixation, self.grid, self.target), lambda: detections, {})

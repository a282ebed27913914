"""Looks at scenes from every cell of a grid, kept on disk."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Observer
from semfov.data.scene import Scenes
from semfov.detection.detections import Detections
from semfov.episode import EpisodeLook, Looks
from semfov.errors import DataError
from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.runs.config import LookingConfig
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import SceneRun, store_folder
from semfov.runs.setup import check_sources, make_eye, make_scenes
from semfov.runs.store import cell_store, look_everywhere


class Looking(SceneRun):
    """Scenes, and an eye that looks at each from every cell; settings are those of an `EyeConfig` with `cells`."""

    cells: tuple[int, int]

    def __init__(self, config: Any) -> None:
        self.config = config
        columns, rows = self.cells = config.cells
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
        return {"eye": self.eye.settings(), "cells": [*self.cells]}

    def grid(self, index: int) -> Grid:
        return Grid(*self.cells, self.scenes.annotation(index).size)

    def detections(self, index: int) -> Detections:
        """Detections from every cell of a scene, read from the store, or computed and stored."""
        store = None if isinstance(self.config, LookingConfig) and not self.config.store else self.store
        image, digest = (lambda: self.scenes[index].image[None]), (lambda: self.digest(index))
        return look_everywhere(self.eye, image, self.grid(index), store, digest)

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Look at a scene; there are no episodes, so there are no records."""
        self.detections(index)
        return [], {}

    def stored(self, index: int) -> bytes | None:
        """The looks at a scene, which fits read."""
        tensors = self.store.read(self.digest(index))
        return None if tensors is None else pack_tensors(tensors)

    def keep(self, index: int, stored: bytes) -> None:
        """Store the looks at a scene, if this process does not see all of them."""
        if len(self.store.load(self.digest(index))) < len(self.grid(index)):
            self.store.write(self.digest(index), unpack_tensors(stored))


class CellLooks(Looks):
    """Looks at one image from the centres of its cells; the evidence of each is weighed when an episode makes it."""

    def __init__(self, look: Callable[[int], Detections], grid: Grid, like: Tensor, target: int | None = None) -> None:
        self.look, self.grid, self.like, self.target = look, grid, like, target

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Look, and weigh; the fixations are the centres of the cells."""
        detections = Detections.stack([self.look(number) for number in cell.tolist()])
        return EpisodeLook(observer.weigh(detections, fixation, self.grid, self.target), lambda: detections, {})

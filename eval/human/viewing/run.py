"""Computes the maps of all policies along the scanpaths of all people, picture by picture."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from eval.human.viewing.config import ViewingConfig
from eval.human.viewing.follow import FineLooks, MapStore, evaluate_along
from eval.human.viewing.raster import Events, enlarged, events_of
from semfov.belief.grid import Grid
from semfov.belief.observers import Landing
from semfov.data.classes import class_index
from semfov.data.fixations import Fixations, by_picture, read_osie, read_table
from semfov.data.pictures import Pictures
from semfov.data.scene import Scenes
from semfov.detection.load import check_detector
from semfov.episode import Looks, Stopwatch, StoredLooks
from semfov.errors import DataError, InputError
from semfov.gaze.policies import ObjectSeeking, Task
from semfov.runs.candidates import Candidate
from semfov.runs.config import PolicyConfig
from semfov.runs.looks import one_thread
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.results import ResultRecord
from semfov.runs.saliency_store import SALIENCY_CLASSES
from semfov.runs.scene_run import digest_of, store_folder
from semfov.strategy import Strategy

LANDING = "landing"
"""The exploration policy `objects` with a `Landing` observer, on the cells of the raster."""


def read_people(path: Path) -> list[Fixations]:
    """Read the fixations of all people from the JSON file of OSIE or from a table."""
    return read_table(path) if path.suffix == ".csv" else read_osie(path)


class ViewingRun(PolicyLooking):
    """Free viewing, one picture after the other: computes the maps of policies along people's scanpaths."""

    task: Task = "exploration"
    config: ViewingConfig

    def __init__(self, config: ViewingConfig) -> None:
        super().__init__(config)
        cells, bins = len(self.grid(0)), config.density.columns * config.density.rows
        cache, common = store_folder(config.cache) / "viewing", self._what()
        beliefs = {name: asdict(policy) for name, policy in self.policies.items()}
        self.map_stores = {
            name: MapStore(cache, {**common, "policy": policy}, cells) for name, policy in beliefs.items()
        }
        self.map_stores[LANDING] = MapStore(cache, {**common, "policy": LANDING, "bins": bins}, bins)
        for name in config.models:
            self.map_stores[name] = MapStore(cache, {"saliency": name, "raster": self._raster_size}, bins)

    def check_sources(self) -> None:
        """Check that the detector exists; pictures are looked for after people's files have been read."""
        check_detector(self.config.detector.name)

    def open_scenes(self) -> Scenes:
        """The pictures that people saw and that are found in the folder."""
        data = self.config.data
        self.people = by_picture(each for each in read_people(self.config.people) if len(each) > 1)
        if data.limit is not None:
            self.people = dict(list(self.people.items())[: data.limit])
        return Pictures(data.root, self.people, self.eye.detector.classes)

    @property
    def _raster_size(self) -> list[int]:
        return [self.config.density.columns, self.config.density.rows]

    def _what(self) -> dict[str, object]:
        """Settings that the maps of all pictures and policies depend on."""
        grid = [self.config.belief.columns, self.config.belief.rows]
        fitted = digest_of([self.models.observation, self.models.map])
        belief = {name: value for name, value in asdict(self.config.belief).items() if not name.endswith("model")}
        eye = {"eye": self.eye.settings(), "grid": grid, "belief": belief, "fitted": fitted}
        return {**eye, "longest": self.config.longest}

    def _followed(self, index: int) -> str:
        """sha256 of a picture and of the scanpaths in it."""
        paths = [each.points.tolist() for each in self.people[str(self.scenes.ids[index])]]
        return hashlib.sha256(json.dumps([self.digest(index), paths]).encode()).hexdigest()

    @property
    def names(self) -> list[str]:
        """Names of all maps: of policies, of `landing` and of saliency models."""
        return list(self.map_stores)

    @cached_property
    def landing(self) -> Candidate:
        """The policy `landing`."""
        classes = self.scenes.classes
        try:
            person = class_index("person", classes)
        except InputError:
            person = None
        return Candidate(Strategy(Landing(len(classes), person), ObjectSeeking()))

    def raster(self, index: int) -> Grid:
        """The raster of a picture."""
        density = self.config.density
        return Grid(density.columns, density.rows, self.scenes.annotation(index).size)

    def events(self, index: int) -> Events:
        """The fixations of a picture that are to be predicted."""
        people = self.people[str(self.scenes.ids[index])]
        size = self.scenes.annotation(index).size
        for each in people:
            if each.size != size:
                raise DataError(
                    f"people: expected fixations in {each.picture} for a picture size of {size}, as in its file, got "
                    f"{each.size}; check data.root"
                )
        return events_of(people, self.raster(index), self.grid(index), self.config.longest)

    def candidate(self, name: str, index: int) -> Candidate:
        """The policy of this name in tables, for a picture."""
        return self.landing if name == LANDING else super().candidate(name, index)

    def looks(self, name: str, index: int) -> Looks:
        """The looks of a policy at a picture."""
        detections, grid = self.detections(index), self.grid(index)
        return FineLooks(detections, grid, self.raster(index)) if name == LANDING else StoredLooks(detections, grid)

    def values(self, name: str, index: int) -> Tensor:
        """Values of the cells of a picture, read from the store, or computed and stored.

        Policies with the same observer settings are evaluated together.

        Args:
            name: name of a policy or of a saliency model.
            index: index of the picture.

        Returns:
            `(E, X·Y)`, the values after each fixation of all people, or `(1, bins)` for a saliency model.
        """
        digest = self._followed(index)
        tensors = self.map_stores[name].read(digest) if self.config.store else None
        if tensors is not None:
            return tensors["values"]
        with one_thread(), torch.inference_mode():
            if name in SALIENCY_CLASSES:
                saliency = SALIENCY_CLASSES[name]()(self.scenes[index].image[None])
                columns, rows = self._raster_size
                maps = {name: F.adaptive_avg_pool2d(saliency, (rows, columns)).flatten(1)}
            else:
                events = self.events(index)
                paths = events.fine if name == LANDING else events.cells
                alike = {each: self.candidate(each, index) for each in self._alike(name)}
                maps = evaluate_along(self.looks(name, index), alike, paths)
        if self.config.store:
            for each, values in maps.items():
                self.map_stores[each].write(digest, {"values": values.float().contiguous()})
        return maps[name].float()

    def _alike(self, name: str) -> list[str]:
        """The policies with the same observer settings as this one, including itself."""
        if name == LANDING:
            return [name]

        def observing(policy: PolicyConfig) -> object:
            return policy.scores, policy.tempering, policy.footprint, policy.memory, policy.misses

        own = observing(self.policies[name])
        return [each for each, policy in self.policies.items() if observing(policy) == own]

    def maps(self, name: str, index: int) -> Tensor:
        """The values as maps `(E, H, W)` or `(1, H, W)` over the bins."""
        values, (columns, rows) = self.values(name, index), self._raster_size
        fine = values.shape[-1] == columns * rows
        return enlarged(values, self.raster(index) if fine else self.grid(index), rows, columns)

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Compute all maps of a picture; returns its number of events, and the seconds that each stage took."""
        watch = Stopwatch()
        self.detections(index)
        watch.lap("look")
        for name in self.names:
            self.values(name, index)
            watch.lap(name)
        return [{"picture": self.scenes.ids[index], "events": len(self.events(index))}], watch.seconds

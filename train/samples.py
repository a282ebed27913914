"""Labelled detections of photographs, looked at from random fixations, shard by shard, on a command's processors."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import ClassVar, Protocol, cast

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes
from semfov.detection.detections import Detections
from semfov.errors import DataError
from semfov.eye import Eye
from semfov.fit.samples import Samples, all_cells
from semfov.io.code import modules_digest
from semfov.io.schema import Field, Schema
from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.runs.config import EyeSettings
from semfov.runs.looks import LOOK_SOURCES
from semfov.runs.seeds import generator_for
from semfov.runs.setup import check_sources, make_eye, make_scenes
from semfov.runs.store import SceneStore
from semfov.runs.workers import Where, run_tasks
from semfov.threads import one_thread
from semfov.zoom.eye import WindowEye

_SOURCES = ("semfov.observation.matching", "semfov.belief.grid", "semfov.runs.seeds")
"""Modules that samples depend on, in addition to those of a look."""


def _look_from(eye: Eye, image: Tensor, points: Tensor) -> Detections:
    """Look at an image from each of several fixations.

    The views pass through the detector one at a time and on one thread. The bits then depend neither on which views
    share a batch nor on the number of CPU cores. The eye must have been made on one thread, too (`setup.make_eye`): a
    session of onnxruntime keeps the number of threads that it was opened with.

    Shapes: image `(3, H, W)`, points `(F, 2)`.
    """
    with one_thread(), torch.inference_mode():
        view = eye.open(image[None])
        return Detections.stack([eye.look(view, point[None]) for point in points])


class SamplerSettings(EyeSettings, Protocol):
    """Settings of looks from random fixations, as those of `train.fit_fom`."""

    @property
    def fixations(self) -> int:
        """Number of fixations in each photograph."""

    @property
    def iou(self) -> float:
        """Least overlap at which a detection counts as showing an object."""

    @property
    def seed(self) -> int:
        """Seed of the fixations."""

    @property
    def shard(self) -> int:
        """Number of photographs in a unit of work."""

    @property
    def where(self) -> Where:
        """The processors that do the work."""


class Sampler:
    """Looks at photographs from random fixations, shard by shard; a shard is a range of successive photographs.

    Attributes:
        config: the settings.
        eye: looks at the photographs.
        scenes: the photographs.
        shards: numbers of the shards.
        store: the labelled detections on disk.
    """

    sources: ClassVar[tuple[str, ...]] = _SOURCES
    coordinates: ClassVar[int] = 2
    """Number of numbers of a fixation."""

    def __init__(self, config: SamplerSettings, folder: Path) -> None:
        self.config = config
        check_sources(config.data, config.detector)
        self.eye, self.scenes = self.make()
        self.shards = range(-(-len(self.scenes) // config.shard))
        what = {
            "settings": self.eye.settings(),
            "scenes": self.scenes.fingerprint,
            **{name: getattr(config, name) for name in ("fixations", "iou", "seed", "shard")},
        }
        self.store = SceneStore(folder, what, modules_digest(*LOOK_SOURCES, *self.sources), self._schema())

    def _schema(self) -> Schema:
        """Describe the files of the store: the fields of `Samples`."""
        components = len(self.scenes.classes) + 1
        return Schema(
            {
                "boxes": Field(("M", 4)),
                "scores": Field(("M", components), low=0, high=1),
                "distance": Field(("M",), low=0),
                "labels": Field(("M",), torch.int64, low=0, high=components - 1),
                "look": Field(("M",), torch.int64, low=0),
                "scenes": Field(("R",), torch.int64, low=0, high=len(self.scenes) - 1),
                "fixations": Field(("R", self.coordinates)),
            }
        )

    def make(self) -> tuple[Eye | WindowEye, Scenes]:
        """Make the eye and open the scenes."""
        eye = make_eye(self.config.detector, self.config.sensor)
        return eye, make_scenes(self.config.data, eye.detector.classes)

    def cells(self, size: tuple[int, int], fixation: Tensor) -> tuple[Grid, Tensor, Tensor]:
        """Lay out the cells in which misses are counted (`semfov.fit.samples.all_cells`)."""
        return all_cells(size, fixation)

    def load(self, shard: int) -> Samples | None:
        """Read the samples of a shard; None if they are missing or damaged."""
        tensors = self.store.read(self.digest(shard))
        return None if tensors is None else Samples(**tensors)

    def save(self, shard: int, samples: Samples) -> None:
        """Store the samples of a shard."""
        self.store.write(self.digest(shard), vars(samples))

    def by_shard(self) -> Iterator[Samples]:
        """Read the samples of one shard after another, so that not all are in memory."""
        for shard in self.shards:
            samples = self.load(shard)
            if samples is None:
                path = self.store.path(self.digest(shard))
                raise DataError(f"{path} is missing or damaged; run the same command again")
            yield samples

    def drawn(self, most: int) -> Samples:
        """Draw about so many detections, each with the same probability.

        Args:
            most: number of detections.

        Returns:
            The detections with all looks; all detections if they are less.
        """
        share = most / max(sum(len(samples) for samples in self.by_shard()), 1)
        if share >= 1:
            return self.all()
        parts = []
        for shard, samples in enumerate(self.by_shard()):
            generator = generator_for("detections", self.config.seed, shard)
            parts.append(samples[torch.rand(len(samples), generator=generator) < share])
        return Samples.join(parts)

    def all(self) -> Samples:
        """Read the samples of all photographs in order."""
        return Samples.join(list(self.by_shard()))

    def scenes_of(self, shard: int) -> range:
        """Return the numbers of the photographs of a shard."""
        first = shard * self.config.shard
        return range(first, min(first + self.config.shard, len(self.scenes)))

    def digest(self, shard: int) -> str:
        """Compute a sha256 of what the pixels of a shard's photographs depend on, and of their numbers."""
        digests = [[index, self.scenes.digest(index)] for index in self.scenes_of(shard)]
        return hashlib.sha256(json.dumps(digests).encode()).hexdigest()

    def sample(self, shard: int) -> Samples:
        """Look at the photographs of a shard; returns the labelled detections."""
        return Samples.join([self._look(index) for index in self.scenes_of(shard)])

    def _look(self, index: int) -> Samples:
        """Look at a photograph from random fixations; returns the labelled detections."""
        scene = self.scenes[index]
        grid = Grid(1, 1, scene.size)
        generator = generator_for("fixations", self.config.seed, scene.id)
        points = torch.rand(self.config.fixations, 2, generator=generator) * grid.extent - 0.5
        detections = _look_from(cast(Eye, self.eye), scene.image, points)
        return Samples.of(detections, points, self.scenes.annotation(index), index, self.config.iou)


def _run_shard(sampler: Sampler, shard: int) -> bytes:
    """Look at the photographs of a shard; returns the file of the labelled detections."""
    return pack_tensors(vars(sampler.sample(shard)))


def collect_samples(config: SamplerSettings, folder: Path, title: str, kind: type[Sampler] = Sampler) -> Sampler:
    """Collect the labelled detections of all photographs; only those of shards that are not finished are computed.

    The result is the same to the last bit wherever the work is done, on processors of one kind.

    Args:
        config: the settings.
        folder: folder of the store.
        title: title of the progress bar.
        kind: what looks at the photographs.

    Returns:
        The sampler, with all shards in its store.
    """
    sampler = kind(config, folder)
    remaining = [shard for shard in sampler.shards if sampler.load(shard) is None]
    done = run_tasks(
        _run_shard,
        remaining,
        where=config.where,
        make=kind,
        settings=(config, folder),
        title=title,
        unit="picture",
        count=lambda shard: len(sampler.scenes_of(shard)),
    )
    # Closing stops the workers when this process is interrupted.
    with closing(done):
        for shard, tensors in done:
            sampler.save(shard, Samples(**unpack_tensors(tensors)))
    return sampler

"""Labelled detections: the detector's scores, the distance from the fixation, and the true class."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, cast

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Annotation, Scenes
from semfov.detection.detections import Detections
from semfov.errors import DataError
from semfov.eye import Eye
from semfov.io.schema import Field, Schema
from semfov.observation.matching import match
from semfov.runs.looks import one_thread
from semfov.runs.seeds import generator_for
from semfov.runs.setup import check_sources, make_eye, make_scenes
from semfov.runs.store import SceneStore, looks_digest
from semfov.zoom.eye import WindowEye


@dataclass(frozen=True)
class Samples:
    """Detections with their true classes, and the looks that they come from.

    Shapes: boxes `(M, 4)`, scores `(M, K+1)`, distance `(M,)`, labels `(M,)`, look `(M,)`, scenes `(R,)`, fixations
    `(R, 2)`.
    """

    boxes: Tensor
    scores: Tensor
    distance: Tensor
    labels: Tensor
    look: Tensor
    scenes: Tensor
    fixations: Tensor

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: Tensor) -> Samples:
        """Select detections; all looks are kept."""
        chosen = {name: getattr(self, name)[index] for name in _DETECTIONS}
        return Samples(**chosen, scenes=self.scenes, fixations=self.fixations)

    @property
    def scene(self) -> Tensor:
        """Index of the scene of each detection, `(M,)`."""
        return self.scenes[self.look]

    def detections_of(self, looks: slice) -> Detections:
        """The detections of successive looks, as a batch."""
        numbers = torch.arange(looks.start, looks.stop + 1)
        bounds = torch.searchsorted(self.look, numbers).tolist()
        return Detections.stack(
            [
                Detections(self.boxes[None, a:b], self.scores[None, a:b], torch.ones(1, b - a, dtype=torch.bool))
                for a, b in itertools.pairwise(bounds)
            ]
        )

    @classmethod
    @torch.inference_mode()
    def of(cls, detections: Detections, fixations: Tensor, annotation: Annotation, index: int, iou: float) -> Samples:
        """Label the detections of the looks at one scene; fixations `(R, 2)`."""
        labels = [
            match(boxes[mask], annotation.boxes, annotation.labels, iou=iou)
            for boxes, mask in zip(detections.boxes, detections.mask, strict=True)
        ]
        return cls(
            boxes=detections.boxes[detections.mask],
            scores=detections.scores[detections.mask],
            distance=Grid(1, 1, annotation.size).box_distance(detections.boxes, fixations)[detections.mask],
            labels=torch.cat(labels),
            look=detections.mask.nonzero()[:, 0],
            scenes=torch.full((len(fixations),), index),
            fixations=fixations,
        )

    @classmethod
    def join(cls, sets: list[Samples]) -> Samples:
        """Concatenate several sets of samples in order."""
        joined = {name: torch.cat([getattr(some, name) for some in sets]) for name in _NAMES}
        counts = torch.tensor([len(some.scenes) for some in sets])
        first = (counts.cumsum(0) - counts).repeat_interleave(torch.tensor([len(some) for some in sets]))
        return cls(**{**joined, "look": joined["look"] + first})


_DETECTIONS = ("boxes", "scores", "distance", "labels", "look")
_NAMES = (*_DETECTIONS, "scenes", "fixations")

_SOURCES = ("semfov.observation.matching", "semfov.belief.grid", "semfov.runs.seeds")
"""Modules that samples depend on, in addition to those of a look."""

_Cells = tuple[Grid, Tensor, Tensor]
CellsOfLook = Callable[[tuple[int, int], Tensor], _Cells]
"""Maps an image's size and a fixation to a grid for counting misses, to the distance of each cell from the fixation
`(X·Y,)` (for windows, the octaves of reduction), and to which cells the look shows, `(X·Y,)`."""


def all_cells(size: tuple[int, int], fixation: Tensor, cells: tuple[int, int] = (10, 10)) -> _Cells:
    """A grid over a whole photograph: every look shows all cells, at their distances from the fixation."""
    grid = Grid(*cells, size)
    return grid, grid.distance(fixation), torch.ones(len(grid), dtype=torch.bool)


def _look_from(eye: Eye, image: Tensor, points: Tensor) -> Detections:
    """Look at an image from each of several fixations; image `(3, H, W)`, points `(F, 2)`.

    The views pass through the detector one at a time and on one thread. The bits then depend neither on which views
    share a batch nor on the number of CPU cores. The eye must have been made on one thread, too (`setup.make_eye`): a
    session of onnxruntime keeps the number of threads that it was opened with.

    Shapes: image `(3, H, W)`, points `(F, 2)`.
    """
    with one_thread(), torch.inference_mode():
        view = eye.open(image[None])
        return Detections.stack([eye.look(view, point[None]) for point in points])


class Sampler:
    """Looks at photographs from random fixations, shard by shard; a shard is a range of successive photographs."""

    sources: ClassVar[tuple[str, ...]] = _SOURCES
    coordinates: ClassVar[int] = 2

    def __init__(self, config: Any, folder: Path) -> None:
        self.config = config
        check_sources(config.data, config.detector)
        self.eye, self.scenes = self.make()
        self.shards = range(-(-len(self.scenes) // config.shard))
        components = len(self.scenes.classes) + 1
        schema = Schema(
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
        what = {
            "settings": self.eye.settings(),
            "scenes": self.scenes.fingerprint,
            **{name: getattr(config, name) for name in ("fixations", "iou", "seed", "shard")},
        }
        self.store = SceneStore(folder, what, looks_digest(*self.sources), schema)

    def make(self) -> tuple[Eye | WindowEye, Scenes]:
        """Make the eye and open the scenes."""
        eye = make_eye(self.config.detector, self.config.sensor)
        return eye, make_scenes(self.config.data, eye.detector.classes)

    def cells(self, size: tuple[int, int], fixation: Tensor) -> _Cells:
        """The cells in which misses are counted (`CellsOfLook`)."""
        return all_cells(size, fixation)

    def load(self, shard: int) -> Samples | None:
        """The samples of a shard; None if they are missing or damaged."""
        tensors = self.store.read(self.digest(shard))
        return None if tensors is None else Samples(**tensors)

    def save(self, shard: int, samples: Samples) -> None:
        """Store the samples of a shard."""
        self.store.write(self.digest(shard), vars(samples))

    def by_shard(self) -> Iterator[Samples]:
        """The samples of one shard after another, so that not all are in memory."""
        for shard in self.shards:
            samples = self.load(shard)
            if samples is None:
                path = self.store.path(self.digest(shard))
                raise DataError(f"{path} is missing or damaged; run the same command again")
            yield samples

    def drawn(self, most: int) -> Samples:
        """About so many detections, each drawn with the same probability, with all looks; all if they are less."""
        share = most / max(sum(len(samples) for samples in self.by_shard()), 1)
        if share >= 1:
            return self.all()
        return Samples.join(
            [
                samples[
                    torch.rand(len(samples), generator=generator_for("detections", self.config.seed, shard)) < share
                ]
                for shard, samples in enumerate(self.by_shard())
            ]
        )

    def all(self) -> Samples:
        """The samples of all photographs in order."""
        return Samples.join(list(self.by_shard()))

    def scenes_of(self, shard: int) -> range:
        """The photographs of a shard."""
        first = shard * self.config.shard
        return range(first, min(first + self.config.shard, len(self.scenes)))

    def digest(self, shard: int) -> str:
        """sha256 of what the pixels of a shard's photographs depend on, and of their numbers."""
        digests = [[index, self.scenes.digest(index)] for index in self.scenes_of(shard)]
        return hashlib.sha256(json.dumps(digests).encode()).hexdigest()

    def sample(self, shard: int) -> Samples:
        """Look at the photographs of a shard; returns the labelled detections."""
        return Samples.join([self._look(index) for index in self.scenes_of(shard)])

    def _look(self, index: int) -> Samples:
        config, scene = self.config, self.scenes[index]
        grid = Grid(1, 1, scene.size)
        generator = generator_for("fixations", config.seed, scene.id)
        points = torch.rand(config.fixations, 2, generator=generator) * grid.extent - 0.5
        detections = _look_from(cast(Eye, self.eye), scene.image, points)
        return Samples.of(detections, points, self.scenes.annotation(index), index, config.iou)

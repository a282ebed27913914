"""Labelled detections of looks at windows: what the detector scored, at what magnification, and what was there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.mosaics import Mosaics
from semfov.data.scene import Annotation, Scene, Scenes
from semfov.experiments.looks import one_thread
from semfov.experiments.samples import Sampler, Samples, SampleSettings
from semfov.experiments.seeds import generator_for
from semfov.experiments.setup import make_detector, split_photographs
from semfov.experiments.zoom_store import SOURCES as GLANCES
from semfov.observation.matching import match
from semfov.zoom.eye import ZoomEye
from semfov.zoom.lattice import Lattice

COLUMNS, ROWS, TILE = 8, 6, (480, 360)
"""Photographs in a mosaic, and the size of their slots in pixels: whole, it is reduced by more than three octaves."""


@dataclass(frozen=True)
class MosaicSettings(SampleSettings):
    """What labelled detections of windows depend on.

    Attributes:
        mosaics: how many are looked at; `fixations` is the number of windows at each magnification.
        holdout: every n-th mosaic is made of every n-th photographs, the others of the others.
    """

    mosaics: int = 0
    holdout: int = 10

    def sampler(self) -> Sampler:
        """What looks."""
        return MosaicSampler(self)


class HeldOutMosaics:
    """Mosaics of which every n-th is made of photographs that no other shows.

    Args:
        kept: mosaics of all others.
        held: every n-th mosaic.
        every: n.
    """

    def __init__(self, kept: Mosaics, held: Mosaics, every: int) -> None:
        self._kept, self._held, self._every = kept, held, every
        self.classes, self.ids = kept.classes, list(kept.ids)
        self.fingerprint = f"{kept.fingerprint} {held.fingerprint} {every}"

    def __len__(self) -> int:
        return len(self.ids)

    def _of(self, index: int) -> Mosaics:
        return self._kept if index % self._every else self._held

    def __getitem__(self, index: int) -> Scene:
        """Compose a mosaic."""
        return self._of(index)[index]

    def annotation(self, index: int) -> Annotation:
        """The objects of a mosaic."""
        return self._of(index).annotation(index)

    def targets(self, index: int) -> list[int]:
        """Classes of a mosaic that may be searched for."""
        return self._of(index).targets(index)

    def digest(self, index: int) -> str:
        """sha256 of what the pixels of a mosaic depend on."""
        return self._of(index).digest(index)


class MosaicSampler(Sampler):
    """Looks at mosaics in windows of all magnifications, at random places.

    Distances of its samples are octaves: by how many the picture is reduced in the look (`Lattice.octaves`). Fixations
    are `(x, y, magnification)`.
    """

    settings: MosaicSettings
    sources = (*GLANCES, "semfov.data.mosaics", __name__)
    coordinates = 3

    def make(self) -> tuple[ZoomEye, Scenes]:
        """The eye, and the mosaics."""
        settings = self.settings
        eye = ZoomEye(make_detector(settings.detector)).eval().requires_grad_(False)
        kept, held = split_photographs(settings.data, eye.detector.classes, settings.holdout)
        near, far = (
            Mosaics(some, COLUMNS, ROWS, tile=TILE, count=settings.mosaics, seed=settings.seed) for some in (kept, held)
        )
        return eye, HeldOutMosaics(near, far, settings.holdout)

    def cells(self, size: tuple[int, int], fixation: Tensor) -> tuple[Grid, Tensor, Tensor]:
        """About the lattice's cells, the octaves of a look, and which of the cells it shows."""
        lattice = Lattice.over(size, self.eye.detector.input_size)
        grid = Grid(lattice.columns, lattice.rows, size)
        x, y, magnification = fixation.tolist()
        reach = torch.tensor(lattice.canvas) / magnification / 2
        seen = ((grid.centres - torch.tensor([x, y])).abs() <= reach).all(-1)
        octaves = max(-math.log2(magnification), 0.0)
        return grid, torch.full((len(grid),), octaves), seen

    def _look(self, index: int) -> Samples:
        scene = self.scenes[index]
        eye = cast(ZoomEye, self.eye)
        view = eye.open(scene.image)
        windows = choose_windows(view.lattice, self.settings.fixations, self.settings.seed, scene.id)
        fixations, octaves = view.lattice.fixations(windows), view.lattice.octaves[windows[:, 0]]
        annotation = self.scenes.annotation(index)
        parts = []
        with one_thread(), torch.inference_mode():
            for number in range(len(windows)):
                seen = eye.look(view, fixations[number : number + 1])
                boxes = seen.boxes[0, seen.mask[0]]
                labels = match(boxes, annotation.boxes, annotation.labels, iou=self.settings.iou)
                look = torch.zeros(len(boxes), dtype=torch.long)
                distance = octaves[number].expand(len(boxes)).clone()
                at = torch.tensor([index]), fixations[number : number + 1]
                parts.append(Samples(boxes, seen.scores[0, seen.mask[0]], distance, labels, look, *at))
        return Samples.join(parts)


def choose_windows(lattice: Lattice, count: int, seed: int, scene: object) -> Tensor:
    """Windows at random places, so many of each magnification but the first, `(R, 3)`; the first is the overview."""
    generator = generator_for("windows", seed, scene)
    rows = [torch.zeros(1, 3, dtype=torch.long)]
    for level in range(1, lattice.levels):
        across, down = lattice.places(level)
        place = torch.randint(across * down, (count,), generator=generator)
        rows.append(torch.stack([torch.full_like(place, level), place % across, place // across], -1))
    return torch.cat(rows)

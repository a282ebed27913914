"""Labelled detections in windows of large pictures: the detector's scores, the magnification, and the true class."""

from __future__ import annotations

import math
from typing import Protocol, cast

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.mosaics import Mosaics
from semfov.data.scene import ChosenScenes, Scenes
from semfov.fit.samples import Samples
from semfov.observation.matching import match
from semfov.runs.seeds import generator_for
from semfov.runs.setup import make_detector, split_photographs
from semfov.runs.zoom_store import WindowLookStore
from semfov.threads import one_thread
from semfov.zoom.eye import WindowEye
from semfov.zoom.lattice import Lattice
from train.samples import Sampler, SamplerSettings

COLUMNS, ROWS, TILE = 8, 6, (480, 360)
"""Columns and rows of a mosaic, and the size of its slots in pixels.

Such a mosaic is so large that the overview reduces it by more than three octaves.
"""


class MosaicSettings(SamplerSettings, Protocol):
    """Settings of looks at mosaics."""

    @property
    def mosaics(self) -> int:
        """Number of mosaics."""

    @property
    def holdout(self) -> int:
        """One in every n mosaics is made of held-out photographs."""


class MosaicSampler(Sampler):
    """Looks at mosaics in windows of all magnifications at random places.

    The distance of a sample is the number of octaves by which the look reduces the picture (`Lattice.octaves`).
    Fixations are `(x, y, magnification)`, so many at each magnification. Every `holdout`-th of the `mosaics` is made
    of photographs that no other mosaic shows.
    """

    sources = (*WindowLookStore.sources, "semfov.data.mosaics", __name__)
    coordinates = 3

    config: MosaicSettings

    def make(self) -> tuple[WindowEye, Scenes]:
        """Make the eye and the mosaics."""
        config = self.config
        eye = WindowEye(make_detector(config.detector)).eval().requires_grad_(False)
        training, held_out = split_photographs(config.data, eye.detector.classes, config.holdout)
        of_training = Mosaics(training, COLUMNS, ROWS, tile=TILE, count=config.mosaics, seed=config.seed)
        of_held_out = Mosaics(held_out, COLUMNS, ROWS, tile=TILE, count=config.mosaics, seed=config.seed)
        chosen = [(of_training if index % config.holdout else of_held_out, index) for index in range(len(of_training))]
        fingerprint = f"{of_training.fingerprint} {of_held_out.fingerprint} {config.holdout}"
        return eye, ChosenScenes(chosen, of_training.ids, fingerprint)

    def cells(self, size: tuple[int, int], fixation: Tensor) -> tuple[Grid, Tensor, Tensor]:
        """Lay out the lattice of a mosaic.

        Args:
            size: `(width, height)` of the mosaic.
            fixation: `(3,)`, `(x, y, magnification)`.

        Returns:
            The grid of the lattice, the octaves of a look (the same for every cell), and which cells the look shows.
        """
        lattice = Lattice.over(size, self.eye.detector.input_size)
        grid = Grid(lattice.columns, lattice.rows, size)
        x, y, magnification = fixation.tolist()
        reach = torch.tensor(lattice.canvas) / magnification / 2
        in_view = ((grid.centres - torch.tensor([x, y])).abs() <= reach).all(-1)
        octaves = max(-math.log2(magnification), 0.0)
        return grid, torch.full((len(grid),), octaves), in_view

    def _look(self, index: int) -> Samples:
        """Look at a mosaic in random windows; returns the labelled detections."""
        scene = self.scenes[index]
        eye = cast(WindowEye, self.eye)
        view = eye.open(scene.image)
        windows = _choose_windows(view.lattice, self.config.fixations, self.config.seed, scene.id)
        fixations = view.lattice.fixations(windows)
        octaves = view.lattice.octaves[windows[:, 0]]
        annotation = self.scenes.annotation(index)
        samples = []
        with one_thread(), torch.inference_mode():
            for number in range(len(windows)):
                fixation = fixations[number : number + 1]
                detections = eye.look(view, fixation)
                boxes = detections.boxes[0, detections.mask[0]]
                scores = detections.scores[0, detections.mask[0]]
                labels = match(boxes, annotation.boxes, annotation.labels, iou=self.config.iou)
                distance = octaves[number].expand(len(boxes)).clone()
                look = torch.zeros(len(boxes), dtype=torch.long)
                samples.append(Samples(boxes, scores, distance, labels, look, torch.tensor([index]), fixation))
        return Samples.join(samples)


def _choose_windows(lattice: Lattice, count: int, seed: int, scene: object) -> Tensor:
    """Draw windows `(R, 3)`: the overview, and `count` windows at random places of every other magnification."""
    generator = generator_for("windows", seed, scene)
    rows = [torch.zeros(1, 3, dtype=torch.long)]
    for level in range(1, lattice.levels):
        columns, lines = lattice.places(level)
        place = torch.randint(columns * lines, (count,), generator=generator)
        rows.append(torch.stack([torch.full_like(place, level), place % columns, place // columns], -1))
    return torch.cat(rows)

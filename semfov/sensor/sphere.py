"""Directions on a sphere, and their pixels and boxes in a panorama and in the image of a camera that turns.

Directions are unit vectors `(x, y, z)` in OpenCV's frame: x to the right, y down, z ahead. Angles are in degrees.
"""

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from semfov.errors import check, check_shape, values_known


def panorama_directions(points: Tensor, size: tuple[int, int]) -> Tensor:
    r"""Directions `(..., 3)`, unit vectors, of pixels `(..., 2)` of an equirectangular panorama.

    .. math:: \lambda = 360° \frac{x + ½}{W} - 180°, \quad \varphi = 90° - 180° \frac{y + ½}{H}, \quad
              d = (\cos\varphi \sin\lambda, -\sin\varphi, \cos\varphi \cos\lambda)

    where the longitude λ increases to the right from the middle, and the latitude φ increases upwards from the horizon.
    """
    check_shape(points, "points", 2)
    longitude = (points[..., 0] + 0.5) * (2 * torch.pi / size[0]) - torch.pi
    latitude = torch.pi / 2 - (points[..., 1] + 0.5) * (torch.pi / size[1])
    across = latitude.cos()
    return torch.stack([across * longitude.sin(), -latitude.sin(), across * longitude.cos()], -1)


def panorama_points(directions: Tensor, size: tuple[int, int]) -> Tensor:
    """Pixels `(..., 2)` of directions `(..., 3)` in an equirectangular panorama, the inverse of `panorama_directions`.

    x is from -½ to W - ½. At a pole x is arbitrary, and no gradient flows through it.
    """
    check_shape(directions, "directions", 3)
    x, y, z = directions.unbind(-1)
    squared = x.square() + z.square()
    pole = squared <= 1e-12 * (squared + y.square())
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    longitude = torch.atan2(torch.where(pole, zero, x), torch.where(pole, one, z))
    latitude = torch.atan2(-y, torch.where(pole, zero, torch.where(pole, one, squared).sqrt()))
    column = (longitude + torch.pi) * (size[0] / (2 * torch.pi)) - 0.5
    # A longitude that is rounded up to half a turn belongs to the other end of the row.
    column = torch.where(column >= size[0] - 0.5, column - size[0], column)
    return torch.stack([column, (torch.pi / 2 - latitude) * (size[1] / torch.pi) - 0.5], -1)


@dataclass(frozen=True)
class Camera:
    r"""Perspective cameras at the centre of a sphere, which turn and zoom.

    A camera turns to the right by its yaw and up by its pitch, :math:`R = R_y(\text{yaw}) R_x(\text{pitch})`. It does
    not roll. Its focal length in pixels is :math:`f = w / (2 \tan(\text{field} / 2))`. The direction of a pixel (u, v)
    is

    .. math:: d = R \, \left(\frac{u + ½ - w/2}{f}, \frac{v + ½ - h/2}{f}, 1\right)
    """

    pose: Tensor
    size: tuple[int, int]

    def __post_init__(self) -> None:
        check_shape(self.pose, "pose", 3)
        check(min(self.size) >= 1, "size", "(width, height) of at least one pixel", self.size)
        if values_known(self.pose):
            field = self.pose[..., 2].detach()
            check(bool(((field > 0) & (field < 180)).all()), "field", "degrees between 0 and 180", field.tolist())

    @property
    def focal(self) -> Tensor:
        """Focal length in pixels, `(...)`."""
        return self.size[0] / (2 * torch.deg2rad(self.pose[..., 2] / 2).tan())

    @property
    def rotation(self) -> Tensor:
        """Rotation R, `(..., 3, 3)`, from the frame of the camera to the frame of the sphere."""
        yaw, pitch = torch.deg2rad(self.pose[..., :2]).unbind(-1)
        (sy, cy), (sp, cp) = (yaw.sin(), yaw.cos()), (pitch.sin(), pitch.cos())
        rows = [cy, sy * sp, sy * cp, torch.zeros_like(cy), cp, -sp, -sy, cy * sp, cy * cp]
        return torch.stack(rows, -1).unflatten(-1, (3, 3))

    def directions(self, points: Tensor) -> Tensor:
        """Compute the directions of pixels of the camera's image."""
        check_shape(points, "points", None, 2)
        middle = points.new_tensor(self.size) / 2 - 0.5
        flat = (points - middle) / self.focal[..., None, None]
        rays = _turn(self.rotation, torch.cat([flat, torch.ones_like(flat[..., :1])], -1))
        return rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)

    def points(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the pixels of directions in the camera's image, and whether they are inside it, `(..., N, 2)`."""
        check_shape(directions, "directions", None, 3)
        rays = _turn(self.rotation.mT, directions)
        ahead = rays[..., 2] > 0
        depth = torch.where(ahead, rays[..., 2], torch.ones_like(rays[..., 2]))[..., None]
        middle = rays.new_tensor(self.size) / 2 - 0.5
        points = rays[..., :2] / depth * self.focal[..., None, None] + middle
        inside = (points >= -0.5) & (points <= points.new_tensor(self.size) - 0.5)
        return torch.where(ahead[..., None], points, torch.inf), ahead & inside.all(-1)


def _turn(rotation: Tensor, rays: Tensor) -> Tensor:
    # Autocast would compute a matrix product in 16 bits, which is less exact than a pixel.
    return (rotation[..., None, :, :] * rays[..., None, :]).sum(-1)


@dataclass(frozen=True)
class Boxes:
    """Regions of a flat scene: boxes `(M, 4)` in its pixels, edges between pixels."""

    boxes: Tensor

    def __len__(self) -> int:
        """Number of regions."""
        return len(self.boxes)

    def __getitem__(self, index: Tensor | slice) -> Self:
        """The selected regions."""
        return replace(self, boxes=self.boxes[index])

    def samples(self, count: int = 9) -> Tensor:
        """Points on a regular grid over each region, its borders included, `(M, count², D)`."""
        share = torch.linspace(0, 1, count).to(self.boxes)
        y, x = torch.meshgrid(share, share, indexing="ij")
        low, high = self.boxes[:, None, :2], self.boxes[:, None, 2:]
        return low + torch.stack([x, y], -1).flatten(0, 1) * (high - low) - 0.5

    def contain(self, points: Tensor) -> Tensor:
        """Whether each region contains each of the points `(N, D)`, `(M, N)` boolean."""
        low, high = self.boxes[:, None, :2] - 0.5, self.boxes[:, None, 2:] - 0.5
        return ((points >= low) & (points <= high)).all(-1)


@dataclass(frozen=True)
class Regions(Boxes):
    """Regions of the sphere that boxes in the images of M cameras cover, exact also at the poles and at the seam."""

    camera: Camera

    def __getitem__(self, index: Tensor | slice) -> Self:
        """The selected regions."""
        return replace(self, boxes=self.boxes[index], camera=Camera(self.camera.pose[index], self.camera.size))

    def contain(self, points: Tensor) -> Tensor:
        """Whether each region contains each of the directions `(N, 3)`, `(M, N)` boolean."""
        return super().contain(self.camera.points(points)[0])

    def samples(self, count: int = 9) -> Tensor:
        """Directions on a grid over each region, its borders included, `(M, count², 3)`."""
        return self.camera.directions(super().samples(count))

    def outlines(self, count: int = 33) -> Tensor:
        """Sample directions along the closed border of each region."""
        share = torch.linspace(0, 1, count).to(self.boxes)
        zero, one = torch.zeros_like(share), torch.ones_like(share)
        sides = [(share, zero), (one, share), (1 - share, one), (zero, 1 - share)]
        at = torch.cat([torch.stack(side, -1) for side in sides])
        low, high = self.boxes[:, None, :2], self.boxes[:, None, 2:]
        return self.camera.directions(low + at * (high - low) - 0.5)

    def panorama_boxes(self, size: tuple[int, int]) -> Tensor:
        """Compute the smallest boxes around the regions in an equirectangular panorama, `(M, 4)`.

        The edges of a region are curves in the panorama; their extremes are taken among 257 points of each edge. A
        box that crosses the seam begins inside the panorama and ends beyond its right border. A box that holds a pole
        is as wide as the panorama.
        """
        points = panorama_points(self.outlines(257), size)
        x, y = points.unbind(-1)
        width = float(size[0])
        # Neighbouring points of an outline are less than half a turn apart.
        step = (x.diff(dim=-1) + width / 2) % width - width / 2
        along = torch.cat([x[:, :1], x[:, :1] + step.cumsum(-1)], -1)
        left, right = along.amin(-1), along.amax(-1)
        poles = x.new_tensor([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        up, down = self.contain(poles).unbind(-1)
        around = up | down
        first = torch.where(around, torch.zeros_like(left), (left + 0.5) % width)
        top = torch.where(up, 0.0, y.amin(-1) + 0.5)
        bottom = torch.where(down, float(size[1]), y.amax(-1) + 0.5)
        last = torch.where(around, torch.full_like(first, width), first + right - left)
        return torch.stack([first, top, last, bottom], -1)

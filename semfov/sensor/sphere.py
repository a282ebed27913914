"""Directions on a sphere, and their pixels and boxes in a panorama and in the image of a camera that turns.

Directions are unit vectors `(x, y, z)` in OpenCV's frame: x to the right, y down, z ahead. Angles are in degrees.
"""

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from semfov.errors import check, check_shape, values_known


def panorama_directions(points: Tensor, size: tuple[int, int]) -> Tensor:
    r"""Compute the directions of pixels of an equirectangular panorama.

    .. math:: \lambda = 360° \frac{x + ½}{W} - 180°, \quad \varphi = 90° - 180° \frac{y + ½}{H}, \quad
              d = (\cos\varphi \sin\lambda, -\sin\varphi, \cos\varphi \cos\lambda)

    where the longitude λ increases to the right from the middle, and the latitude φ increases upwards from the horizon.

    Args:
        points: `(..., 2)`, in pixels of the panorama.
        size: its `(width, height)`, `(W, H)`.

    Returns:
        Unit vectors `(..., 3)`.
    """
    check_shape(points, "points", 2)
    column, row = points.unbind(-1)
    width, height = size
    longitude = (column + 0.5) * (2 * torch.pi / width) - torch.pi
    latitude = torch.pi / 2 - (row + 0.5) * (torch.pi / height)
    radius = latitude.cos()  # of the circle of latitude
    x = radius * longitude.sin()
    y = -latitude.sin()
    z = radius * longitude.cos()
    return torch.stack([x, y, z], -1)


def panorama_points(directions: Tensor, size: tuple[int, int]) -> Tensor:
    """Compute the pixels of directions in an equirectangular panorama, the inverse of `panorama_directions`.

    Args:
        directions: `(..., 3)`.
        size: `(width, height)` of the panorama, `(W, H)`.

    Returns:
        Points `(..., 2)`; x is from -½ to W - ½. At a pole x is arbitrary, and no gradient flows through it.
    """
    check_shape(directions, "directions", 3)
    width, height = size
    x, y, z = directions.unbind(-1)
    squared = x.square() + z.square()
    pole = squared <= 1e-12 * (squared + y.square())
    zero = torch.zeros_like(x)
    unit = torch.ones_like(x)
    # The inner choice keeps the gradient of the root finite where the outer one does not take it.
    radius = torch.where(pole, zero, torch.where(pole, unit, squared).sqrt())
    longitude = torch.atan2(torch.where(pole, zero, x), torch.where(pole, unit, z))
    latitude = torch.atan2(-y, radius)

    column = (longitude + torch.pi) * (width / (2 * torch.pi)) - 0.5
    row = (torch.pi / 2 - latitude) * (height / torch.pi) - 0.5
    # A longitude that is rounded up to half a turn belongs to the other end of the row.
    column = torch.where(column >= width - 0.5, column - width, column)
    return torch.stack([column, row], -1)


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
        half_field = torch.deg2rad(self.pose[..., 2] / 2)
        return self.size[0] / (2 * half_field.tan())

    @property
    def rotation(self) -> Tensor:
        """Rotation R, `(..., 3, 3)`, from the frame of the camera to the frame of the sphere."""
        yaw, pitch = torch.deg2rad(self.pose[..., :2]).unbind(-1)
        sin_yaw = yaw.sin()
        cos_yaw = yaw.cos()
        sin_pitch = pitch.sin()
        cos_pitch = pitch.cos()
        entries = [
            *(cos_yaw, sin_yaw * sin_pitch, sin_yaw * cos_pitch),
            *(torch.zeros_like(cos_yaw), cos_pitch, -sin_pitch),
            *(-sin_yaw, cos_yaw * sin_pitch, cos_yaw * cos_pitch),
        ]
        return torch.stack(entries, -1).unflatten(-1, (3, 3))

    def directions(self, points: Tensor) -> Tensor:
        """Compute the directions of pixels of the camera's image.

        Args:
            points: `(..., N, 2)`, in pixels.

        Returns:
            Unit vectors `(..., N, 3)` in the frame of the sphere.
        """
        check_shape(points, "points", None, 2)
        middle = points.new_tensor(self.size) / 2 - 0.5
        flat = (points - middle) / self.focal[..., None, None]  # (..., N, 2), at depth 1
        depth = torch.ones_like(flat[..., :1])
        rays = _turn(self.rotation, torch.cat([flat, depth], -1))
        return rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)

    def points(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the pixels of directions in the camera's image.

        Args:
            directions: `(..., N, 3)`, in the frame of the sphere.

        Returns:
            Points `(..., N, 2)`, infinite behind the camera, and whether they are inside the image, `(..., N)`.
        """
        check_shape(directions, "directions", None, 3)
        rays = _turn(self.rotation.mT, directions)
        forward = rays[..., 2]
        in_front = forward > 0
        # Behind the camera any depth does: the point is replaced below, and no gradient may divide by 0.
        depth = torch.where(in_front, forward, torch.ones_like(forward))[..., None]
        size = rays.new_tensor(self.size)
        middle = size / 2 - 0.5
        flat = rays[..., :2] / depth
        points = flat * self.focal[..., None, None] + middle
        inside = ((points >= -0.5) & (points <= size - 0.5)).all(-1)
        return torch.where(in_front[..., None], points, torch.inf), in_front & inside


def _turn(rotation: Tensor, rays: Tensor) -> Tensor:
    """Multiply rays `(..., N, 3)` by a rotation `(..., 3, 3)`."""
    # Autocast would compute a matrix product in 16 bits, which is less exact than a pixel.
    products = rotation[..., None, :, :] * rays[..., None, :]  # (..., N, 3, 3)
    return products.sum(-1)


@dataclass(frozen=True)
class Boxes:
    """Regions of a flat scene: boxes `(M, 4)` in its pixels, edges between pixels."""

    boxes: Tensor

    def __len__(self) -> int:
        """Count the regions."""
        return len(self.boxes)

    def __getitem__(self, index: Tensor | slice) -> Self:
        """Select regions."""
        return replace(self, boxes=self.boxes[index])

    def samples(self, count: int = 9) -> Tensor:
        """Place `count²` points on a regular grid over each region, its borders included, `(M, count², D)`."""
        share = torch.linspace(0, 1, count).to(self.boxes)
        y, x = torch.meshgrid(share, share, indexing="ij")
        return self._points_at(torch.stack([x, y], -1).flatten(0, 1))

    def _points_at(self, shares: Tensor) -> Tensor:
        """Compute the points `(M, P, 2)` at shares `(P, 2)` of the sides of each region, from its upper left corner."""
        corner = self.boxes[:, None, :2]  # (M, 1, 2)
        sides = self.boxes[:, None, 2:] - corner
        return corner + shares * sides - 0.5

    def contain(self, points: Tensor) -> Tensor:
        """Tell whether each region contains each of the points `(N, D)`, `(M, N)` boolean."""
        upper_left = self.boxes[:, None, :2] - 0.5
        lower_right = self.boxes[:, None, 2:] - 0.5
        return ((points >= upper_left) & (points <= lower_right)).all(-1)


@dataclass(frozen=True)
class Regions(Boxes):
    """Regions of the sphere that boxes in the images of M cameras cover, exact also at the poles and at the seam."""

    camera: Camera

    def __getitem__(self, index: Tensor | slice) -> Self:
        """Select regions."""
        return replace(self, boxes=self.boxes[index], camera=Camera(self.camera.pose[index], self.camera.size))

    def contain(self, points: Tensor) -> Tensor:
        """Tell whether each region contains each of the directions `(N, 3)`, `(M, N)` boolean."""
        pixels, _ = self.camera.points(points)  # infinite behind the camera, where no region is
        return super().contain(pixels)

    def samples(self, count: int = 9) -> Tensor:
        """Place `count²` directions on a grid over each region, its borders included, `(M, count², 3)`."""
        return self.camera.directions(super().samples(count))

    def outlines(self, count: int = 33) -> Tensor:
        """Sample directions along the closed border of each region, `count` on each side, `(M, 4 · count, 3)`."""
        share = torch.linspace(0, 1, count).to(self.boxes)
        start = torch.zeros_like(share)
        end = torch.ones_like(share)
        sides = [(share, start), (end, share), (1 - share, end), (start, 1 - share)]
        shares = torch.cat([torch.stack(side, -1) for side in sides])
        return self.camera.directions(self._points_at(shares))

    def panorama_boxes(self, size: tuple[int, int]) -> Tensor:
        """Compute the smallest boxes around the regions in an equirectangular panorama, `(M, 4)`.

        The edges of a region are curves in the panorama; their extremes are taken among 257 points of each edge. A
        box that crosses the seam begins inside the panorama and ends beyond its right border. A box that holds a pole
        is as wide as the panorama.
        """
        width = float(size[0])
        height = float(size[1])
        outline = panorama_points(self.outlines(257), size)
        x, y = outline.unbind(-1)
        # Neighbouring points of an outline are less than half a turn apart: so it goes on across the seam.
        half_turn = width / 2
        step = (x.diff(dim=-1) + half_turn) % width - half_turn
        first = x[:, :1]
        unrolled = torch.cat([first, first + step.cumsum(-1)], -1)
        leftmost = unrolled.amin(-1)
        rightmost = unrolled.amax(-1)

        poles = x.new_tensor([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        zenith, nadir = self.contain(poles).unbind(-1)
        any_pole = zenith | nadir
        x1 = torch.where(any_pole, torch.zeros_like(leftmost), (leftmost + 0.5) % width)
        x2 = torch.where(any_pole, torch.full_like(x1, width), x1 + rightmost - leftmost)
        y1 = torch.where(zenith, 0.0, y.amin(-1) + 0.5)
        y2 = torch.where(nadir, height, y.amax(-1) + 0.5)
        return torch.stack([x1, y1, x2, y2], -1)

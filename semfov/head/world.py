"""Scenes larger than the eye's field of view, seen through a window that a head moves."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.inputs import ImageLike, as_image
from semfov.data.large import LargePicture, open_large
from semfov.errors import InputError, check
from semfov.sensor.perspective import even_rows, go_around, sample
from semfov.sensor.sphere import Camera, Regions, angle_between, panorama_directions, panorama_points

VIEW = (416, 312)
"""Default `(width, height)` of a view in pixels."""

_BLANK = "picture: expected a scene with its picture to view, got its size alone, as a path from a file has it"


class Places(Protocol):
    """Regions that objects cover in a scene."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: Tensor) -> "Places":
        """The selected regions."""

    def samples(self, count: int = 9) -> Tensor:
        """Points spread over each region, its borders included, `(M, count², D)`."""

    def contain(self, points: Tensor, /) -> Tensor:
        """Whether each region contains each of the points `(N, D)`, `(M, N)` boolean."""


class World(ABC):
    """Base of the scenes that a head looks around in.

    A pose of the head has three numbers: two for the position of the window, and the field of view in degrees. A point
    of the scene has D coordinates.

    Attributes:
        scene: cells of the whole scene, in pixels of its picture.
        size: `(w, h)` of a view in pixels.
        centres: `(S, D)`, centres of the cells.
        area: `(S,)`, relative areas of the cells, 1 on average.
        closed: whether the left and the right border of the picture meet.

    >>> world = Flat(torch.rand(3, 480, 640), (40, 30), degree=8)
    >>> isinstance(world, World), [len(row) for row in world.poses(40.0)]
    (True, [3, 3, 3])
    """

    scene: Grid
    size: tuple[int, int]
    centres: Tensor
    area: Tensor
    closed: ClassVar[bool] = False

    @abstractmethod
    def view(self, pose: Tensor) -> Tensor:
        """Render the view from a pose.

        Args:
            pose: `(3,)`, of the head.

        Returns:
            `(3, h, w)`, RGB in [0, 1].
        """

    @abstractmethod
    def to_view(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Project points of the scene into the view from a pose.

        Args:
            points: `(N, D)`, points of the scene.
            pose: `(3,)`, of the head.

        Returns:
            Pixels of the view `(N, 2)`, and whether they are inside it `(N,)`.
        """

    @abstractmethod
    def to_scene(self, points: Tensor, pose: Tensor) -> Tensor:
        """Points of the scene that pixels of the view from a pose show.

        Args:
            points: `(N, 2)`, pixels of the view.
            pose: `(3,)`, of the head.

        Returns:
            `(N, D)`, points of the scene.
        """

    @abstractmethod
    def cell_of(self, points: Tensor) -> Tensor:
        """Cells of the scene that contain points.

        Args:
            points: `(N, D)`, points of the scene.

        Returns:
            `(N,)`, numbers of the cells.
        """

    @abstractmethod
    def pixels_of(self, points: Tensor) -> Tensor:
        """Positions of points in the scene's picture.

        Args:
            points: `(N, D)`, points of the scene.

        Returns:
            `(N, 2)`, in pixels of the picture.
        """

    @abstractmethod
    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Angles by which the head turns between poses.

        Args:
            one: `(..., 3)`, first poses.
            other: `(..., 3)`, second poses.

        Returns:
            `(...)`, in degrees.
        """

    @abstractmethod
    def shift(self, one: Tensor, other: Tensor, field: float) -> Tensor:
        """Angles by which the eye turns between pixels of a view.

        Args:
            one: `(..., 2)`, first pixels.
            other: `(..., 2)`, second pixels.
            field: field of view in degrees.

        Returns:
            `(...)`, in degrees.
        """

    @abstractmethod
    def poses(self, field: float) -> list[list[Tensor]]:
        """Poses at a distance of half a window, row by row. Every second pose of every second row tiles the scene.

        Args:
            field: field of view in degrees.

        Returns:
            Rows of poses `(3,)`.
        """

    @abstractmethod
    def places(self, boxes: Tensor, pose: Tensor) -> Places:
        """Regions of the scene that boxes in the view from a pose cover.

        Args:
            boxes: `(M, 4)`, in pixels of the view.
            pose: `(3,)`, of the head.

        Returns:
            One region for each box.
        """

    @abstractmethod
    def picture_boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        """The smallest boxes in the scene's picture around the regions that boxes in the view from a pose cover.

        Args:
            boxes: `(M, 4)`, in pixels of the view.
            pose: `(3,)`, of the head.

        Returns:
            `(M, 4)`, in pixels of the picture. In a closed scene a box that crosses the seam ends beyond the right
            border.
        """


class Panorama(World):
    """A panorama around the viewer, seen by a perspective camera (`semfov.sensor.sphere.Camera`).

    A pose is the camera's yaw, pitch and horizontal field of view in degrees. Points are unit directions, so D is 3.

    Args:
        image: equirectangular picture of any common kind (`semfov.as_image`), with an even number of columns; or its
            `(width, height)` alone, for the geometry of a scene that is not viewed.
        size: `(w, h)` of a view in pixels.
        cell: height of the scene's cells in degrees.
        reach: how far up and down the head turns, in degrees.

    Raises:
        InputError: an argument is out of range.

    >>> world = Panorama(torch.rand(3, 64, 128), (40, 30))
    >>> world.view(torch.tensor([0.0, 0.0, 60.0])).shape, len(world.scene)
    (torch.Size([3, 30, 40]), 1800)
    """

    closed = True

    def __init__(
        self,
        image: ImageLike | tuple[int, int],
        size: tuple[int, int] = VIEW,
        *,
        cell: float = 6.0,
        reach: float = 60.0,
    ) -> None:
        pixels: Tensor | None = None
        if isinstance(image, tuple):
            picture = image
        else:
            pixels = as_image(image)
            picture = pixels.shape[-1], pixels.shape[-2]
        check(picture[0] % 2 == 0, "image", "an even number of columns", picture[0])
        check(0 < cell <= 90, "cell", "a positive angle of at most 90 degrees", cell)
        check(0 <= reach <= 90, "reach", "an angle from 0 to 90 degrees", reach)
        self.picture, self.size, self.cell, self.reach = picture, size, cell, reach
        self.scene = Grid(round(360 / cell), round(180 / cell), self.picture)
        self.centres = panorama_directions(self.scene.centres, self.picture)
        weight = torch.linalg.vector_norm(self.centres[:, ::2], dim=-1)
        self.area = weight / weight.mean()
        self._source = None if pixels is None else go_around(even_rows(pixels)[None])[0]

    def view(self, pose: Tensor) -> Tensor:
        """Render the view of the camera."""
        if self._source is None:
            raise InputError(_BLANK)
        return sample(self._source, pose, self.size).clamp(0, 1)

    def to_view(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels at which directions are seen."""
        return Camera(pose, self.size).points(points)

    def to_scene(self, points: Tensor, pose: Tensor) -> Tensor:
        """Directions of pixels."""
        return Camera(pose, self.size).directions(points)

    def cell_of(self, points: Tensor) -> Tensor:
        """Cells that contain directions."""
        return self.scene.cell_of(self.pixels_of(points))

    def pixels_of(self, points: Tensor) -> Tensor:
        """Pixels of the panorama at directions."""
        return panorama_points(points, self.picture)

    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Angle between the optical axes of two cameras."""
        middle = torch.tensor([[0.0, 0.0]])
        return angle_between(*(Camera(pose, (1, 1)).directions(middle)[..., 0, :] for pose in (one, other)))

    def shift(self, one: Tensor, other: Tensor, field: float) -> Tensor:
        """Angle between the directions of two pixels."""
        camera = Camera(torch.tensor([0.0, 0.0, field]), self.size)
        rays = (camera.directions(points.reshape(-1, 2)).view(*points.shape[:-1], 3) for points in (one, other))
        return angle_between(*rays)

    def poses(self, field: float) -> list[list[Tensor]]:
        """Rings of poses around the viewer."""
        high = 2 * math.degrees(math.atan(math.tan(math.radians(field / 2)) * self.size[1] / self.size[0]))
        number = math.floor(self.reach / (high / 2))
        rings = []
        for row in range(-number, number + 1):
            pitch = row * high / 2
            # In a ring that tiles, the sides of neighbouring windows meet even at the corners nearest to the horizon.
            tiles = (row + number) % 2 == 0
            low = max(abs(pitch) - high / 2, 0) if tiles else abs(pitch)
            count = 2 * math.ceil(360 * math.cos(math.radians(low)) / field - 1e-9)
            rings.append([torch.tensor([360 * n / count - 180, pitch, field]) for n in range(count)])
        return rings

    def places(self, boxes: Tensor, pose: Tensor) -> Regions:
        """Regions of the sphere."""
        return Regions(Camera(pose.expand(len(boxes), 3), self.size), boxes)

    def picture_boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        """Boxes of the panorama."""
        return self.places(boxes, pose).panorama_boxes(self.picture)


@dataclass(frozen=True)
class Boxes:
    """Regions of a flat scene: boxes.

    Attributes:
        boxes: `(M, 4)` in pixels of the scene.

    >>> Boxes(torch.tensor([[0.0, 0, 4, 4], [6, 6, 8, 8]])).contain(torch.tensor([[2.0, 2.0]]))
    tensor([[ True],
            [False]])
    """

    boxes: Tensor

    def __len__(self) -> int:
        """Number of boxes."""
        return len(self.boxes)

    def __getitem__(self, index: Tensor) -> "Boxes":
        """The selected boxes."""
        return Boxes(self.boxes[index])

    def samples(self, count: int = 9) -> Tensor:
        """Points on a regular grid over each box, its borders included.

        Args:
            count: number of points along each side.

        Returns:
            `(M, count², 2)`, in pixels of the scene.
        """
        share = torch.linspace(0, 1, count).to(self.boxes)
        y, x = torch.meshgrid(share, share, indexing="ij")
        low, high = self.boxes[:, None, :2], self.boxes[:, None, 2:]
        return low + torch.stack([x, y], -1).flatten(0, 1) * (high - low) - 0.5

    def contain(self, points: Tensor) -> Tensor:
        """Whether each box contains each of the points.

        Args:
            points: `(N, 2)`, in pixels of the scene.

        Returns:
            `(M, N)`, boolean.
        """
        low, high = self.boxes[:, None, :2] - 0.5, self.boxes[:, None, 2:] - 0.5
        return ((points >= low) & (points <= high)).all(-1)


class Flat(World):
    """A large picture in front of the viewer, seen through a window that moves over it.

    The picture is taken to be far away, so that the number of pixels per degree is the same everywhere. A pose is the
    middle of the window in pixels, and the window's width in degrees. Points are pixels, so D is 2.

    Args:
        picture: picture of any common kind (`semfov.data.large.open_large`); or its `(width, height)` alone, for the
            geometry of a scene that is not viewed.
        size: `(w, h)` of a view in pixels.
        degree: number of pixels of the picture per degree.
        cell: height of the scene's cells in degrees.

    Raises:
        InputError: `degree` or `cell` is not positive.

    >>> world = Flat(torch.rand(3, 480, 640), (40, 30), degree=8)
    >>> world.view(torch.tensor([319.5, 239.5, 40.0])).shape, len(world.scene)
    (torch.Size([3, 30, 40]), 130)
    """

    def __init__(
        self,
        picture: LargePicture | ImageLike | tuple[int, int],
        size: tuple[int, int] = VIEW,
        *,
        degree: float = 640 / 60,
        cell: float = 6.0,
    ) -> None:
        check(degree > 0, "degree", "a positive number of pixels", degree)
        check(cell > 0, "cell", "a positive number of degrees", cell)
        self.opened: LargePicture | None = None
        if not isinstance(picture, tuple):
            self.opened = open_large(picture)
            picture = self.opened.size
        self.picture, self.size, self.cell, self.degree = picture, size, cell, degree
        columns, rows = (max(1, round(side / degree / cell)) for side in self.picture)
        self.scene = Grid(columns, rows, self.picture)
        self.centres = self.scene.centres
        self.area = torch.ones(len(self.scene))

    def _box(self, pose: Tensor) -> tuple[int, int, int, int]:
        """The window of a pose in whole pixels."""
        x, y, field = pose.tolist()
        width = field * self.degree
        height = width * self.size[1] / self.size[0]
        x1, y1 = round(x + 0.5 - width / 2), round(y + 0.5 - height / 2)
        box = x1, y1, x1 + max(1, round(width)), y1 + max(1, round(height))
        inside = x1 >= 0 and y1 >= 0 and box[2] <= self.picture[0] and box[3] <= self.picture[1]
        check(inside, "pose", f"a window inside {self.picture[0]} × {self.picture[1]} pixels", box)
        return box

    def view(self, pose: Tensor) -> Tensor:
        """The content of the window, resampled to the size of a view."""
        if self.opened is None:
            raise InputError(_BLANK)
        pixels = self.opened.read(self._box(pose)).float()[None] / 255
        return F.interpolate(pixels, self.size[::-1], mode="bilinear", antialias=True)[0].clamp(0, 1)

    def to_view(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels of the view that show points of the picture."""
        x1, y1, x2, y2 = self._box(pose)
        size = points.new_tensor(self.size)
        seen = (points + 0.5 - points.new_tensor([x1, y1])) * size / points.new_tensor([x2 - x1, y2 - y1]) - 0.5
        return seen, ((seen >= -0.5) & (seen <= size - 0.5)).all(-1)

    def to_scene(self, points: Tensor, pose: Tensor) -> Tensor:
        """Points of the picture that pixels of the view show."""
        x1, y1, x2, y2 = self._box(pose)
        extent = points.new_tensor([x2 - x1, y2 - y1])
        return (points + 0.5) * extent / points.new_tensor(self.size) + points.new_tensor([x1, y1]) - 0.5

    def cell_of(self, points: Tensor) -> Tensor:
        """Cells that contain points."""
        return self.scene.cell_of(points)

    def pixels_of(self, points: Tensor) -> Tensor:
        """The points themselves."""
        return points

    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Distance between the middles of two windows, in degrees."""
        return torch.linalg.vector_norm(one[..., :2] - other[..., :2], dim=-1) / self.degree

    def shift(self, one: Tensor, other: Tensor, field: float) -> Tensor:
        """Distance between the points that two pixels show, in degrees."""
        return torch.linalg.vector_norm(one - other, dim=-1) * (field / self.size[0])

    def poses(self, field: float) -> list[list[Tensor]]:
        """Windows that lie inside the picture."""
        width = field * self.degree
        height = width * self.size[1] / self.size[0]
        fits = round(width) <= self.picture[0] and round(height) <= self.picture[1]
        got = f"{field} degrees, {width:.0f} × {height:.0f} pixels; give narrower `fields`, or a smaller `degree`"
        largest = f"a window inside the picture of {self.picture[0]} × {self.picture[1]} pixels"
        check(fits, "field", largest, got)

        def middles(length: int, side: float) -> list[float]:
            steps = 2 * math.ceil(length / side - 1 - 1e-9)
            return [side / 2 - 0.5 + (length - side) * n / max(steps, 1) for n in range(steps + 1)]

        across, down = (middles(*pair) for pair in zip(self.picture, (width, height), strict=True))
        return [[torch.tensor([x, y, field]) for x in across] for y in down]

    def places(self, boxes: Tensor, pose: Tensor) -> Boxes:
        """Boxes of the picture."""
        return Boxes(self.picture_boxes(boxes, pose))

    def picture_boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        """Boxes of the picture."""
        return (self.to_scene(boxes.reshape(-1, 2) - 0.5, pose) + 0.5).view(-1, 4)

"""Pictures that a head looks around in: panoramas around the viewer, and large pictures in front of it."""

import math
import warnings

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.inputs import Color, ImageLike, as_image
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture
from semfov.errors import InputError, check
from semfov.head.speeds import Speeds
from semfov.head.sphere import Sphere
from semfov.head.world import BLANK, FIELDS, World, check_fields
from semfov.sensor.perspective import even_rows, go_around, sample

_VIEW = (416, 312)
"""Default `(width, height)` of a view in pixels."""

_PROPORTION = 0.1
"""Width by height of a panorama may differ by this from 2."""

_DEGREE = 640 / 60
"""Default number of pixels of a flat picture per degree."""


class Panorama(Sphere):
    """A panorama around the viewer, seen by a perspective camera (`semfov.sensor.sphere.Camera`).

    A pose is the camera's pan (yaw), tilt (pitch) and horizontal field of view in degrees. Points are unit directions,
    so D is 3.

    Args:
        image: equirectangular picture of any common kind (`semfov.as_image`), with an even number of columns; or its
            `(width, height)` alone, for the geometry of a scene that is not viewed. One that is not about twice as wide
            as high brings a warning.
        size: `(w, h)` of a view in pixels.
        fields: fields of view in degrees, narrowest first; with several of them the head can zoom.
        speeds: of eye and head.
        cell: height of the scene's cells in degrees.
        reach: how far up and down the head turns, in degrees.
        color: order of the channels of an array or a tensor (`semfov.as_image`).

    Raises:
        InputError: an argument is out of range.

    >>> world = Panorama(torch.rand(3, 64, 128), (40, 30))
    >>> world.look_at((0, 0), 60.0).shape, len(world.scene)
    (torch.Size([3, 30, 40]), 1800)
    """

    def __init__(
        self,
        image: ImageLike | tuple[int, int],
        size: tuple[int, int] = _VIEW,
        *,
        fields: tuple[float, ...] = FIELDS,
        speeds: Speeds | None = None,
        cell: float = 6.0,
        reach: float = 60.0,
        color: Color = "rgb",
    ) -> None:
        check(0 <= reach <= 90, "reach", "an angle from 0 to 90 degrees", reach)
        pixels: Tensor | None = None
        if not isinstance(image, tuple):
            pixels = as_image(image, color=color)
            width, height = image = pixels.shape[-1], pixels.shape[-2]
            if abs(width / height - 2) > _PROPORTION:
                warnings.warn(
                    f"image: expected a panorama of 360 by 180 degrees, which is twice as wide as high, got {width} × "
                    f"{height} px; its views are distorted, and how='head' turns a head in front of a flat picture",
                    stacklevel=2,
                )
        super().__init__(image, size, tilt=(-reach, reach), fields=fields, speeds=speeds, cell=cell)
        self.reach = reach
        self._source = None if pixels is None else go_around(even_rows(pixels)[None])[0]
        self._drawn = None if self._source is None else self._source[:, 1:-1, 1:-1]

    def view(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Render the view of the camera."""
        if self._source is None:
            raise InputError(BLANK)
        return sample(self._source, pose, self.size).clamp(0, 1), pose


class Flat(World):
    """A large picture in front of the viewer, seen through a window that moves over it.

    The picture is taken to be far away, so that the number of pixels per degree is the same everywhere. A pose is the
    middle of the window, in degrees to the right of and above the middle of the picture, and the window's width in
    degrees. Points are pixels, so D is 2.

    Args:
        picture: picture of any common kind (`semfov.data.large.open_large`); or its `(width, height)` alone, for the
            geometry of a scene that is not viewed.
        size: `(w, h)` of a view in pixels.
        fields: fields of view in degrees, narrowest first; with several of them the head can zoom.
        speeds: of eye and head.
        degree: number of pixels of the picture per degree. None takes 640 pixels for 60 degrees, and fewer where the
            widest view would not fit into the picture.
        cell: height of the scene's cells in degrees.
        color: order of the channels of an array or a tensor (`semfov.as_image`).

    Raises:
        InputError: `degree` or `cell` is not positive.

    >>> world = Flat(torch.rand(3, 480, 640), (40, 30), degree=8)
    >>> world.look_at((0, 0), 40.0).shape, len(world.scene)
    (torch.Size([3, 30, 40]), 130)
    """

    def __init__(
        self,
        picture: LargePicture | ImageLike | tuple[int, int],
        size: tuple[int, int] = _VIEW,
        *,
        fields: tuple[float, ...] = FIELDS,
        speeds: Speeds | None = None,
        degree: float | None = None,
        cell: float = 6.0,
        color: Color = "rgb",
    ) -> None:
        self.fields = check_fields(fields)
        self.opened: LargePicture | None = None
        if not isinstance(picture, tuple):
            self.opened = self._drawn = open_large(picture, color=color)
            picture = self.opened.size
        self.picture = width, height = picture
        if degree is None:
            degree = min(_DEGREE, min(width, height * size[0] / size[1]) / max(fields))
        check(degree > 0, "degree", "a positive number of pixels", degree)
        check(cell > 0, "cell", "a positive number of degrees", cell)
        self.size, self.cell, self.degree = size, cell, degree
        self.speeds = Speeds() if speeds is None else speeds
        across, up = width / degree / 2, height / degree / 2
        self.pan, self.tilt = (-across, across), (-up, up)
        self.scene = Grid(max(1, round(2 * across / cell)), max(1, round(2 * up / cell)), self.picture)
        self.centres = self.scene.centres
        self.area = torch.ones(len(self.scene))

    def _box(self, pose: Tensor) -> tuple[int, int, int, int]:
        """The window of a pose in whole pixels."""
        pan, tilt, field = pose.tolist()
        width = field * self.degree
        height = width * self.size[1] / self.size[0]
        wide, high = max(1, round(width)), max(1, round(height))
        x1 = round(self.picture[0] / 2 + pan * self.degree - width / 2)
        y1 = round(self.picture[1] / 2 - tilt * self.degree - height / 2)
        # Windows at the border of the picture may be rounded to a place one pixel beyond it.
        within = tuple(min(max(a, 0), b) for a, b in ((x1, self.picture[0] - wide), (y1, self.picture[1] - high)))
        inside = abs(within[0] - x1) <= 1 and abs(within[1] - y1) <= 1 and min(within) >= 0
        what = f"a window inside {self.picture[0]} × {self.picture[1]} pixels"
        check(inside, "pose", what, (x1, y1, x1 + wide, y1 + high))
        return within[0], within[1], within[0] + wide, within[1] + high

    def view(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """The content of the window, resampled to the size of a view."""
        if self.opened is None:
            raise InputError(BLANK)
        pixels = self.opened.read(self._box(pose)).float()[None] / 255
        return F.interpolate(pixels, self.size[::-1], mode="bilinear", antialias=True)[0].clamp(0, 1), pose

    def to_view(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels of the view that show points of the picture."""
        x1, y1, x2, y2 = self._box(pose)
        size = points.new_tensor(self.size)
        pixels = (points + 0.5 - points.new_tensor([x1, y1])) * size / points.new_tensor([x2 - x1, y2 - y1]) - 0.5
        return pixels, ((pixels >= -0.5) & (pixels <= size - 0.5)).all(-1)

    def to_scene(self, points: Tensor, pose: Tensor) -> Tensor:
        """Points of the picture that pixels of the view show."""
        x1, y1, x2, y2 = self._box(pose)
        extent = points.new_tensor([x2 - x1, y2 - y1])
        return (points + 0.5) * extent / points.new_tensor(self.size) + points.new_tensor([x1, y1]) - 0.5

    def pixels_of(self, points: Tensor) -> Tensor:
        """The points themselves."""
        return points

    def angles_of(self, points: Tensor) -> Tensor:
        """Degrees to the right of and above the middle of the picture."""
        middle = points.new_tensor(self.picture) / 2 - 0.5
        return (points - middle) * points.new_tensor([1.0, -1.0]) / self.degree

    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Distance between the middles of two windows."""
        return torch.linalg.vector_norm(one[..., :2] - other[..., :2], dim=-1)

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
            return [(length - side) * (n / max(steps, 1) - 0.5) / self.degree for n in range(steps + 1)]

        across, down = (middles(*pair) for pair in zip(self.picture, (width, height), strict=True))
        return [[torch.tensor([x, -y, field]) for x in across] for y in down]

    def boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        """Boxes of the picture."""
        return (self.to_scene(boxes.reshape(-1, 2) - 0.5, pose) + 0.5).view(-1, 4)

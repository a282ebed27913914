"""Scenes larger than the eye's field of view, seen through a window that a head moves: their geometry and their views.

Panoramas lie around the viewer, and large pictures in front of it.
"""

import math
import warnings
from collections.abc import Sequence
from numbers import Real

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.data.inputs import Color, ImageLike, as_image
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture
from semfov.errors import InputError, check
from semfov.head.speeds import Speeds
from semfov.io.schema import is_number
from semfov.sensor.perspective import go_around, sample
from semfov.sensor.sphere import Boxes, Camera, Regions, panorama_directions, panorama_points

_FIELDS = (60.0,)  # default fields of view in degrees
_VIEW = (416, 312)  # default `(width, height)` of a view in pixels


_RADIANS = {"pan": 2 * math.pi, "tilt": math.pi / 2, "reach": math.pi / 2, "fields": math.pi}
"""The largest angle of each kind in radians."""


def check_degrees(name: str, angles: Sequence[float]) -> None:
    """Raise an error for angles that seem to be in radians or fractions instead of degrees.

    One rule holds for all: if the largest angle of one kind, its sign aside, is possible in radians and not 0, its unit
    is taken to be another one. Each kind is judged alone, because a driver may mix units.

    Args:
        name: the kind of angles: `pan`, `tilt`, `reach` or `fields`.
        angles: in degrees.

    Raises:
        InputError: they look like another unit.

    >>> check_degrees("fields", (2.0, 60.0))
    >>> check_degrees("pan", (-3.14, 3.14))
    Traceback (most recent call last):
    semfov.errors.InputError: pan: expected degrees, got (-3.14, 3.14), which look like radians; use math.degrees
    """
    largest = max(abs(float(angle)) for angle in angles)
    unit = "radians; use math.degrees"
    if largest <= 1:
        unit = "numbers from -1 to 1, as ONVIF has them; multiply them by the camera's largest angles"
    check(largest == 0 or largest > _RADIANS[name], name, "degrees", f"{angles}, which look like {unit}")


def check_limits(name: str, limits: Sequence[float]) -> None:
    """Check that the limits of a camera are a pair of angles in degrees.

    Args:
        name: `pan` or `tilt`.
        limits: the lower and the upper one.

    Raises:
        InputError: they are not.
    """
    is_pair = isinstance(limits, Sequence) and len(limits) == 2
    check(is_pair and all(map(_is_finite, limits)), name, "a pair of limits in degrees", limits)
    check_degrees(name, limits)


def check_fields(fields: Sequence[float]) -> tuple[float, ...]:
    """Check that fields of view are ascending angles in degrees, below 180.

    Args:
        fields: in degrees.

    Returns:
        The fields.

    Raises:
        InputError: they are not.
    """
    are_numbers = isinstance(fields, Sequence) and len(fields) > 0 and all(map(is_number, fields))
    ascend = are_numbers and list(fields) == sorted(fields)
    are_angles = ascend and fields[0] > 0 and fields[-1] < 180
    check(are_angles, "fields", "one or more angles below 180 degrees, narrowest first, such as (60.0,)", fields)
    check_degrees("fields", fields)
    return tuple(map(float, fields))


def _is_finite(value: object) -> bool:
    """Tell whether a value is a number, and finite."""
    return isinstance(value, Real) and math.isfinite(value)


class _Scene:
    """Base of the scenes that a head looks around in.

    Attributes:
        scene: the cells of the scene.
        size: `(width, height)` of a view in pixels.
        fields: fields of view in degrees, narrowest first.
        speeds: of eye and head.
        centres: `(S, D)`, points of the scene in the middle of its cells.
        area: `(S,)`, areas of the cells, 1 on average.
        closed: whether the left and the right border of the picture meet.
        still: whether two views from one pose are equal, as those of a picture are.
        rate: rate at which what was seen is forgotten, per second; 0: never.
    """

    scene: Grid
    size: tuple[int, int]
    fields: tuple[float, ...]
    speeds: Speeds
    centres: Tensor
    area: Tensor
    closed: bool = False
    still: bool = True
    rate: float = 0.0

    _drawn: Tensor | LargePicture | None = None

    def view(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """View the scene from a pose.

        Args:
            pose: `(3,)`, as `poses` lists them.

        Returns:
            The picture `(3, h, w)` in [0, 1], and the pose where it was taken.
        """
        raise InputError(
            "picture: expected a scene with its picture to view, got its size alone, as a path from a file has it"
        )

    def look_at(self, direction: tuple[float, float], field: float) -> Tensor:
        """View the scene in a direction.

        Args:
            direction: pan to the right and tilt up, in degrees.
            field: field of view across, in degrees.

        Returns:
            `(3, h, w)`.
        """
        return self.view(torch.tensor([*direction, field]))[0]

    def image(self) -> Tensor | LargePicture | None:
        """Give the picture of the whole scene for drawing, opened or `(3, H, W)`; None for a geometry alone."""
        return self._drawn


def _angle_between(one: Tensor, other: Tensor) -> Tensor:
    r"""Compute angles in degrees between directions `(..., 3)`, :math:`\operatorname{atan2}(|a × b|, a · b)`."""
    one, other = torch.broadcast_tensors(one, other)
    sine = torch.linalg.vector_norm(torch.linalg.cross(one, other), dim=-1)
    return torch.rad2deg(torch.atan2(sine, (one * other).sum(-1)))


class Sphere(_Scene):
    """Base of scenes around a perspective camera: directions in 3 dimensions, without a picture."""

    closed = True

    def __init__(
        self,
        picture: tuple[int, int],
        size: tuple[int, int],
        *,
        pan: tuple[float, float] = (-180.0, 180.0),
        tilt: tuple[float, float] = (-90.0, 90.0),
        fields: tuple[float, ...] = _FIELDS,
        speeds: Speeds | None = None,
        cell: float = 6.0,
    ) -> None:
        check(picture[0] % 2 == 0, "image", "an even number of columns", picture[0])
        check(0 < cell <= 90, "cell", "a positive angle of at most 90 degrees", cell)
        check(-360 <= pan[0] <= pan[1] <= 360, "pan", "limits in degrees, left and right", pan)
        check(-90 <= tilt[0] <= tilt[1] <= 90, "tilt", "limits from -90 to 90 degrees, down and up", tilt)
        self.picture = picture
        self.size = size
        self.cell = cell
        self.pan = pan
        self.tilt = tilt
        self.fields = check_fields(fields)
        self.around = pan[1] - pan[0] >= 360  # whether the head turns all the way round
        self.speeds = Speeds() if speeds is None else speeds
        self.scene = Grid(round(360 / cell), round(180 / cell), picture)
        self.centres = panorama_directions(self.scene.centres, picture)
        weight = torch.linalg.vector_norm(self.centres[:, ::2], dim=-1)
        self.area = weight / weight.mean()

    def to_view(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Find the pixels of a view that show points of the scene.

        Args:
            points: `(N, D)`.
            pose: `(3,)`, of the view.

        Returns:
            Pixels `(N, 2)`, and whether they are inside the view, `(N,)`.
        """
        return Camera(pose, self.size).points(points)

    def to_scene(self, points: Tensor, pose: Tensor) -> Tensor:
        """Find the points of the scene that pixels of a view show.

        Args:
            points: `(N, 2)`, pixels.
            pose: `(3,)`, of the view.

        Returns:
            `(N, D)`.
        """
        return Camera(pose, self.size).directions(points)

    def pixels_of(self, points: Tensor) -> Tensor:
        """Find the pixels `(N, 2)` of the whole picture at points `(N, D)` of the scene."""
        return panorama_points(points, self.picture)

    def angles_of(self, points: Tensor) -> Tensor:
        """Compute pan from -180 to 180 degrees, and tilt, of a head that turns to directions `(N, 3)`; → `(N, 2)`."""
        x, y, z = points.unbind(-1)  # to the right, down and ahead
        pan = torch.atan2(x, z)
        tilt = torch.atan2(-y, torch.hypot(x, z))
        return torch.rad2deg(torch.stack([pan, tilt], -1))

    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Compute by which angle the head turns from one pose to another.

        Args:
            one: `(..., 3)`.
            other: `(..., 3)`.

        Returns:
            `(...)` in degrees, between the optical axes.
        """
        middle = torch.tensor([[0.0, 0.0]])
        axis = Camera(one, (1, 1)).directions(middle)[..., 0, :]
        other_axis = Camera(other, (1, 1)).directions(middle)[..., 0, :]
        return _angle_between(axis, other_axis)

    def shift(self, one: Tensor, other: Tensor, field: float) -> Tensor:
        """Compute by which angle the eye turns between two pixels of a view.

        Args:
            one: `(..., 2)`.
            other: `(..., 2)`.
            field: field of view in degrees.

        Returns:
            `(...)` in degrees.
        """
        camera = Camera(torch.tensor([0.0, 0.0, field]), self.size)
        ray = camera.directions(one.reshape(-1, 2)).view(*one.shape[:-1], 3)
        other_ray = camera.directions(other.reshape(-1, 2)).view(*other.shape[:-1], 3)
        return _angle_between(ray, other_ray)

    def poses(self, field: float) -> list[list[Tensor]]:
        """List the poses of a field of view: rings, or arcs between limits, half a window apart.

        Args:
            field: field of view in degrees.

        Returns:
            Rings of poses `(3,)`, of which every second pose of every second ring tiles the scene.
        """
        width, height = self.size
        # Of a flat image, the tangents of half the fields are in proportion to its sides.
        half_across = math.tan(math.radians(field / 2))
        field_up = 2 * math.degrees(math.atan(half_across * height / width))
        down, up = self.tilt
        middle = (down + up) / 2
        reach = (up - down) / 2
        number = math.floor(reach / (field_up / 2))  # rings above the middle, and below it
        rings = []
        for ring in range(-number, number + 1):
            tilt = middle + ring * field_up / 2
            # In a ring that tiles, the sides of neighbouring windows meet even at the corners nearest to the horizon.
            tiles = (ring + number) % 2 == 0
            nearest_to_horizon = max(abs(tilt) - field_up / 2, 0) if tiles else abs(tilt)
            pans = self._pans(field, nearest_to_horizon)
            rings.append([torch.tensor([pan, tilt, field]) for pan in pans])
        return rings

    def _pans(self, field: float, tilt: float) -> list[float]:
        """List pans half a window apart, at a tilt, where a degree of pan is shorter than at the horizon."""
        left, right = self.pan
        width = min(right - left, 360)
        # Two for each window that fits, rounded up, but for the error of the division.
        length = width * math.cos(math.radians(tilt))
        count = 2 * math.ceil(length / field - 1e-9)
        # The ends of an arc are both poses; those of a ring are the same one.
        steps = range(count if self.around else count + 1)
        return [width * step / max(count, 1) + left for step in steps]

    def aim(self, point: Tensor, field: float) -> Tensor:
        """Find the pose that has a direction in the middle of its view, or as near to it as the limits allow.

        Args:
            point: `(3,)`.
            field: field of view in degrees.

        Returns:
            `(3,)`.
        """
        pan, tilt = self.angles_of(point[None])[0].tolist()
        left, right = self.pan
        # The same direction between the limits, or beyond the right one and before the left one.
        pan = left + (pan - left) % 360
        if pan > right:
            pan = right if pan - right < left + 360 - pan else left
        return torch.tensor([pan, min(max(tilt, self.tilt[0]), self.tilt[1]), field])

    def places(self, boxes: Tensor, pose: Tensor) -> Regions:
        """Find the regions of the sphere that boxes `(M, 4)` in the view from a pose cover."""
        return Regions(boxes, Camera(pose.expand(len(boxes), 3), self.size))

    def boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        """Find the smallest boxes `(M, 4)` in the panorama around boxes of a view; a seam does not cut them."""
        return self.places(boxes, pose).panorama_boxes(self.picture)


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
        fields: tuple[float, ...] = _FIELDS,
        speeds: Speeds | None = None,
        cell: float = 6.0,
        reach: float = 60.0,
        color: Color = "rgb",
    ) -> None:
        check(0 <= reach <= 90, "reach", "an angle from 0 to 90 degrees", reach)
        check_degrees("reach", (reach,))
        pixels: Tensor | None = None
        if not isinstance(image, tuple):
            pixels = as_image(image, color=color)
            image = (pixels.shape[-1], pixels.shape[-2])
            _warn_of_proportions(*image)
        super().__init__(image, size, tilt=(-reach, reach), fields=fields, speeds=speeds, cell=cell)
        self.reach = reach
        self._source: Tensor | None = None
        if pixels is not None:
            self._source = go_around(pixels)
            self._drawn = self._source[:, 1:-1, 1:-1]  # without the border

    def view(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Render the view of the camera."""
        if self._source is None:
            return super().view(pose)
        return sample(self._source, pose, self.size).clamp(0, 1), pose


def _warn_of_proportions(width: int, height: int) -> None:
    """Warn the caller of `Panorama` of a picture that is not about twice as wide as high."""
    if abs(width / height - 2) > 0.1:
        warnings.warn(
            f"image: expected a panorama of 360 by 180 degrees, which is twice as wide as high, got {width} × "
            f"{height} px; its views are distorted, and how='head' turns a head in front of a flat picture",
            stacklevel=3,
        )


class _Plane(_Scene):
    """A plane in front of a window, without anything to see; a pose is its middle and width in degrees, and D is 2."""

    def __init__(
        self,
        picture: tuple[int, int],
        size: tuple[int, int],
        fields: tuple[float, ...],
        speeds: Speeds | None,
        degree: float | None,
        cell: float,
    ) -> None:
        self.fields = check_fields(fields)
        self.picture = picture
        width, height = picture
        if degree is None:
            widest = min(width, height * size[0] / size[1])  # pixels across of the largest view in the picture
            degree = min(640 / 60, widest / max(fields))
        check(degree > 0, "degree", "a positive number of pixels", degree)
        check(cell > 0, "cell", "a positive number of degrees", cell)
        self.size = size
        self.cell = cell
        self.degree = degree
        self.speeds = Speeds() if speeds is None else speeds
        half_width = width / degree / 2  # in degrees
        half_height = height / degree / 2
        self.pan = (-half_width, half_width)
        self.tilt = (-half_height, half_height)
        columns = max(1, round(2 * half_width / cell))
        rows = max(1, round(2 * half_height / cell))
        self.scene = Grid(columns, rows, self.picture)
        self.centres = self.scene.centres
        self.area = torch.ones(len(self.scene))

    def _window_size(self, field: float) -> tuple[float, float]:
        """Compute width and height, in pixels of the picture, of the window of a field of view."""
        width = field * self.degree
        return width, width * self.size[1] / self.size[0]

    def _box(self, pose: Tensor) -> tuple[int, int, int, int]:
        """Find the window `(x1, y1, x2, y2)` of a pose in whole pixels."""
        pan, tilt, field = pose.tolist()
        picture_width, picture_height = self.picture
        width, height = self._window_size(field)
        columns = max(1, round(width))
        rows = max(1, round(height))
        middle_x = picture_width / 2 + pan * self.degree
        middle_y = picture_height / 2 - tilt * self.degree  # pixels count down, and tilts up
        x = round(middle_x - width / 2)
        y = round(middle_y - height / 2)
        # Windows at the border of the picture may be rounded to a place one pixel beyond it.
        x1 = min(max(x, 0), picture_width - columns)
        y1 = min(max(y, 0), picture_height - rows)
        is_inside = abs(x1 - x) <= 1 and abs(y1 - y) <= 1 and min(x1, y1) >= 0
        expected = f"a window inside {picture_width} × {picture_height} pixels"
        check(is_inside, "pose", expected, (x, y, x + columns, y + rows))
        return x1, y1, x1 + columns, y1 + rows

    def to_view(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        x1, y1, x2, y2 = self._box(pose)
        size = points.new_tensor(self.size)
        extent = points.new_tensor([x2 - x1, y2 - y1])
        # Points count from the centres of pixels, and windows from their edges, half a pixel before.
        in_window = points + 0.5 - points.new_tensor([x1, y1])
        pixels = in_window * size / extent - 0.5
        is_inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(-1)
        return pixels, is_inside

    def to_scene(self, points: Tensor, pose: Tensor) -> Tensor:
        x1, y1, x2, y2 = self._box(pose)
        size = points.new_tensor(self.size)
        extent = points.new_tensor([x2 - x1, y2 - y1])
        return (points + 0.5) * extent / size + points.new_tensor([x1, y1]) - 0.5

    def pixels_of(self, points: Tensor) -> Tensor:
        return points

    def angles_of(self, points: Tensor) -> Tensor:
        """Compute degrees to the right of and above the middle of the picture."""
        middle = points.new_tensor(self.picture) / 2 - 0.5
        return (points - middle) * points.new_tensor([1.0, -1.0]) / self.degree

    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Compute the distance between the middles of two windows."""
        offset = one[..., :2] - other[..., :2]  # of pan and tilt; the third number is the field of view
        return torch.linalg.vector_norm(offset, dim=-1)

    def shift(self, one: Tensor, other: Tensor, field: float) -> Tensor:
        """Compute the distance between the points that two pixels show, in degrees."""
        return torch.linalg.vector_norm(one - other, dim=-1) * (field / self.size[0])

    def poses(self, field: float) -> list[list[Tensor]]:
        """List the windows of a field of view that lie inside the picture, half a window apart, in rows."""
        picture_width, picture_height = self.picture
        width, height = self._window_size(field)
        is_inside = round(width) <= picture_width and round(height) <= picture_height
        got = f"{field} degrees, {width:.0f} × {height:.0f} pixels; give narrower `fields`, or a smaller `degree`"
        expected = f"a window inside the picture of {picture_width} × {picture_height} pixels"
        check(is_inside, "field", expected, got)
        pans = self._middles(picture_width, width)
        # Pixels count down, and tilts up.
        tilts = [-middle for middle in self._middles(picture_height, height)]
        return [[torch.tensor([pan, tilt, field]) for pan in pans] for tilt in tilts]

    def _middles(self, length: int, side: float) -> list[float]:
        """Spread windows of a side over a length, half a window apart at most; middles in degrees from its middle."""
        steps = 2 * math.ceil(length / side - 1 - 1e-9)
        room = length - side
        shares = [step / max(steps, 1) for step in range(steps + 1)]
        return [room * (share - 0.5) / self.degree for share in shares]

    def aim(self, point: Tensor, field: float) -> Tensor:
        """Find the pose of the window whose middle is nearest to a point."""
        pan, tilt = self.angles_of(point[None])[0].tolist()
        field_up = field / 2 * self.size[1] / self.size[0]
        most_pan = max(self.pan[1] - field / 2, 0.0)
        most_tilt = max(self.tilt[1] - field_up, 0.0)
        return torch.tensor([_limited(pan, most_pan), _limited(tilt, most_tilt), field])

    def places(self, boxes: Tensor, pose: Tensor) -> Boxes:
        return Boxes(self.boxes(boxes, pose))

    def boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        corners = boxes.reshape(-1, 2) - 0.5  # edges lie half a pixel before the centres that points count from
        corners_in_scene = self.to_scene(corners, pose)
        return (corners_in_scene + 0.5).view(-1, 4)


def _limited(angle: float, most: float) -> float:
    """Bring an angle into limits that lie as far on both sides of 0."""
    return min(max(angle, -most), most)


class Flat(_Plane):
    """A large picture in front of the viewer, seen through a window that moves over it.

    The picture is assumed to be far away, so the number of pixels per degree is the same everywhere. A pose is the
    middle of the window, in degrees to the right of and above the middle of the picture, and the window's width in
    degrees. Points are pixels, so D is 2.

    Args:
        picture: picture of any common kind (`semfov.data.large.open_large`); or its `(width, height)` alone, for the
            geometry of a scene that is not viewed.
        size: `(w, h)` of a view in pixels.
        fields: fields of view in degrees, narrowest first; with several of them the head can zoom.
        speeds: of eye and head.
        degree: number of pixels of the picture per degree. None: 640 pixels for 60 degrees, or fewer if the widest view
            would not fit into the picture.
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
        fields: tuple[float, ...] = _FIELDS,
        speeds: Speeds | None = None,
        degree: float | None = None,
        cell: float = 6.0,
        color: Color = "rgb",
    ) -> None:
        self.opened: LargePicture | None = None
        if not isinstance(picture, tuple):
            self.opened = self._drawn = open_large(picture, color=color)
            picture = self.opened.size
        super().__init__(picture, size, fields, speeds, degree, cell)

    def view(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Read the window, resampled to the size of a view."""
        if self.opened is None:
            return super().view(pose)
        pixels = self.opened.read(self._box(pose)).float()[None] / 255
        width, height = self.size
        view = F.interpolate(pixels, (height, width), mode="bilinear", antialias=True)[0]
        return view.clamp(0, 1), pose


World = Sphere | _Plane  # a scene of either kind: both have the same methods

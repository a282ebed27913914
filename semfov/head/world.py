"""Scenes larger than the eye's field of view, seen through a window that a head moves."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.windowed import LargePicture
from semfov.errors import InputError, check
from semfov.head.speeds import Speeds
from semfov.io.schema import is_number
from semfov.sensor.sphere import Boxes

FIELDS = (60.0,)
"""Default fields of view in degrees."""

BLANK = "picture: expected a scene with its picture to view, got its size alone, as a path from a file has it"


def check_fields(fields: Sequence[float]) -> tuple[float, ...]:
    """Raise `InputError` unless fields of view are ascending angles below 180 degrees."""
    fits = isinstance(fields, Sequence) and len(fields) > 0 and all(is_number(field) for field in fields)
    fits = fits and min(fields) > 0 and max(fields) < 180 and list(fields) == sorted(fields)
    check(fits, "fields", "one or more angles below 180 degrees, narrowest first, such as (60.0,)", fields)
    return tuple(float(field) for field in fields)


class World(ABC):
    """Base of the scenes that a head looks around in: their geometry, and the view from each pose.

    A pose of the head has three numbers, all in degrees: pan to the right, tilt up, and the field of view across. A
    point of the scene has D coordinates. Cameras of your own need less (`semfov.head.PanTiltCamera`).

    Attributes:
        scene: cells of the whole scene, in pixels of its picture.
        size: `(w, h)` of a view in pixels.
        fields: fields of view in degrees, narrowest first; with several of them the head can zoom.
        speeds: of eye and head.
        centres: `(S, D)`, centres of the cells.
        area: `(S,)`, relative areas of the cells, 1 on average.
        closed: whether the left and the right border of the picture meet.
        still: whether two views from one pose are equal, as those of a picture are.
    """

    scene: Grid
    size: tuple[int, int]
    fields: tuple[float, ...]
    speeds: Speeds
    centres: Tensor
    area: Tensor
    closed: bool = False
    still: bool = True

    _drawn: Tensor | LargePicture | None = None

    def view(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """The picture from a pose `(3,)`, `(3, h, w)` in [0, 1], and the pose where it was taken."""
        raise InputError(BLANK)

    def look_at(self, direction: tuple[float, float], field: float) -> Tensor:
        """The view `(3, h, w)` in a direction, pan to the right and tilt up in degrees, of a field of view across."""
        return self.view(torch.tensor([*direction, field]))[0]

    @abstractmethod
    def to_view(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels `(N, 2)` of the view from a pose at points `(N, D)`, and whether they are inside it `(N,)`."""

    @abstractmethod
    def to_scene(self, points: Tensor, pose: Tensor) -> Tensor:
        """Points `(N, D)` of the scene that pixels `(N, 2)` of the view from a pose show."""

    def cell_of(self, points: Tensor) -> Tensor:
        """Cells `(N,)` of the scene that contain points `(N, D)`."""
        return self.scene.cell_of(self.pixels_of(points))

    @abstractmethod
    def pixels_of(self, points: Tensor) -> Tensor:
        """Positions `(N, 2)` of points `(N, D)` in the scene's picture."""

    @abstractmethod
    def angles_of(self, points: Tensor) -> Tensor:
        """Directions of points `(N, D)`, as a head would turn to them: pan right and tilt up `(N, 2)`."""

    @abstractmethod
    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Angles `(...)` in degrees by which the head turns between poses `(..., 3)`."""

    @abstractmethod
    def shift(self, one: Tensor, other: Tensor, field: float) -> Tensor:
        """Angles `(...)` in degrees by which the eye turns between pixels `(..., 2)` of a view."""

    @abstractmethod
    def poses(self, field: float) -> list[list[Tensor]]:
        """Poses at a distance of half a window, row by row. Every second pose of every second row tiles the scene."""

    def places(self, boxes: Tensor, pose: Tensor) -> Boxes:
        """Regions of the scene that boxes `(M, 4)` in the view from a pose cover."""
        return Boxes(self.boxes(boxes, pose))

    @abstractmethod
    def boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        """Smallest boxes `(M, 4)` of the scene's picture around those of a view; a seam does not cut them."""

    def image(self) -> Tensor | LargePicture | None:
        """The picture of the whole scene for drawing, opened or `(3, H, W)`; None where only its geometry is known."""
        return self._drawn

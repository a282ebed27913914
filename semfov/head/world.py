"""Scenes larger than the eye's field of view, seen through a window that a head moves."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.windowed import LargePicture
from semfov.errors import check
from semfov.head.speeds import Speeds
from semfov.io.schema import is_number

FIELDS = (60.0,)
"""Default fields of view in degrees."""


class Places(Protocol):
    """Regions that objects cover in a scene."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: Tensor) -> "Places":
        """The selected regions."""

    def samples(self, count: int = 9) -> Tensor:
        """Points spread over each region, its borders included, `(M, count², D)`."""

    def contain(self, points: Tensor, /) -> Tensor:
        """Whether each region contains each of the points `(N, D)`, `(M, N)` boolean."""


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

    >>> import torch
    >>> from semfov.head import Flat
    >>> world = Flat(torch.rand(3, 480, 640), (40, 30), degree=8)
    >>> isinstance(world, World), [len(row) for row in world.poses(40.0)]
    (True, [3, 3, 3])
    """

    scene: Grid
    size: tuple[int, int]
    fields: tuple[float, ...]
    speeds: Speeds
    centres: Tensor
    area: Tensor
    closed: bool = False
    still: bool = True

    @abstractmethod
    def view(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Look from a pose.

        Args:
            pose: `(3,)`, of the head.

        Returns:
            `(3, h, w)`, RGB in [0, 1]; and the pose `(3,)` from which it was taken, `pose` itself where the head is
            exact.
        """

    def look_at(self, direction: tuple[float, float], field: float) -> Tensor:
        """Render the view in a direction.

        Args:
            direction: pan and tilt in degrees, to the right and up.
            field: field of view across, in degrees.

        Returns:
            `(3, h, w)`, RGB in [0, 1].
        """
        return self.view(torch.tensor([*direction, field]))[0]

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
    def angles_of(self, points: Tensor) -> Tensor:
        """Directions of points of the scene, as a head would turn to them.

        Args:
            points: `(N, D)`, points of the scene.

        Returns:
            `(N, 2)`, pan to the right and tilt up, in degrees.
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
    def boxes(self, boxes: Tensor, pose: Tensor) -> Tensor:
        """Smallest boxes of the scene's picture around boxes in the view from a pose.

        Args:
            boxes: `(M, 4)`, in pixels of the view.
            pose: `(3,)`, of the head.

        Returns:
            `(M, 4)`, in pixels of the picture. A box across the seam of a panorama ends beyond its right border.
        """

    @abstractmethod
    def image(self) -> Tensor | LargePicture | None:
        """The picture of the whole scene, as far as it is known, for drawing.

        Returns:
            An opened picture, or `(3, H, W)`, RGB in [0, 1]; None where the scene has its geometry alone.
        """

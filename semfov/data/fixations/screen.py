"""From pixels of a screen to pixels of the picture on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semfov.errors import check

Array = NDArray[np.float64]
Size = tuple[int, int]


@dataclass(frozen=True)
class Letterbox:
    """A picture shown on a screen as large as it fits, centred, its proportions kept.

    Attributes:
        screen: `(width, height)`.
        picture: `(width, height)`.

    >>> placed = Letterbox((1680, 1050), (640, 480))
    >>> placed.scale, placed.offset
    (2.1875, (140.0, 0.0))
    >>> placed.to_picture(np.array([[839.5, 524.5]]))
    array([[319.5, 239.5]])
    """

    screen: Size
    picture: Size

    def __post_init__(self) -> None:
        """Check the sizes."""
        for name, size in (("screen", self.screen), ("picture", self.picture)):
            check(min(size) > 0, name, "a width and a height above 0", size)

    @property
    def scale(self) -> float:
        """Screen pixels per picture pixel."""
        return min(self.screen[0] / self.picture[0], self.screen[1] / self.picture[1])

    @property
    def offset(self) -> tuple[float, float]:
        """Width of the border on the left and height of that at the top, in screen pixels."""
        across, down = (whole - self.scale * part for whole, part in zip(self.screen, self.picture, strict=True))
        return across / 2, down / 2

    def to_picture(self, points: Array) -> Array:
        """Points `(n, 2)` of the screen as points of the picture."""
        return np.asarray((points + 0.5 - self.offset) / self.scale - 0.5)

    def to_screen(self, points: Array) -> Array:
        """Points `(n, 2)` of the picture as points of the screen."""
        return np.asarray((points + 0.5) * self.scale + self.offset - 0.5)

    def box_to_picture(self, box: tuple[float, ...]) -> tuple[float, float, float, float]:
        """Pixel edges on the screen as pixel edges of the picture."""
        corners = (np.array(box).reshape(2, 2) - self.offset) / self.scale
        return _box(corners)

    def box_to_screen(self, box: tuple[float, ...]) -> tuple[float, float, float, float]:
        """Pixel edges of the picture as pixel edges on the screen."""
        return _box(np.array(box).reshape(2, 2) * self.scale + self.offset)


def resized_points(points: Array, size: Size, new: Size) -> Array:
    """Points `(n, 2)` of a frame in pixels of the same frame at another size.

    The centre of a cell of 50 pixels, 0 in cells, is 24.5 in pixels:

    >>> resized_points(np.array([[0.0, 1.0]]), (32, 24), (1600, 1200))
    array([[24.5, 74.5]])
    """
    return np.asarray((points + 0.5) * (np.array(new) / np.array(size)) - 0.5)


def resized_box(box: tuple[float, ...], size: Size, new: Size) -> tuple[float, float, float, float]:
    """Pixel edges in a frame as those in the same frame at another size."""
    return _box(np.array(box).reshape(2, 2) * (np.array(new) / np.array(size)))


def _box(corners: Array) -> tuple[float, float, float, float]:
    x1, y1, x2, y2 = corners.reshape(-1).tolist()
    return x1, y1, x2, y2

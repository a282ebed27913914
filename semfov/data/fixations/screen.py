"""Conversion between pixels of a screen and pixels of the picture on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semfov.errors import check

_Array = NDArray[np.float64]
_Size = tuple[int, int]


@dataclass(frozen=True)
class Letterbox:
    """A picture on a screen, resized to the largest size that fits with its proportions, and centred.

    Attributes:
        screen: `(width, height)` of the screen in pixels.
        picture: `(width, height)` of the picture in pixels.

    >>> placed = Letterbox((1680, 1050), (640, 480))
    >>> placed.scale, placed.offset
    (2.1875, (140.0, 0.0))
    >>> placed.to_picture(np.array([[839.5, 524.5]]))
    array([[319.5, 239.5]])
    """

    screen: _Size
    picture: _Size

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
        """Width of the border on the left and height of the border at the top, in screen pixels."""
        across, down = (whole - self.scale * part for whole, part in zip(self.screen, self.picture, strict=True))
        return across / 2, down / 2

    def to_picture(self, points: _Array) -> _Array:
        """Convert points from the screen to the picture.

        Args:
            points: `(n, 2)` in screen pixels.

        Returns:
            `(n, 2)` in picture pixels.
        """
        return np.asarray((points + 0.5 - self.offset) / self.scale - 0.5)

    def to_screen(self, points: _Array) -> _Array:
        """Convert points from the picture to the screen.

        Args:
            points: `(n, 2)` in picture pixels.

        Returns:
            `(n, 2)` in screen pixels.
        """
        return np.asarray((points + 0.5) * self.scale + self.offset - 0.5)

    def box_to_picture(self, box: tuple[float, ...]) -> tuple[float, float, float, float]:
        """Convert a box from the screen to the picture.

        Args:
            box: `(x1, y1, x2, y2)`, edges of screen pixels.

        Returns:
            `(x1, y1, x2, y2)`, edges of picture pixels.
        """
        corners = (np.array(box).reshape(2, 2) - self.offset) / self.scale
        return _box(corners)

    def box_to_screen(self, box: tuple[float, ...]) -> tuple[float, float, float, float]:
        """Convert a box from the picture to the screen.

        Args:
            box: `(x1, y1, x2, y2)`, edges of picture pixels.

        Returns:
            `(x1, y1, x2, y2)`, edges of screen pixels.
        """
        return _box(np.array(box).reshape(2, 2) * self.scale + self.offset)


def resized_points(points: _Array, size: _Size, new: _Size) -> _Array:
    """Convert points to pixels of the same frame at another size.

    Args:
        points: `(n, 2)`.
        size: `(width, height)` of the frame that the points refer to.
        new: the other `(width, height)` of the frame.

    Returns:
        `(n, 2)` in pixels of the frame at the other size.

    The centre of the first cell has coordinate 0 in cells. With cells of 50 pixels it is at 24.5 in pixels:

    >>> resized_points(np.array([[0.0, 1.0]]), (32, 24), (1600, 1200))
    array([[24.5, 74.5]])
    """
    return np.asarray((points + 0.5) * (np.array(new) / np.array(size)) - 0.5)


def resized_box(box: tuple[float, ...], size: _Size, new: _Size) -> tuple[float, float, float, float]:
    """A box `(x1, y1, x2, y2)`, pixel edges, in pixels of the same frame at another size."""
    return _box(np.array(box).reshape(2, 2) * (np.array(new) / np.array(size)))


def _box(corners: _Array) -> tuple[float, float, float, float]:
    x1, y1, x2, y2 = corners.reshape(-1).tolist()
    return x1, y1, x2, y2

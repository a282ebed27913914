"""The record of one person's fixations in one picture, and the place of the picture on the person's screen."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import PureWindowsPath

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.errors import InputError, check, check_number

_Values = NDArray[np.float64]
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
            check_sides(name, size)

    @property
    def scale(self) -> float:
        """Screen pixels per picture pixel."""
        return min(self.screen[0] / self.picture[0], self.screen[1] / self.picture[1])

    @property
    def offset(self) -> tuple[float, float]:
        """Width of the border on the left and height of the border at the top, in screen pixels."""
        width = self.screen[0] - self.scale * self.picture[0]
        height = self.screen[1] - self.scale * self.picture[1]
        return width / 2, height / 2

    def to_picture(self, points: _Values) -> _Values:
        """Convert points from the screen to the picture.

        Args:
            points: `(n, 2)` in screen pixels.

        Returns:
            `(n, 2)` in picture pixels.
        """
        # Edges of pixels correspond, and lie half a pixel before the centres.
        return np.asarray((points + 0.5 - self.offset) / self.scale - 0.5)

    def to_screen(self, points: _Values) -> _Values:
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
        return _box((np.array(box).reshape(2, 2) - self.offset) / self.scale)

    def box_to_screen(self, box: tuple[float, ...]) -> tuple[float, float, float, float]:
        """Convert a box from the picture to the screen.

        Args:
            box: `(x1, y1, x2, y2)`, edges of picture pixels.

        Returns:
            `(x1, y1, x2, y2)`, edges of screen pixels.
        """
        return _box(np.array(box).reshape(2, 2) * self.scale + self.offset)


def check_sides(name: str, size: object) -> None:
    """Raise `InputError` unless the value is a pair `(width, height)` above 0."""
    sides = size if isinstance(size, tuple | list | np.ndarray) else ()
    are_above_0 = all(isinstance(side, Real) and 0 < float(side) < np.inf for side in sides)
    check(len(sides) == 2 and are_above_0, name, "a width and a height above 0", size)


def as_array(values: object, argument: str, *, finite: bool = False) -> NDArray[np.float64]:
    """Convert real numbers of any common type to an array of doubles.

    Args:
        values: an array, a tensor, a list or a number.
        argument: name of the argument, for the message.
        finite: whether NaN and infinite numbers are refused.

    Returns:
        An array of the same shape.

    Raises:
        InputError: there is something else than real numbers.
    """
    try:
        numbers = _doubles_of(values)
    except OverflowError:
        raise InputError(f"{argument}: expected finite numbers, got one that is larger than any float") from None
    if numbers is None:
        kind = getattr(values, "dtype", None)
        got = type(values).__name__ + ("" if kind is None else f" of {kind}")
        raise InputError(f"{argument}: expected real numbers in rows of one length, got {got}")
    if finite:
        check(bool(np.isfinite(numbers).all()), argument, "finite numbers", "infinite ones or NaN; leave these out")
    return numbers


def _doubles_of(values: object) -> NDArray[np.float64] | None:
    """Convert numbers to an array; None for other things, and `OverflowError` for one that is larger than any float."""
    if isinstance(values, Tensor):
        values = values.detach().cpu()
        if values.dtype == torch.bfloat16:
            values = values.float()  # NumPy has no such numbers
    try:
        array = np.asarray(values)
        # Booleans, whole numbers, floats, and objects, as which NumPy takes whole numbers of more than 64 bits.
        return array.astype(np.float64) if array.dtype.kind in "buifO" else None
    except (TypeError, ValueError, RuntimeError):
        return None


def as_path(points: object, argument: str, *, least: int = 0) -> NDArray[np.float64]:
    """Convert the points of fixations to an array.

    Args:
        points: `(n, 2)`, or nothing.
        argument: name of the argument, for the message.
        least: smallest number of points; 1 where there must be one.

    Returns:
        `(n, 2)`, finite.

    Raises:
        InputError: there is something else, or too few points.
    """
    path = as_array(points, argument, finite=True)
    path = path.reshape(0, 2) if path.shape == (0,) else path  # an empty list has no second dimension
    check(path.ndim == 2 and path.shape[1] == 2, argument, "fixations of shape (n, 2)", path.shape)
    check(len(path) >= least, argument, "at least one fixation", "none")
    return path


def _box(corners: _Values) -> tuple[float, float, float, float]:
    """Take the corners of a box, `(2, 2)`, to pieces."""
    x1, y1, x2, y2 = corners.reshape(-1).tolist()
    return x1, y1, x2, y2


_ObjectBox = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Fixations:
    """Fixations of one person or one model in one picture, in order.

    Attributes:
        picture: name of the picture.
        subject: name of the person or model.
        points: `(n, 2)`, `(x, y)` in pixels of a frame, pixel centres at integers.
        size: `(width, height)` of that frame: the picture, or the screen where the picture's size is not known.
        durations: `(n,)`, in milliseconds; None where they were not recorded.
        target: name of the class that was searched for; None in free viewing.
        box: box of the target, `(x1, y1, x2, y2)`, pixel edges; None where it is not known.
        found: whether the search ended on its target; None where it is not known.

    >>> scanpath = Fixations("1001.jpg", "1", np.array([[0.0, 1.0], [31.0, 23.0]]), (32, 24))
    >>> scanpath.resized((64, 48)).points
    array([[ 0.5,  2.5],
           [62.5, 46.5]])
    """

    picture: str
    subject: str
    points: _Values
    size: tuple[int, int]
    durations: _Values | None = None
    target: str | None = None
    box: _ObjectBox | None = None
    found: bool | None = None

    def __post_init__(self) -> None:
        """Check that the arrays belong together; lists and tensors become arrays."""
        points = as_array(self.points, "points")
        # The only way to set an attribute of a frozen dataclass.
        object.__setattr__(self, "points", points)
        if self.durations is not None:
            object.__setattr__(self, "durations", as_array(self.durations, "durations"))
        are_points = points.ndim == 2 and points.shape[1] == 2 and len(points) > 0
        check(are_points, "points", "(n, 2), at least one fixation", points.shape)
        check(bool(np.isfinite(points).all()), "points", "finite numbers", "NaN or infinite ones")
        check_sides("size", self.size)
        if self.durations is not None:
            self._check_durations(self.durations)
        if self.box is not None:
            x1, y1, x2, y2 = self.box
            is_finite = bool(np.isfinite(self.box).all())
            check(is_finite and x1 <= x2 and y1 <= y2, "box", "(x1, y1, x2, y2) with x1 <= x2 and y1 <= y2", self.box)

    def _check_durations(self, durations: _Values) -> None:
        """Raise `InputError` unless durations `(n,)` are times, one for each fixation."""
        count = len(self.points)
        check(durations.shape == (count,), "durations", f"{count} numbers", durations.shape)
        are_times = bool(np.isfinite(durations).all() and (durations >= 0).all())
        check(are_times, "durations", "milliseconds, 0 or more", durations.tolist()[:5])

    def __len__(self) -> int:
        """Count the fixations, the first included."""
        return len(self.points)

    def resized(self, size: tuple[int, int]) -> "Fixations":
        """Convert the fixations to pixels of the same frame at another size.

        Args:
            size: `(width, height)` of the frame.

        Returns:
            The converted record.
        """
        scale = np.array(size) / np.array(self.size)
        points = (self.points + 0.5) * scale - 0.5
        box = None
        if self.box is not None:
            box = _box(np.array(self.box).reshape(2, 2) * scale)
        return replace(self, points=points, size=size, box=box)

    def in_picture(
        self,
        size: tuple[int, int],
        *,
        scale: float | None = None,
        place: tuple[float, float, float, float] | None = None,
    ) -> "Fixations":
        """Convert the fixations to pixels of a picture that was shown on the frame.

        Args:
            size: `(width, height)` of the picture.
            scale: screen pixels per picture pixel of a picture in the middle of the frame, 1 for one that was shown at
                its own size; None for the largest picture that fits (`Letterbox`).
            place: `(x, y, width, height)` that the picture covered, from the corner of the frame, in its pixels; None
                for a picture in the middle.

        Returns:
            The converted record; points outside the picture are kept.

        Raises:
            InputError: a size is not above 0, or both `scale` and `place` are given.

        >>> seen = Fixations("a.jpg", "1", np.array([[400.0, 300.0]]), (1600, 1200))
        >>> seen.in_picture((800, 600), scale=1).points, seen.in_picture((400, 300), place=(0, 0, 800, 600)).points
        (array([[0., 0.]]), array([[199.75, 149.75]]))
        """
        check(scale is None or place is None, "place", "None beside scale, or scale=None", place)
        corner, scales = self._placement(size, scale, place)
        points = (self.points + 0.5 - corner) / scales - 0.5
        box = None
        if self.box is not None:
            box = _box((np.array(self.box).reshape(2, 2) - corner) / scales)
        return replace(self, points=points, size=size, box=box)

    def _placement(
        self, size: tuple[int, int], scale: float | None, place: tuple[float, float, float, float] | None
    ) -> tuple[_Values, _Values]:
        """Find where a picture was shown; the arguments are those of `in_picture`.

        Returns:
            The corner of the picture on the frame, and screen pixels per picture pixel along x and y, `(2,)` both.
        """
        letterbox = Letterbox(self.size, size)  # which checks the sizes
        if scale is not None:
            check_number(scale, "scale", 1e-6, 1e6)
            borders = np.array(self.size) - scale * np.array(size)
            return borders / 2, np.array((scale, scale))
        if place is not None:
            sides = as_array(place, "place", finite=True)
            is_box = sides.shape == (4,) and bool((sides[2:] > 0).all())
            check(is_box, "place", "(x, y, width, height), with a width and a height above 0", place)
            return sides[:2], sides[2:] / size
        return np.array(letterbox.offset), np.array((letterbox.scale, letterbox.scale))

    def first(self, count: int) -> "Fixations":
        """Select the first fixations.

        Args:
            count: number of fixations.

        Returns:
            The shortened record.
        """
        durations = None if self.durations is None else self.durations[:count]
        return replace(self, points=self.points[:count], durations=durations)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Whether each fixation is inside the frame, `(n,)` boolean."""
        return inside_frame(self.points, np.array(self.size))


def inside_frame(points: _Values, sides: NDArray[np.number]) -> NDArray[np.bool_]:
    """Tell which points lie inside a frame, whose pixels have their centres at integers.

    Args:
        points: `(n, 2)`.
        sides: width and height of the frame, `(2,)`, or of the frame of each point, `(n, 2)`.

    Returns:
        `(n,)` boolean.
    """
    return np.asarray(((points >= -0.5) & (points < sides - 0.5)).all(1))


def bare_name(picture: str) -> str:
    r"""Return the name of a picture without folders (of any operating system) and suffix.

    >>> bare_name("C:\\pictures\\1013.jpg"), bare_name("pictures/1013.jpg")
    ('1013', '1013')
    """
    return PureWindowsPath(picture).stem  # which takes both kinds of slashes


def by_picture(fixations: Iterable[Fixations]) -> dict[str, list[Fixations]]:
    """Group records by picture.

    Args:
        fixations: the records.

    Returns:
        The records of each picture, pictures in the order of their names.

    >>> points = np.zeros((1, 2))
    >>> records = [Fixations(name, "1", points, (800, 600)) for name in ("b.jpg", "a.jpg", "b.jpg")]
    >>> {name: len(group) for name, group in by_picture(records).items()}
    {'a.jpg': 1, 'b.jpg': 2}
    """
    pictures: dict[str, list[Fixations]] = {}
    for record in fixations:
        pictures.setdefault(record.picture, []).append(record)
    return dict(sorted(pictures.items()))

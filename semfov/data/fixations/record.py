"""The record of one person's fixations in one picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations.screen import Letterbox, resized_box, resized_points
from semfov.errors import check

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Fixations:
    """Fixations of one person, or of a model, in one picture, in order.

    Attributes:
        picture: its name.
        subject: who looked.
        points: `(n, 2)`, `(x, y)` in pixels of a frame, pixel centres at integers.
        size: `(width, height)` of that frame: the picture, or the screen where the picture's size is not known.
        durations: `(n,)`, in milliseconds; None where they were not recorded.
        target: name of what was searched for; None where nothing was.
        box: `(x1, y1, x2, y2)`, pixel edges, of the target; None where it is not known.
        found: whether the search ended on its target; None where nobody says.
    """

    picture: str
    subject: str
    points: Array
    size: tuple[int, int]
    durations: Array | None = None
    target: str | None = None
    box: Box | None = None
    found: bool | None = None

    def __post_init__(self) -> None:
        """Check that the arrays belong together."""
        shape = self.points.shape
        check(len(shape) == 2 and shape[1] == 2 and shape[0] > 0, "points", "(n, 2), at least one fixation", shape)
        check(bool(np.isfinite(self.points).all()), "points", "finite numbers", "others")
        check(min(self.size) > 0, "size", "a width and a height above 0", self.size)
        if self.durations is not None:
            check(self.durations.shape == shape[:1], "durations", f"{shape[0]} numbers", self.durations.shape)

    def __len__(self) -> int:
        """Number of fixations, the first included."""
        return len(self.points)

    def resized(self, size: tuple[int, int]) -> Fixations:
        """In pixels of the same frame at another size."""
        box = None if self.box is None else resized_box(self.box, self.size, size)
        return replace(self, points=resized_points(self.points, self.size, size), size=size, box=box)

    def in_picture(self, size: tuple[int, int]) -> Fixations:
        """In pixels of a picture of this size that was shown letterboxed on the frame; no point is clipped."""
        placed = Letterbox(self.size, size)
        box = None if self.box is None else placed.box_to_picture(self.box)
        return replace(self, points=placed.to_picture(self.points), size=size, box=box)

    def first(self, count: int) -> Fixations:
        """The first so many fixations."""
        durations = None if self.durations is None else self.durations[:count]
        return replace(self, points=self.points[:count], durations=durations)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which fixations are in the frame, `(n,)`."""
        return np.asarray(((self.points >= -0.5) & (self.points < np.array(self.size) - 0.5)).all(1))


def by_picture(fixations: Iterable[Fixations]) -> dict[str, list[Fixations]]:
    """The records of each picture, pictures in the order of their names."""
    pictures: dict[str, list[Fixations]] = {}
    for each in fixations:
        pictures.setdefault(each.picture, []).append(each)
    return dict(sorted(pictures.items()))

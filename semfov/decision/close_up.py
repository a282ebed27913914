"""The record of a closer look."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class CloseUp:
    """A closer look at a place that seems to hold the target.

    Attributes:
        fixation: number of the fixation after which it was made; None in a large picture.
        target: the class that was looked for, 1..K; in a search for several classes the most probable one at that time.
        cell: the cell of the target, if it is there; None in a large picture.
        box: `(4,)`, the box of the target as `(x1, y1, x2, y2)` in pixels, if it is there.
        place: probability that the target is there.
        presence: probability that the image holds the target, after the closer look.
        number: in a large picture, number of the look in the path (the overview is 0); otherwise None.
    """

    fixation: int | None
    target: int
    cell: int | None
    box: Tensor
    place: float
    presence: float
    number: int | None = None

"""Search for the box that pictures covered on the screen of a recording, from the fixations."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_Array = NDArray[np.float64]

_STEPS = (0.04, 0.02, 0.01, 0.005)  # shares of the box's sides by which it is changed, one after the other
_LEAST_BITS = 1e-6  # by which a change must fit better; less is rounding
_MOST_CHANGES = 200  # of one size of step, by which a box may travel eight times its sides


class PicturePlace(NamedTuple):
    """The box that pictures covered on a frame.

    Attributes:
        corner: left and top edge in pixels of the frame, `(2,)`.
        sides: width and height in pixels of the frame, `(2,)`.

    >>> place = PicturePlace(np.array([240.0, 212.0]), np.array([800.0, 600.0]))
    >>> place.shares(np.array([[639.5, 511.5]]))
    array([[0.5, 0.5]])
    """

    corner: _Array
    sides: _Array

    def shares(self, points: _Array) -> _Array:
        """Convert points `(n, 2)` in pixels of the frame to shares of the sides of the pictures."""
        return np.asarray((points + 0.5 - self.corner) / self.sides)

    def resized(self, factors: _Array) -> "PicturePlace":
        """Resize the box around its middle, by factors of its width and its height `(2,)`."""
        sides = self.sides * factors
        return PicturePlace(self.corner + (self.sides - sides) / 2, sides)

    def moved(self, shares: _Array) -> "PicturePlace":
        """Move the box by shares of its width and its height `(2,)`."""
        return PicturePlace(self.corner + shares * self.sides, self.sides)

    def neighbours(self, step: float) -> Iterator["PicturePlace"]:
        """Yield boxes moved or resized by one step along one axis, then boxes resized along both axes."""
        for axis in np.eye(2):
            for change in (-step * axis, step * axis):
                yield self.moved(change)
                yield self.resized(1 + change)
        for factor in (1 - step, 1 + step):
            yield self.resized(np.full(2, factor))


def best_place(start: PicturePlace, fit_of: Callable[[PicturePlace], float]) -> PicturePlace:
    """Find the box with the best fit near another one, by smaller and smaller steps.

    Args:
        start: a box that shares at least some of the pictures with the best one.
        fit_of: how well fixations fit pictures in a box; more is better.

    Returns:
        The box.

    >>> start = PicturePlace(np.zeros(2), np.array([100.0, 100.0]))
    >>> place = best_place(start, lambda box: -np.abs(box.corner - [40, -20]).sum() - np.abs(box.sides - 80).sum())
    >>> bool(np.abs(place.corner - [40, -20]).max() < 1 and np.abs(place.sides - 80).max() < 1)
    True
    """
    best = start
    best_fit = fit_of(start)
    for step in _STEPS:
        for _ in range(_MOST_CHANGES):
            fits = [(fit_of(neighbour), neighbour) for neighbour in best.neighbours(step)]
            fit, neighbour = max(fits, key=lambda found: found[0])
            if fit <= best_fit + _LEAST_BITS:
                break
            best_fit = fit
            best = neighbour
    return best

"""The objects that a tracker knows of, as columns."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.detection.objects import Objects
from semfov.motion import Motion
from semfov.tracking.kalman import Floats, Kinematics

TRAIL = 32  # frames
_STANDING = 0.2  # share of the objects that stand still
_MOVING = 1.5  # log odds for an object that is seen to move: what only looks like one is mostly a part of the ground
_PART = 0.5  # share of a box that lies in that of another object from which on both may be one that moves
_ROUNDING = 1e-6

_Index = NDArray[np.intp] | NDArray[np.bool_] | slice


@dataclass(frozen=True, eq=False)
class Tracks:
    """Objects that move, in the pixels of the present frame; some are beyond it, or hidden.

    Attributes:
        track_ids: `(N,)`, numbers from 1 that stay with the objects.
        labels: `(N,)`, classes 1..K.
        kinematics: their places and velocities.
        rest_place: `(N, 2)`, where they were in the last look that showed each, or in a later frame in which it moved
            last, carried along with the camera.
        speed: `(N,)`, standard deviation of each coordinate of a velocity before it is known, in pixels a second.
        log_size: `(N, 2)`, logarithms of width and height in pixels.
        size_variance: `(N,)`, variance of these.
        shown_odds: `(N,)`, log odds that they exist, by the best detection of each.
        missed_odds: `(N,)`, what looks that should have shown them have changed these by since their last detection.
        unseen: `(N,)`, seconds since a look showed them.
        magnification: `(N,)`, of the last look that showed each, canvas pixels for a pixel of the frame.
        passes: `(N,)`, number of the last look that showed each; the first look of the stream is 0.
        trail: `(N, 32, 2)`, where they were in the last frames, the newest place last; NaN before they were known.

    >>> len(Tracks.none()), Tracks.none().boxes.shape
    (0, torch.Size([0, 4]))
    """

    track_ids: NDArray[np.int64]
    labels: NDArray[np.int64]
    kinematics: Kinematics
    rest_place: Floats
    speed: Floats
    log_size: Floats
    size_variance: Floats
    shown_odds: Floats
    missed_odds: Floats
    unseen: Floats
    magnification: Floats
    passes: NDArray[np.int64]
    trail: Floats

    def __len__(self) -> int:
        return len(self.track_ids)

    @classmethod
    def none(cls) -> "Tracks":
        """Make a set of no objects.

        Returns:
            The objects of a stream of which nothing was seen.
        """
        nothing = np.zeros(0)
        numbers = np.zeros(0, np.int64)
        kinematics = Kinematics(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2)))
        return cls(
            track_ids=numbers,
            labels=numbers,
            kinematics=kinematics,
            rest_place=np.zeros((0, 2)),
            speed=nothing,
            log_size=np.zeros((0, 2)),
            size_variance=nothing,
            shown_odds=nothing,
            missed_odds=nothing,
            unseen=nothing,
            magnification=nothing,
            passes=numbers,
            trail=no_trail(0),
        )

    @cached_property
    def standing(self) -> Floats:
        r"""Probabilities that the objects stand still in the scene, `(N,)`.

        The odds for a velocity of zero are those of its density after the looks to that before (Dickey, 1971), with the
        velocity v, its variance :math:`\sigma^2` and that before, :math:`\sigma_0^2`, along each axis:

        .. math:: \frac{\sigma_0^2}{\sigma^2} \exp\Bigl(-\frac{|v|^2}{2 \sigma^2}\Bigr)
        """
        # What was not seen for long may have begun to move: that it is known less than at first is no evidence of it.
        variance = np.minimum(self.kinematics.covariance[:, 1, 1], self.speed**2)
        squared = (self.kinematics.velocity**2).sum(-1)
        by_looks = np.log(self.speed**2 / variance) - squared / (2 * variance)
        prior = np.log(_STANDING / (1 - _STANDING))
        return np.exp(-np.logaddexp(0, -(prior + by_looks)))

    @cached_property
    def moves(self) -> NDArray[np.bool_]:
        """Whether they rather move than stand still, `(N,)`."""
        return self.standing < 0.5

    @cached_property
    def place(self) -> Floats:
        """Places of the objects, `(N, 2)` in pixels; objects that stand still keep the place where they stopped."""
        return np.where(self.moves[:, None], self.kinematics.place, self.rest_place)

    @cached_property
    def corners(self) -> Floats:
        """Their boxes, `(N, 4)` as an array."""
        half = np.exp(self.log_size) / 2
        place = self.place
        return np.concatenate([place - half, place + half], -1)

    @property
    def boxes(self) -> Tensor:
        """Their boxes, `(N, 4)`, `(x1, y1, x2, y2)` in pixels."""
        return torch.from_numpy(self.corners).float()

    @cached_property
    def sides(self) -> Floats:
        """Roots of the areas of their boxes, `(N,)`, in pixels."""
        return np.exp(self.log_size.mean(-1))

    @property
    def velocities(self) -> Tensor:
        """Their velocities relative to the scene, `(N, 2)`, in pixels a second."""
        return torch.from_numpy(self.kinematics.velocity).float()

    @property
    def log_odds(self) -> Floats:
        """Log odds that the objects exist, `(N,)`, from the looks; objects that visibly move have higher ones."""
        return self.shown_odds + self.missed_odds + self.moving_odds

    @cached_property
    def moving_odds(self) -> Floats:
        r"""Amounts added to the log odds of objects that visibly move, `(N,)`.

        With the probability s that it stands still, which is .2 before an object was seen twice, it is

        .. math:: 1.5 \, (1 - s / 0.2)_+

        A part of an object moves with it, so that nothing is added where a more probable object of the class that moves
        shares half of the smaller box.
        """
        moves = (1 - self.standing / _STANDING).clip(0)
        rows = np.flatnonzero(moves > _ROUNDING)
        moves[rows[self._are_parts(rows)]] = 0
        return _MOVING * moves

    def _are_parts(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Tell which of some tracks lie in, or around, a more probable one of these of their class, `(M,)`."""
        by_looks = (self.shown_odds + self.missed_odds)[rows]
        labels = self.labels[rows]
        boxes = self.corners[rows]
        area = self.sides[rows] ** 2
        shared = np.minimum(boxes[:, None, 2:], boxes[:, 2:]) - np.maximum(boxes[:, None, :2], boxes[:, :2])
        is_same = shared.clip(0).prod(-1) >= _PART * np.minimum(area[:, None], area)
        is_same &= labels[:, None] == labels
        return np.asarray((is_same & (by_looks > by_looks[:, None])).any(1))

    @property
    def existence(self) -> Floats:
        """Probabilities that they exist, `(N,)`, wherever they are."""
        return 1 / (1 + np.exp(-self.log_odds))

    @property
    def fits(self) -> Floats:
        r"""Probabilities that their boxes fit them, `(N,)`.

        It is one for an object that stands still, and for one that moves

        .. math:: 1 - \exp\bigl(-r^2 / 2 \sigma^2\bigr), \qquad r = \min(w, h) / 3

        with the variance :math:`\sigma^2` of each coordinate of the place, and the sides w and h of the box: one that
        is off by a third of a side overlaps its object by one half.
        """
        radius = np.exp(self.log_size.min(-1)) / 3
        of_moving = -np.expm1(-(radius**2) / (2 * self.kinematics.variance))
        return self.standing + (1 - self.standing) * of_moving

    @property
    def probability(self) -> Tensor:
        """Probabilities that they are where their boxes are, `(N,)`."""
        return torch.from_numpy(self.existence * self.fits).float()

    def __getitem__(self, index: _Index) -> "Tracks":
        """Select some of the objects."""
        return Tracks(*(getattr(self, name)[index] for name in _COLUMNS))

    def joined(self, others: "Tracks") -> "Tracks":
        """Append other objects.

        Args:
            others: objects in the same frame.

        Returns:
            All of them.
        """
        columns: dict[str, Any] = {}
        for name in _COLUMNS:
            mine = getattr(self, name)
            theirs = getattr(others, name)
            is_array = isinstance(mine, np.ndarray)
            columns[name] = np.concatenate([mine, theirs]) if is_array else mine.joined(theirs)
        return Tracks(**columns)

    def with_rows(self, rows: NDArray[np.intp], others: "Tracks") -> "Tracks":
        """Replace the objects in given rows.

        Args:
            rows: `(M,)`, the places.
            others: M objects in the same frame.

        Returns:
            The objects with the others among them.
        """
        columns: dict[str, Any] = {}
        for name in _COLUMNS:
            column = getattr(self, name)
            theirs = getattr(others, name)
            if isinstance(column, np.ndarray):
                columns[name] = column.copy()
                columns[name][rows] = theirs
            else:
                columns[name] = column.with_rows(rows, theirs)
        return Tracks(**columns)

    def after(self, seconds: float, acceleration: Floats) -> "Tracks":
        """Predict where the objects are some seconds later.

        Args:
            seconds: time since the last frame.
            acceleration: `(N,)`, density of the noise of the velocity (`Kinematics.after`).

        Returns:
            The objects then; those that stand still stay where they are.
        """
        later = replace(self, kinematics=self.kinematics.after(seconds, acceleration), unseen=self.unseen + seconds)
        return replace(later, rest_place=later.place)

    def carried(self, motion: Motion) -> "Tracks":
        """Carry the objects along with the camera.

        Args:
            motion: maps pixels of the last frame to those of the present one.

        Returns:
            The objects in the pixels of the present frame.
        """
        # By a homography, what the camera has turned away from has no place in the frame.
        ahead = self[motion.is_ahead(torch.from_numpy(self.kinematics.place)).numpy()]
        scale = motion.scale_at(torch.from_numpy(ahead.kinematics.place)).numpy()
        return replace(
            ahead,
            kinematics=ahead.kinematics.carried(motion),
            rest_place=motion.points(torch.from_numpy(ahead.rest_place)).numpy(),
            speed=ahead.speed * scale,
            magnification=ahead.magnification / scale,
            log_size=ahead.log_size + np.log(scale)[:, None],
            trail=motion.points(torch.from_numpy(ahead.trail)).numpy(),
        )

    def marked(self, *, anew: bool = False) -> "Tracks":
        """Write the present places to the trails.

        Args:
            anew: whether the trails have places of the present frame already, which are replaced.

        Returns:
            The objects with their trails up to the present frame.
        """
        before = self.trail[:, :-1] if anew else self.trail[:, 1:]
        return replace(self, trail=np.concatenate([before, self.place[:, None]], 1))

    def of_ids(self, track_ids: Tensor) -> "Tracks":
        """Select objects by their numbers.

        Args:
            track_ids: `(M,)`.

        Returns:
            Those of them that are known, by their numbers.
        """
        return self[np.isin(self.track_ids, track_ids.numpy())]

    def ways(self) -> dict[int, list[tuple[float, float]]]:
        """List the places of the objects in the last frames.

        Returns:
            By number of the object, points `(x, y)` in pixels of the present frame, the newest last.
        """
        known = ~np.isnan(self.trail[..., 0])
        ways = {}
        for number, trail, is_known in zip(self.track_ids.tolist(), self.trail, known, strict=True):
            ways[number] = [(x, y) for x, y in trail[is_known].tolist()]
        return ways

    def objects(self) -> Objects:
        """Convert to objects with probabilities as scores, the most probable first."""
        # Stable, so that equals stay in the order of their numbers.
        chosen = self[(-self.existence * self.fits).argsort(kind="stable")]
        return Objects(
            chosen.boxes,
            chosen.probability,
            torch.from_numpy(chosen.labels),
            torch.from_numpy(chosen.passes),
            track_ids=torch.from_numpy(chosen.track_ids),
        )


_COLUMNS = tuple(column.name for column in fields(Tracks))


def no_trail(count: int) -> Floats:
    """Make the trails of objects that were in no frame, `(count, 32, 2)`."""
    return np.full((count, TRAIL, 2), np.nan)

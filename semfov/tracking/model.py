"""Model of moving objects, and of the looks that show them, for a tracker."""

from dataclasses import dataclass

import numpy as np

from semfov.tracking.kalman import Floats

_LEAST_SCORE = 0.01  # scores below, and above the next one, count as these
_MOST_SCORE = 0.99


@dataclass(frozen=True)
class TrackingModel:
    r"""Parameters of a tracker. Lengths are in units of an object's side, the root of its area.

    A look shows an object that has a side of s pixels on the canvas of the detector with the probability

    .. math:: d(s) = \sigma\bigl(a \, (\log_2 s - b)\bigr)

    and the log odds that it exists are those of its best detection, of score c, less what looks since its last
    detection have taken that should have shown it:

    .. math:: \max_j \bigl(e_0 + e_1 \operatorname{logit} c_j\bigr) + w \sum_i \log\bigl(1 - d(s_i)\bigr)

    An object that is seen to move is more probable than that (`Tracks.moving_odds`).

    Objects that are hard to see are missed again and again, so that w is less than 1. What a look as close has shown is
    seen again with the probability :math:`\rho q`, where q is that of what was shown, and a miss counts in full.

    Attributes:
        speed: standard deviation of each coordinate of an object's velocity, in sides a second.
        acceleration: density of the noise of the velocity, in square sides a second cubed.
        place: standard deviation of each coordinate of a place at which a look shows an object, in sides.
        pixel: the same of the finest place that a detector tells, in pixels of its canvas.
        flow: standard deviation of each coordinate of an object's motion between two frames, in sides.
        unsteady: the same of the motion of the scene about it, in pixels of the frame.
        size: standard deviation of the logarithm of the width and height of a box.
        entering: the same after a look at an object that the border of the frame cuts, so that the next look decides.
        growth: variance by which the logarithm of the size changes in a second.
        gate: largest squared distance of a detection from its object, in variances.
        density: logarithm of the density of detections of other objects, for a square side.
        slope: a, for an octave.
        middle: b, in octaves.
        offset: :math:`e_0`.
        score: :math:`e_1`.
        miss: w.
        again: :math:`\rho`.
        staleness: rate at which what a look showed of an object counts less for the choice of looks, per second.
        loss: share of the objects that cease to be there in a second.
        least: probability below which an object is forgotten.

    >>> model = TrackingModel(miss=0.5)
    >>> float(model.evidence(np.array([0.5]))[0])
    0.0
    """

    speed: float = 2.0
    acceleration: float = 0.25
    place: float = 0.08
    pixel: float = 0.5
    flow: float = 0.02
    unsteady: float = 0.5
    size: float = 0.2
    entering: float = 0.5
    growth: float = 0.01
    gate: float = 16.0
    density: float = -4.0
    slope: float = 1.07
    middle: float = 4.45
    offset: float = 0.0
    score: float = 1.2
    miss: float = 0.3
    again: float = 0.9
    staleness: float = 0.25
    loss: float = 0.1
    least: float = 0.02

    def detects(self, side: Floats) -> Floats:
        """Compute the probability that a look shows an object.

        Args:
            side: `(...)`, root of the object's area in pixels of the canvas.

        Returns:
            `(...)`.

        >>> TrackingModel().detects(np.array([12.0, 50.0])).round(2).tolist()
        [0.28, 0.78]
        """
        octaves = np.log2(np.maximum(side, 1.0))
        return 1 / (1 + np.exp(-self.slope * (octaves - self.middle)))

    def evidence(self, scores: Floats) -> Floats:
        """Compute the log odds of an object by a detection of it.

        Args:
            scores: `(M,)`, from 0 to 1.

        Returns:
            `(M,)`.
        """
        clipped = scores.clip(_LEAST_SCORE, _MOST_SCORE)
        return self.offset + self.score * np.log(clipped / (1 - clipped))

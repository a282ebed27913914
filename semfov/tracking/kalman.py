"""Places and velocities of many objects: a Kalman filter of constant velocity."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from semfov.motion import Motion

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Kinematics:
    r"""Places and velocities of objects in the pixels of a frame, each with its covariance.

    Both axes have the same noise, so that the covariance of place and velocity is one 2 × 2 matrix for each object, and
    a turn of the camera does not change it.

    Attributes:
        place: `(N, 2)`, `(x, y)` in pixels.
        velocity: `(N, 2)`, in pixels a second.
        covariance: `(N, 2, 2)`, of place and velocity along an axis.

    >>> still = Kinematics.at(np.array([[10.0, 20.0]]), variance=np.array([4.0]), speed=np.array([5.0]))
    >>> later = still.after(2.0, acceleration=np.zeros(1))
    >>> later.place.tolist(), float(later.variance[0])  # 4 + 2² · 5²
    ([[10.0, 20.0]], 104.0)
    >>> moving = later.measured(np.array([[30.0, 20.0]]), variance=np.array([4.0]))
    >>> moving.velocity.round(1).tolist()
    [[9.3, 0.0]]
    """

    place: Floats
    velocity: Floats
    covariance: Floats

    def __len__(self) -> int:
        return len(self.place)

    @classmethod
    def at(cls, place: Floats, variance: Floats, speed: Floats) -> "Kinematics":
        """Place objects whose velocity is not known.

        Args:
            place: `(N, 2)`, where they were seen, in pixels.
            variance: `(N,)`, of each coordinate of these places.
            speed: `(N,)`, standard deviation of each coordinate of the velocity, in pixels a second.

        Returns:
            The objects, with a mean velocity of zero.
        """
        covariance = np.zeros((len(place), 2, 2))
        covariance[:, 0, 0] = variance
        covariance[:, 1, 1] = speed**2
        return cls(place.copy(), np.zeros_like(place), covariance)

    @property
    def variance(self) -> Floats:
        """Variance of each coordinate of the places, `(N,)`."""
        return self.covariance[:, 0, 0]

    def after(self, seconds: float, acceleration: Floats) -> "Kinematics":
        r"""Predict the objects some seconds later, with white noise of the acceleration (Bar-Shalom et al., 2001).

        .. math:: P \leftarrow F P F^\top + q \begin{pmatrix} t^3 / 3 & t^2 / 2 \\ t^2 / 2 & t \end{pmatrix}, \qquad
                  F = \begin{pmatrix} 1 & t \\ 0 & 1 \end{pmatrix}

        Args:
            seconds: t.
            acceleration: `(N,)`, q, density of the noise in square pixels a second cubed.

        Returns:
            The objects then.
        """
        step = np.array([[1.0, seconds], [0.0, 1.0]])
        noise = np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        covariance = step @ self.covariance @ step.T + acceleration[:, None, None] * noise
        return Kinematics(self.place + seconds * self.velocity, self.velocity, covariance)

    def measured(self, place: Floats, variance: Floats) -> "Kinematics":
        r"""Update the objects by places at which they were seen.

        .. math:: K = P H^\top / (H P H^\top + r), \qquad P \leftarrow P - K H P, \qquad H = (1, 0)

        Args:
            place: `(N, 2)`, in pixels.
            variance: `(N,)`, r, of each coordinate of these places.

        Returns:
            The objects, seen.
        """
        return self._updated(0, place - self.place, variance)

    def moved(self, velocity: Floats, variance: Floats) -> "Kinematics":
        r"""Update the objects by velocities with which they were seen to move: as `measured`, with H = (0, 1).

        Args:
            velocity: `(N, 2)`, in pixels a second.
            variance: `(N,)`, r, of each coordinate of these velocities.

        Returns:
            The objects, seen to move.
        """
        return self._updated(1, velocity - self.velocity, variance)

    def _updated(self, row: int, surprise: Floats, variance: Floats) -> "Kinematics":
        """Update the objects by what was measured of the place, row 0, or the velocity, 1, beyond what was expected."""
        gain = self.covariance[:, :, row] / (self.covariance[:, row, row] + variance)[:, None]
        covariance = self.covariance - gain[:, :, None] * self.covariance[:, None, row]
        return Kinematics(self.place + gain[:, :1] * surprise, self.velocity + gain[:, 1:] * surprise, covariance)

    def carried(self, motion: Motion) -> "Kinematics":
        """Carry the objects to another frame by the motion of the camera: their places, and how they move there.

        Args:
            motion: maps pixels of this frame to those of the other.

        Returns:
            The objects in the pixels of the other frame.
        """
        place = torch.from_numpy(self.place)
        scale = motion.scale_at(place).numpy()
        moved = motion.points(place).numpy()
        # A velocity is carried by the map's derivative at the place of the object.
        weight = self.place @ motion.matrix[2, :2] + 1.0  # a motion has 1 in the corner of its matrix
        derivative = (motion.matrix[None, :2, :2] - moved[:, :, None] * motion.matrix[None, 2:, :2]) / weight[
            :, None, None
        ]
        velocity = (derivative @ self.velocity[:, :, None])[..., 0]
        return Kinematics(moved, velocity, self.covariance * scale[:, None, None] ** 2)

    def __getitem__(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> "Kinematics":
        """Select some of the objects."""
        return Kinematics(self.place[index], self.velocity[index], self.covariance[index])

    def joined(self, others: "Kinematics") -> "Kinematics":
        """Append other objects.

        Args:
            others: objects in the same frame.

        Returns:
            All of them.
        """
        return Kinematics(
            np.concatenate([self.place, others.place]),
            np.concatenate([self.velocity, others.velocity]),
            np.concatenate([self.covariance, others.covariance]),
        )

    def with_rows(self, rows: NDArray[np.intp], others: "Kinematics") -> "Kinematics":
        """Replace the objects in given rows.

        Args:
            rows: `(M,)`, the places.
            others: M objects in the same frame.

        Returns:
            The objects with the others among them.
        """
        place = self.place.copy()
        velocity = self.velocity.copy()
        covariance = self.covariance.copy()
        place[rows] = others.place
        velocity[rows] = others.velocity
        covariance[rows] = others.covariance
        return Kinematics(place, velocity, covariance)

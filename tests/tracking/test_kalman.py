"""The filter of constant velocity against the textbook's matrices, written plainly for each object."""

import numpy as np
import pytest
import torch

from semfov.motion import Motion
from semfov.tracking.kalman import Kinematics


class Textbook:
    """A Kalman filter of one object with the state (x, y, vx, vy) and full matrices."""

    def __init__(self, place, variance, speed):
        self.x = np.array([*place, 0.0, 0.0])
        self.P = np.diag([variance, variance, speed**2, speed**2])

    def predict(self, t, q):
        F = np.eye(4) + t * np.eye(4, k=2)
        self.x = F @ self.x
        Q = np.kron([[t**3 / 3, t**2 / 2], [t**2 / 2, t]], np.eye(2))
        self.P = F @ self.P @ F.T + q * Q

    def update(self, z, r, first=0):
        """Take a measurement of the two numbers of the state from the first one on."""
        H = np.eye(2, 4, k=first)
        S = H @ self.P @ H.T + r * np.eye(2)
        K = self.P @ H.T @ np.linalg.inv(S)
        self.x = self.x + K @ (z - H @ self.x)
        self.P = (np.eye(4) - K @ H) @ self.P


def test_places_and_velocities_are_those_of_the_textbook():
    random = np.random.default_rng(0)
    places = random.uniform(0, 500, (5, 2))
    variance, speed, noise = random.uniform(1, 9, 5), random.uniform(10, 50, 5), random.uniform(0, 30, 5)
    many = Kinematics.at(places, variance, speed)
    single = [Textbook(*values) for values in zip(places, variance, speed, strict=True)]
    for _ in range(6):
        seconds, seen, spread = random.uniform(0.02, 0.6), random.uniform(0, 500, (5, 2)), random.uniform(1, 9, 5)
        velocities, unsteady = random.uniform(-80, 80, (5, 2)), random.uniform(1, 90, 5)
        many = many.after(seconds, noise).measured(seen, spread).moved(velocities, unsteady)
        for number, one in enumerate(single):
            one.predict(seconds, noise[number])
            one.update(seen[number], spread[number])
            one.update(velocities[number], unsteady[number], first=2)
    for number, one in enumerate(single):
        np.testing.assert_allclose(np.concatenate([many.place[number], many.velocity[number]]), one.x, atol=1e-8)
        np.testing.assert_allclose(np.kron(many.covariance[number], np.eye(2)), one.P, atol=1e-8)


@pytest.mark.parametrize("motion", [
    Motion.similarity(shift=(30, -12), turn=25, scale=1.4),
    Motion(np.array([[1.1, 0.1, 5], [-0.05, 0.95, 3], [2e-4, -1e-4, 1]])),
])  # fmt: skip
def test_a_velocity_is_carried_as_two_places_are(motion):
    """The difference of the carried places of a small step, by the time of the step."""
    place, velocity, step = np.array([[120.0, 80.0]]), np.array([[40.0, -25.0]]), 1e-5
    carried = Kinematics(place, velocity, np.eye(2)[None]).carried(motion)
    ends = motion.points(torch.from_numpy(np.concatenate([place, place + step * velocity]))).numpy()
    np.testing.assert_allclose(carried.place[0], ends[0])
    np.testing.assert_allclose(carried.velocity[0], (ends[1] - ends[0]) / step, rtol=1e-5)
    scale = float(motion.scale_at(torch.from_numpy(place))[0])
    np.testing.assert_allclose(carried.covariance, scale**2 * np.eye(2)[None])


def test_objects_take_the_places_of_others():
    generator = np.random.default_rng(0)
    objects = Kinematics(generator.normal(size=(4, 2)), generator.normal(size=(4, 2)), generator.normal(size=(4, 2, 2)))
    others = objects[np.array([3, 0])]
    mixed = objects.with_rows(np.array([1, 2]), others)
    expected = objects[np.array([0, 3, 0, 3])]
    for name in ("place", "velocity", "covariance"):
        np.testing.assert_array_equal(getattr(mixed, name), getattr(expected, name))
    assert not np.array_equal(objects.place, mixed.place)  # which is a copy

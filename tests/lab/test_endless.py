"""The benchmark of a flight that never returns: its plane, and what it counts."""

import numpy as np
import torch

from benchmarks.endless import SIZE, Plane, arrays_of


def test_views_of_a_plane_show_the_same_pixels_where_they_overlap():
    width, height = SIZE
    plane = Plane()
    first = plane.view(310, 0)
    second = plane.view(310 + 37, 11)  # other tiles are at its left, and at its right
    np.testing.assert_array_equal(second[: height - 11, : width - 37], first[11:, 37:])
    assert not np.array_equal(second, Plane(1).view(310 + 37, 11))


def test_a_plane_goes_on_where_the_camera_has_not_been():
    plane = Plane()
    far = [plane.view(640 * number, 0) for number in range(12)]
    assert all((far[number] != far[other]).any() for number in range(12) for other in range(number))


def test_arrays_are_found_wherever_they_are_held():
    class Memory:
        def __init__(self):
            self.rows = [{"look": torch.zeros(3, 4)}]
            self.steps = self.count()
            next(self.steps)

        def count(self):
            seen = np.zeros(7)
            yield seen
            yield self.rows

    assert sorted(len(array) for array in arrays_of(Memory())) == [3, 7]

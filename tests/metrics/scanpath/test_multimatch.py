"""MultiMatch against the package multimatch-gaze."""

import math

import numpy as np
import pytest

from semfov.errors import InputError
from semfov.metrics.scanpath import multimatch
from tests.refusals import refused

package = pytest.importorskip("multimatch_gaze", reason="pip install multimatch-gaze")


def as_package_array(path, durations):
    rows = [(x, y, t) for (x, y), t in zip(path, durations, strict=True)]
    return np.array(rows, dtype=[("start_x", "<f8"), ("start_y", "<f8"), ("duration", "<f8")])


@pytest.mark.parametrize("seed", range(12))
def test_all_five_similarities_match_the_package(seed):
    generator = np.random.default_rng(seed)
    size = (1680, 1050)
    n, m = generator.integers(3, 12, 2)
    a, b = generator.uniform(0, size, (n, 2)), generator.uniform(0, size, (m, 2))
    s, t = generator.uniform(0.05, 0.9, n), generator.uniform(0.05, 0.9, m)
    ours = multimatch(a, b, size, (s, t))
    np.testing.assert_allclose(
        ours, package.docomparison(as_package_array(a, s), as_package_array(b, t), size), atol=1e-12
    )
    assert ours.mean == pytest.approx(np.mean(ours[:4]))


def test_a_scanpath_matches_itself_and_its_reverse_has_the_opposite_direction():
    path = np.array([[0.0, 0.0], [100.0, 0.0], [200.0, 0.0]])
    same = multimatch(path, path, (400, 300), ([1, 2, 3], [1, 2, 3]))
    assert same == (1, 1, 1, 1, 1)
    back = multimatch(path, path[::-1], (400, 300))
    assert back.direction == pytest.approx(0)
    assert back.length == 1
    assert back.shape == pytest.approx(1 - 200 / 1000)
    assert math.isnan(back.duration)


def test_invalid_and_short_scanpaths_are_refused_by_name():
    assert all(map(math.isnan, multimatch([[0, 0], [1, 1]], [[0, 0], [1, 1], [2, 2]], (10, 10))))
    refused(r"^ours:", multimatch, [0, 1, 2], [[0, 0]] * 3, (10, 10))
    refused(r"^theirs:", multimatch, [[0, 0]] * 3, [0, 1, 2], (10, 10))
    with pytest.raises(InputError, match=r"^durations: expected 3 and 4 numbers, one for each fixation, got \(3, 2\)"):
        multimatch([[0, 0]] * 3, [[0, 0]] * 4, (10, 10), ([1, 2, 3], [1, 2]))


def test_byte_coordinates_do_not_overflow_and_zero_durations_are_equal():
    path = np.array([[200, 10], [100, 250], [250, 20], [5, 5]], dtype=np.uint8)
    other = np.array([[10, 200], [255, 0], [30, 30]], dtype=np.uint8)
    times = np.array([200, 3, 250, 9], dtype=np.uint8), np.array([4, 255, 7], dtype=np.uint8)
    expected = multimatch(path.tolist(), other.tolist(), (256, 256), tuple(each.tolist() for each in times))
    assert multimatch(path, other, (256, 256), times) == expected
    assert multimatch(path, path, (256, 256), ([0] * 4, [0] * 4)).duration == 1

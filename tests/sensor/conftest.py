"""A second implementation of the sensor, in numpy and plain loops, to compare with."""

from math import exp, floor
from types import SimpleNamespace

import numpy as np
import pytest

TAPS = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


def mirror(i, n):
    while not 0 <= i < n:
        i = 0 if n == 1 else -i if i < 0 else 2 * (n - 1) - i
    return i


def along(axis, line_function):
    """A function of images that applies `line_function(line, length)` to every line along `axis`."""
    return lambda image, length: np.apply_along_axis(line_function, axis, image, length)


def blur(line, _=None):
    n = len(line)
    return np.array([sum(TAPS[t] * line[mirror(i + t - 2, n)] for t in range(5)) for i in range(n)])


def resize(line, length):
    n = len(line)
    result = []
    for i in range(length):
        place = max((i + 0.5) * n / length - 0.5, 0.0)
        left = min(floor(place), n - 1)
        share = place - left
        result.append((1 - share) * line[left] + share * line[min(left + 1, n - 1)])
    return np.array(result)


def enlarge_opencv(line, length):
    """As `cv2.pyrUp`: zeros between pixels are filtered, and the last pixel is repeated beyond the border."""
    n = len(line)
    at = lambda i: line[1 if n > 1 else 0] if i < 0 else line[min(i, n - 1)]  # noqa: E731
    even = [(at(i - 1) + 6 * at(i) + at(i + 1)) / 8 for i in range(n)]
    odd = [(at(i) + at(i + 1)) / 2 for i in range(n)]
    return np.array([(even, odd)[i % 2][i // 2] for i in range(length)])


def pyrdown(image, convention):
    for axis in (-2, -1):
        image = along(axis, blur)(image, None)
    height, width = image.shape[-2:]
    if convention == "opencv":
        return image[..., ::2, ::2]
    image = along(-2, resize)(image, max(height // 2, 1))
    return along(-1, resize)(image, max(width // 2, 1))


def pyrup(image, size, convention):
    for axis in (-2, -1):
        if convention == "opencv":
            image = along(axis, enlarge_opencv)(image, size[axis])
        else:
            image = along(axis, blur)(along(axis, resize)(image, size[axis]), None)
    return image


def foveate(image, gaze, sigma, levels, growth, convention):
    """`(C, H, W)` around one fixation `(x, y)`, directly by the formula: every band is expanded separately."""
    pyramid = [image]
    for _ in range(levels):
        pyramid.append(pyrdown(pyramid[-1], convention))
    sizes = [level.shape[-2:] for level in pyramid]

    def to_full(level, k):
        for size in reversed(sizes[:k]):
            level = pyrup(level, size, convention)
        return level

    result = to_full(pyramid[levels], levels)
    for k in range(levels):
        band = pyramid[k] - pyrup(pyramid[k + 1], sizes[k], convention)
        place = [
            [2**k * i if convention == "opencv" else (i + 0.5) * sizes[0][a] / sizes[k][a] - 0.5 for i in range(n)]
            for a, n in enumerate(sizes[k])
        ]
        sx, sy = (s * growth**k for s in sigma)
        for i, y in enumerate(place[0]):
            for j, x in enumerate(place[1]):
                band[:, i, j] *= exp(-((x - gaze[0]) ** 2) / (2 * sx**2) - (y - gaze[1]) ** 2 / (2 * sy**2))
        result = result + to_full(band, k)
    return result


@pytest.fixture(scope="session")
def reference_sensor():
    """`pyrdown`, `pyrup` and `foveate` of float64 arrays."""
    return SimpleNamespace(pyrdown=pyrdown, pyrup=pyrup, foveate=foveate)

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Eye
from semfov.sensor import LogPolar, from_log_polar, gaussian_pyramid, log_polar
from tests.refusals import refused
from tests.small import Blobs, close, draw


def cubic(t):
    """Keys' kernel with a = -3/4."""
    t, a = abs(t), -0.75
    if t <= 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    return a * (t**3 - 5 * t**2 + 8 * t - 4) if t < 2 else 0.0


def read(plane, x, y):
    """Interpolate a plane between its pixels; beyond the border its pixels are repeated."""
    height, width = plane.shape
    total = 0.0
    for j in range(math.floor(y) - 1, math.floor(y) + 3):
        for i in range(math.floor(x) - 1, math.floor(x) + 3):
            total += cubic(x - i) * cubic(y - j) * plane[min(max(j, 0), height - 1), min(max(i, 0), width - 1)]
    return total


def cortical_twin(levels, gaze, a, spacing, pooling, rings, wedges):
    """Cortical image `(M, N)` of a pyramid `[(h, w), ...]`, one receptor at a time."""
    (height, width), result = levels[0].shape, np.zeros((rings, wedges))
    # The pyramid has no more levels than receptors within the diagonal need.
    top = math.ceil(max(math.log2(pooling * spacing * (1 + math.hypot(width, height) / a)), 0))
    for i in range(rings):
        radius = a * (math.exp((i + 0.5) * spacing / a) - 1)
        level = min(max(math.log2(pooling * spacing * (1 + radius / a)), 0.0), top)
        for j in range(wedges):
            x = gaze[0] + radius * math.cos(2 * math.pi * j / wedges)
            y = gaze[1] + radius * math.sin(2 * math.pi * j / wedges)
            for k in {math.floor(level), math.ceil(level)}:
                rows, columns = levels[k].shape
                weight = 1 - abs(level - k)
                u, v = (x + 0.5) * columns / width - 0.5, (y + 0.5) * rows / height - 0.5
                result[i, j] += weight * read(levels[k], u, v)
    return result


@pytest.mark.parametrize("pooling", [1.0, 0.6])
@pytest.mark.parametrize("size", [(16, 24), (17, 13), (1, 1), (1, 6)])
def test_the_cortical_image_equals_a_loop_over_receptors(reference_sensor, size, pooling):
    image, gaze = draw(1, 1, *size), (3.2, 5.5)
    point = torch.tensor(gaze, dtype=torch.float64)
    seen = log_polar(image, point, fovea=3.0, spacing=0.8, pooling=pooling)[0, 0]
    levels = [image[0].numpy()]
    for _ in range(4):
        levels.append(reference_sensor.pyrdown(levels[-1], "kornia"))
    planes = [level[0] for level in levels]
    close(seen, cortical_twin(planes, gaze, 3.0, 0.8, pooling, *seen.shape), 1e-9)


def test_back_projection_equals_a_loop_over_pixels():
    a, spacing, gaze, size = 3.0, 0.8, (4.0, 2.3), (9, 7)
    image = draw(1, 1, *size[::-1])
    point = torch.tensor(gaze, dtype=torch.float64)
    seen = log_polar(image, point, fovea=a, spacing=spacing)
    view = from_log_polar(seen, point, size, fovea=a, spacing=spacing)[0, 0]
    plane = seen[0, 0].numpy()
    rings, wedges = plane.shape

    def receptor(i, j):
        if i < 0:
            i, j = -1 - i, j + wedges // 2
        return plane[min(i, rings - 1), j % wedges]

    for y in range(size[1]):
        for x in range(size[0]):
            radius = math.hypot(x - gaze[0], y - gaze[1])
            u = a * math.log(1 + radius / a) / spacing - 0.5
            v = math.atan2(y - gaze[1], x - gaze[0]) * wedges / (2 * math.pi)
            expected = sum(
                cubic(u - i) * cubic(v - j) * receptor(i, j)
                for i in range(math.floor(u) - 1, math.floor(u) + 3)
                for j in range(math.floor(v) - 1, math.floor(v) + 3)
            )
            assert float(view[y, x]) == pytest.approx(expected, abs=1e-9)


@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    gaze=st.tuples(st.floats(-50, 80), st.floats(-50, 80)),
    fovea=st.floats(1, 100),
    spacing=st.floats(0.5, 3),
)
def test_constant_image_stays_constant(size, gaze, fovea, spacing):
    image = torch.full((1, 2, *size), 0.3, dtype=torch.float64)
    sensor = LogPolar(fovea, spacing)
    seen = sensor.cortical(image, torch.tensor(gaze))
    close(seen, torch.full_like(seen, 0.3), 1e-9)
    close(sensor(image, torch.tensor(gaze)), image, 1e-9)


def test_fewer_receptors_than_pixels():
    sensor = LogPolar(60.0)
    rings, wedges = sensor.retina.receptors((640, 480))
    assert sensor.cortical(draw(1, 1, 480, 640), torch.tensor([9.0, 9.0])).shape[-2:] == (rings, wedges)
    assert wedges == pytest.approx(2 * math.pi * 60, abs=2)
    assert rings == pytest.approx(60 * math.log(1 + 800 / 60), abs=3)
    assert rings * wedges < 640 * 480 / 5


def test_a_fixation_on_a_pixel_has_a_gradient():
    gaze = torch.tensor([4.0, 3.0], requires_grad=True)
    LogPolar(3.0)(draw(1, 1, 9, 9, dtype=torch.float32), gaze).square().sum().backward()
    assert torch.isfinite(gaze.grad).all()
    assert gaze.grad.abs().sum() > 0


@pytest.mark.parametrize("far", [1e4, 1e30])
def test_a_fixation_far_outside_sees_a_blurred_image(far):
    image = draw(1, 3, 60, 80, dtype=torch.float32).requires_grad_()
    gaze = torch.tensor([far, -far], requires_grad=True)
    view = LogPolar(8.0)(image, gaze)
    view.sum().backward()
    assert all(bool(torch.isfinite(each).all()) for each in (view, image.grad, gaze.grad))
    assert view.std() < 0.1 * image.std()


def test_module_equals_the_functions():
    image, gaze = draw(2, 3, 33, 40), torch.tensor([[4.0, 9.0], [30.0, 2.0]])
    sensor = LogPolar(6.0, 0.8, 0.9)
    seen = log_polar(image, gaze, fovea=6.0, spacing=0.8, pooling=0.9)
    close(sensor.cortical(gaussian_pyramid(image, 5), gaze), seen)
    close(sensor(image, gaze), from_log_polar(seen, gaze, (40, 33), fovea=6.0, spacing=0.8))
    assert repr(sensor) == "LogPolar(fovea=6, spacing=0.8, pooling=0.9)"
    assert sensor.settings() == {"kind": "log-polar", "fovea": 6.0, "spacing": 0.8, "pooling": 0.9}


@pytest.mark.parametrize("stretch", [False, True])
def test_the_view_of_an_eye_equals_the_sensor_on_the_full_image(stretch):
    """At the resolution of the detector, with and without stretching of the image."""
    detector = Blobs()
    detector.stretch = stretch
    eye, sensor = Eye(LogPolar(8.0), detector, reference=256.0), LogPolar(8.0)
    coarse = draw(1, 3, 40, 25, dtype=torch.float32)
    picture = torch.nn.functional.interpolate(coarse, (256, 160), mode="bicubic").clamp(0, 1)
    gaze = torch.tensor([[100.0, 60.0], [20.0, 200.0]])
    view = eye.open(picture)
    shown = eye.foveated(view, gaze)
    expected = torch.cat([detector.fit(sensor(picture, one).clamp(0, 1))[0] for one in gaze])
    left, top = view.placement.offset
    inner = shown[..., top : 48 - top, left : 64 - left], expected[..., top : 48 - top, left : 64 - left]
    other = torch.cat([detector.fit(sensor(picture, one).clamp(0, 1))[0] for one in gaze.flip(0)])
    error = (inner[0] - inner[1])[..., 2:-2, 2:-2].square().mean().sqrt()
    moved = (inner[0] - other[..., top : 48 - top, left : 64 - left])[..., 2:-2, 2:-2].square().mean().sqrt()
    assert error < 0.03
    assert moved > 2 * error
    assert eye.look(view, gaze).boxes.shape[0] == 2
    assert eye.settings()["sensor"] == sensor.settings() | {"reference": 256.0}


IMAGE = torch.rand(2, 3, 8, 8)


def test_bad_input():
    for arguments, message in [
        ({"fovea": 0.0}, "fovea: expected a positive number, got 0.0"),
        ({"fovea": math.inf}, "fovea: expected a positive number, got inf"),
        ({"spacing": -1.0}, "spacing: expected a positive number, got -1.0"),
        ({"spacing": 1e-4}, "spacing: expected a distance large enough for at most 67,108,864 receptors, got 0.0001"),
        ({"pooling": math.nan}, "pooling: expected a positive number, got nan"),
    ]:
        arguments = {"image": IMAGE, "gaze": torch.tensor([4.0, 4.0]), "fovea": 3.0} | arguments
        refused(message.replace("(", r"\("), log_polar, **arguments)
    seen = log_polar(IMAGE, torch.tensor([4.0, 4.0]), fovea=3.0)
    refused("cortical: expected a tensor of shape", from_log_polar, seen, torch.tensor([4.0, 4.0]), (8, 8), fovea=4.0)
    refused("cortical: expected 5 dimensions", from_log_polar, seen, torch.rand(2, 3, 2), (8, 8), fovea=3.0)
    refused("size: expected", from_log_polar, seen, torch.tensor([4.0, 4.0]), (0, 8), fovea=3.0)

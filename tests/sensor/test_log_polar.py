"""Further sensors: the log-polar one against loops over receptors, and crops at several scales."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Eye, InputError, load_detector
from semfov.sensor import LogPolar, MultiScaleFovea, from_log_polar, gaussian_pyramid, log_polar
from tests.colours import write_network
from tests.refusals import refused
from tests.small import Blobs, Coloured, close, draw


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


def test_there_are_fewer_receptors_than_pixels_and_a_fixation_on_one_has_a_gradient():
    sensor = LogPolar(60.0)
    rings, wedges = sensor.retina.receptors((640, 480))
    assert sensor.cortical(draw(1, 1, 480, 640), torch.tensor([9.0, 9.0])).shape[-2:] == (rings, wedges)
    assert wedges == pytest.approx(2 * math.pi * 60, abs=2)
    assert rings == pytest.approx(60 * math.log(1 + 800 / 60), abs=3)
    assert rings * wedges < 640 * 480 / 5
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


def shares(start, step, side, length):
    """Share of each of `length` pixels in each of `side` intervals of `step` pixels from `start` on."""
    low, pixel = start + step * np.arange(side)[:, None], np.arange(length)
    return (np.minimum(low + step, pixel + 1) - np.maximum(low, pixel)).clip(0) / step


def crop_twin(image, gaze, side, scale):
    """One crop `(C, side, side)` of an image `(C, H, W)`: products with matrices of shares."""
    step = 2**scale
    x, y = (place + 0.5 - side * step / 2 for place in gaze)
    return shares(y, step, side, image.shape[1]) @ image @ shares(x, step, side, image.shape[2]).T


@given(
    size=st.tuples(st.integers(1, 20), st.integers(1, 20)),
    gaze=st.tuples(st.floats(-30, 50), st.floats(-30, 50)),
    side=st.integers(1, 7),
    scales=st.integers(1, 4),
)
def test_the_crops_equal_products_with_shares_of_pixels(size, gaze, side, scales):
    image = draw(1, 2, *size)
    seen = MultiScaleFovea(side, scales)(image, torch.tensor(gaze, dtype=torch.float64))
    close(seen[0], np.stack([crop_twin(image[0].numpy(), gaze, side, scale) for scale in range(scales)]), 1e-9)


def crop_opencv(image, gaze, side, scale):
    """A crop whose edges lie between pixels, of an image `(H, W, C)`, by OpenCV's resampling by areas."""
    wide = side * 2**scale
    left, top = (round(place + 0.5 - wide / 2) for place in gaze)
    part = np.zeros((wide, wide, 3), image.dtype)
    inside = image[max(top, 0) : max(top + wide, 0), max(left, 0) : max(left + wide, 0)]
    part[max(-top, 0) :, max(-left, 0) :][: len(inside), : inside.shape[1]] = inside
    return cv2.resize(part, (side, side), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("size", [(1, 1), (1, 700), (479, 640), (1500, 2000)])
def test_the_crops_equal_those_of_opencv(size):
    height, width = size
    gaze = width // 3 - 0.5, height // 2 - 0.5
    image = np.random.default_rng(0).random((height, width, 3), dtype=np.float32)
    seen = MultiScaleFovea()(torch.from_numpy(image).permute(2, 0, 1)[None], torch.tensor(gaze))[0]
    expected = [crop_opencv(image, gaze, 160, scale) for scale in range(4)]
    assert seen.shape == (4, 3, 160, 160)
    close(seen.permute(0, 2, 3, 1), np.stack(expected), 1e-4)


@pytest.mark.parametrize("far", [500.0, 1e9, 1e30])
def test_far_outside_the_picture_everything_is_black(far):
    image, gaze = torch.ones(1, 3, 60, 80, requires_grad=True), torch.tensor([far, -far], requires_grad=True)
    seen = MultiScaleFovea(16, 3)(image, gaze)
    seen.sum().backward()
    assert not seen.any()
    assert not image.grad.any()
    assert not gaze.grad.any()


def lamp(x1, y1, x2, y2, size=(96, 128)):
    """A black picture with one red box."""
    image = torch.zeros(1, 3, *size)
    image[:, 0, y1:y2, x1:x2] = 1
    return image


@pytest.mark.parametrize(
    ("box", "gaze"),
    [
        ((60, 40, 68, 48), (63.5, 43.5)),  # in the finest of four crops
        ((56, 40, 72, 48), (31.5, 47.5)),  # cut by the second widest, whole in the widest
        ((40, 32, 88, 64), (63.5, 47.5)),  # larger than the finest crop, which it fills
        ((56, 40, 76, 56), (63.5, 47.5)),  # cut by the finest crop, whole in the next
        ((0, 0, 16, 16), (7.5, 7.5)),  # at the border of the picture
        ((120, 88, 128, 96), (127.5, 95.5)),
    ],
)
def test_an_eye_finds_each_object_once_and_whole(box, gaze):
    """The picture is twice as large as the reference image of the eye, so crops cover twice as many of its pixels."""
    image = torch.nn.functional.interpolate(lamp(*box), scale_factor=2.0)
    eye = Eye(MultiScaleFovea(16, 4), Coloured(("red",)), reference=128)
    point = 2 * torch.tensor(gaze) + 0.5
    view = eye.open(image)
    seen = eye.look(view, point)
    assert eye.foveated(view, point).shape == (4, 3, 16, 16)
    assert view.canvas.shape == (1, 3, 96, 128)
    assert seen.boxes[0][seen.mask[0]].tolist() == [[2.0 * edge for edge in box]]
    together = eye.look(view, torch.stack([point, torch.tensor([-5000.0, 0.0]), point]))
    assert together.mask.sum(-1).tolist() == [1, 0, 1]
    close(together.boxes[2], seen.boxes[0])


def test_a_view_shows_each_place_by_its_finest_crop():
    slope = torch.arange(128.0).expand(1, 3, 96, 128) / 128
    image = slope.clone()
    image[..., 40:56, 56:72] = draw(3, 16, 16, dtype=torch.float32)
    eye = Eye(MultiScaleFovea(16, 3), Coloured(("red",)), reference=128)
    shown = eye.pictures(eye.open(image), [(63.5, 47.5), (-2000.0, 5.0)])
    assert shown.shape == (2, 3, 96, 128)
    close(shown[0, ..., 40:56, 56:72], image[0, ..., 40:56, 56:72], 1e-5)  # the finest crop is the picture itself
    close(shown[0, ..., 20:28, 36:92], slope[0, ..., 20:28, 36:92], 1e-5)  # blocks of a slope interpolate to the slope
    assert not shown[0, ..., :32].any()  # beyond the widest crop
    assert not shown[1].any()


def test_settings_of_numbers_without_a_fraction():
    sensor = MultiScaleFovea(32.0, 2.0)
    assert sensor.settings() == {"kind": "multi-scale", "side": 32, "scales": 2}
    assert repr(sensor) == "MultiScaleFovea(side=32, scales=2)"
    assert MultiScaleFovea.borders(sensor.settings()) == [16, 32]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"side": 0}, "side: expected a whole number from 1 to 4,096, got 0"),
        ({"side": 2.5}, "side: expected a whole number"),
        ({"scales": 17}, "scales: expected a whole number from 1 to 16, got 17"),
        ({"scales": math.nan}, "scales: expected a whole number"),
    ],
)
def test_bad_settings(settings, message):
    refused(message, MultiScaleFovea, **settings)


def test_a_network_with_a_fixed_input_takes_no_other_crops(tmp_path):
    detector = load_detector(write_network(tmp_path / "colours.onnx"))
    image = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    assert len(Eye(MultiScaleFovea(64, 2), detector)(image, (20.0, 20.0)).boxes) == 1
    with pytest.raises(InputError, match="expected 64 × 64 px, the fixed input of colours, got 32 × 32 px; a sensor"):
        Eye(MultiScaleFovea(32, 2), detector)(image, (20.0, 20.0))

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Eye, InputError, load_detector
from semfov.sensor import MultiScaleFovea
from tests.colours import write_network
from tests.small import Coloured, close, draw


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
    with pytest.raises(InputError, match=message):
        MultiScaleFovea(**settings)


def test_a_network_with_a_fixed_input_takes_no_other_crops(tmp_path):
    detector = load_detector(write_network(tmp_path / "colours.onnx"))
    image = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    assert len(Eye(MultiScaleFovea(64, 2), detector)(image, (20.0, 20.0)).boxes) == 1
    with pytest.raises(InputError, match="expected 64 × 64 px, the fixed input of colours, got 32 × 32 px; a sensor"):
        Eye(MultiScaleFovea(32, 2), detector)(image, (20.0, 20.0))

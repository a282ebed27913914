"""Glimpses of a picture, and glimpses and views in vmap, in exported graphs and on the device meta."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from torch.nn import functional as F

from semfov.errors import InputError
from semfov.sensor import perspective
from semfov.sensor.glimpse import glimpse, window_around, windows_at
from semfov.zoom.lattice import Lattice
from tests.refusals import refused
from tests.small import rand


def picture(height=47, width=61, channels=3, dtype=torch.float64, seed=0):
    return torch.rand(1, channels, height, width, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("size", [(61, 47), (30, 23), (17, 9), (90, 80), (1, 1)])
def test_the_whole_image_equals_antialiased_resizing_by_torch_inside_the_border(device, size):
    image = picture().to(device)
    boxes = torch.tensor([[0.0, 0.0, 61.0, 47.0]], dtype=image.dtype, device=device)
    # On a GPU the peer refuses to shrink a picture to one pixel.
    expected = F.interpolate(image.cpu(), size[::-1], mode="bilinear", antialias=True).to(device)
    got = glimpse(image, boxes, size, padding_mode="border")
    inner = [slice(n // 2, n // 2 + 1) if n < 3 else slice(1, n - 1) for n in size[::-1]]
    if min(size) >= 3:
        torch.testing.assert_close(got[..., inner[0], inner[1]], expected[..., inner[0], inner[1]])
    assert got.shape == expected.shape


@pytest.mark.parametrize("box", [(10.0, 8.0, 40.0, 32.0), (10.25, 8.5, 43.75, 29.125), (20.5, 20.5, 30.0, 26.0)])
@pytest.mark.parametrize("size", [(12, 9), (40, 33)])
def test_windows_equal_those_of_pillow(box, size):
    grey = np.random.default_rng(0).random((47, 61), dtype=np.float32)
    expected = np.asarray(Image.fromarray(grey).resize(size, Image.Resampling.BILINEAR, box=box))
    got = glimpse(torch.from_numpy(grey)[None, None], torch.tensor([box]), size)[0, 0]
    torch.testing.assert_close(got, torch.from_numpy(expected.copy()), rtol=1e-5, atol=1e-5)


def test_enlarged_windows_equal_those_of_kornia():
    from kornia.geometry.transform import crop_and_resize

    image = picture()
    # In Kornia, corners are the centres of the first and last pixel of the canvas.
    corners = torch.tensor([[[12.0, 10.0], [24.0, 10.0], [24.0, 19.0], [12.0, 19.0]]], dtype=image.dtype)
    expected = crop_and_resize(image, corners, (19, 25))
    step = 0.5
    edges = torch.tensor([[12 + 0.5 - step / 2, 10 + 0.5 - step / 2, 24.5 + step / 2, 19.5 + step / 2]]).double()
    torch.testing.assert_close(glimpse(image, edges, (25, 19)), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("padding", ["zeros", "border"])
def test_padding_beyond_the_border_equals_that_of_kornia(padding):
    from kornia.geometry.transform import warp_affine

    image = picture()
    shift = torch.tensor([[[1.0, 0.0, 7.25], [0.0, 1.0, 5.5]]], dtype=image.dtype)
    expected = warp_affine(image, shift, (60, 70), padding_mode=padding, align_corners=True)
    box = torch.tensor([[-7.25, -5.5, 70 - 7.25, 60 - 5.5]], dtype=image.dtype)
    torch.testing.assert_close(glimpse(image, box, (70, 60), padding_mode=padding), expected, rtol=1e-9, atol=1e-9)


def test_the_fill_value_is_used_beyond_the_border():
    view = glimpse(picture(), torch.tensor([[-200.0, -200, -100, -100]]).double(), (8, 8), padding_mode="fill",
                   fill_value=0.4)  # fmt: skip
    torch.testing.assert_close(view, torch.full_like(view, 0.4))


def test_many_windows_equal_a_loop_over_windows():
    image = torch.cat([picture(seed=1), picture(seed=2)])
    boxes = torch.tensor([[[0.0, 0, 30, 20], [5, 5, 50, 40], [-9, 3, 12, 70]]] * 2).double()
    boxes[1] += 1.5
    together = glimpse(image, boxes, (16, 12))
    assert together.shape == (2, 3, 3, 12, 16)
    for b in range(2):
        for g in range(3):
            torch.testing.assert_close(together[b, g], glimpse(image[b : b + 1], boxes[b, g][None], (16, 12))[0])


def test_gradients_in_image_position_and_magnification():
    image = picture(12, 14, 1).requires_grad_()
    points = torch.tensor([[[5.13, 4.37], [8.71, 6.29]]], dtype=torch.float64, requires_grad=True)
    magnification = torch.tensor([[0.73, 1.61]], dtype=torch.float64, requires_grad=True)

    def look(image, points, magnification):
        return glimpse(image, windows_at(points, magnification, (6, 5)), (6, 5), fill_value=0.3)

    assert torch.autograd.gradcheck(look, (image, points, magnification))


def test_windows_and_ladder_of_magnifications():
    box = windows_at(torch.tensor([99.5, 49.5]), torch.tensor(0.5), (416, 208))
    assert box.tolist() == [100 - 416, 50 - 208, 100 + 416, 50 + 208]
    steps = Lattice.over((20000, 15000), (416, 416)).magnifications
    assert steps[0] == 416 / 20000
    assert all(finer == 2 * coarser for coarser, finer in pairwise(steps))
    assert steps[-1] <= 1 < 2 * steps[-1]
    assert Lattice.over((100, 80), (416, 416)).magnifications == (4.16,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"boxes": torch.tensor([[3.0, 3.0, 3.0, 9.0]])}, "boxes: expected windows with a positive width"),
        ({"boxes": torch.tensor([[3.0, 3.0, float("nan"), 9.0]])}, "boxes: expected finite"),
        ({"boxes": torch.zeros(2, 4)}, "boxes: expected shape"),
        ({"size": (0, 3)}, "size: expected"),
        ({"padding_mode": "mirror"}, "unknown padding mode"),
        ({"image": torch.zeros(1, 3, 4, 4, dtype=torch.uint8)}, "image: expected floating-point"),
    ],
)
def test_errors_name_the_argument(change, message):
    call = {"image": torch.rand(1, 3, 8, 8), "boxes": torch.tensor([[0.0, 0, 4, 4]]), "size": (4, 4)} | change
    refused(message, glimpse, **call)


@given(
    st.tuples(st.integers(20, 700), st.integers(20, 700)),
    st.tuples(*[st.floats(0, 1)] * 4),
    st.floats(1, 5),
    st.floats(0.05, 1),
)
def test_a_window_around_a_box_is_as_large_and_as_central_as_the_picture_allows(picture, box, context, least):
    (x1, x2), (y1, y2) = (sorted((box[n] * side, box[n + 2] * side)) for n, side in enumerate(picture))
    given_box = torch.tensor([x1, y1, x2, y2], dtype=torch.float64)
    window = window_around(given_box, picture, context=context, least=least).tolist()
    side = max(context * max(x2 - x1, y2 - y1), least * max(picture))
    for low, high, start, stop, length in zip((x1, y1), (x2, y2), window[:2], window[2:], picture, strict=True):
        assert -1e-9 <= start <= stop <= length + 1e-9
        assert stop - start == pytest.approx(min(side, length))
        # The window covers the box, and nothing moves its centre away from the box's but the borders.
        assert start <= low + 1e-6
        assert stop >= high - 1e-6
        if start > 1e-6 and stop < length - 1e-6:
            assert (start + stop) / 2 == pytest.approx((low + high) / 2)


def test_a_window_around_a_box_follows_the_box_with_a_gradient():
    box = torch.tensor([20.0, 30.0, 40.0, 44.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda each: window_around(each, (300, 200)), box)
    refused("box: expected a tensor of shape", window_around, torch.zeros(3), (300, 200))
    refused("picture: expected", window_around, torch.zeros(4), (0, 200))


# Inside, larger than the picture, partly outside, far outside, small and enlarged, and with edges between pixels.
WINDOWS = torch.tensor(
    [
        [3.0, 4.0, 23.0, 19.0], [-30.0, -20.0, 70.0, 55.0], [-7.3, 11.1, 12.9, 31.7], [90.0, 80.0, 120.0, 99.0],
        [5.25, 6.5, 7.75, 8.25], [30.0, 20.0, 41.5, 33.25], [-60.0, 3.0, -10.0, 20.0], [0.0, 0.0, 40.0, 30.0],
    ]
)  # fmt: skip


@pytest.mark.parametrize("padding", ["zeros", "border", "fill"])
def test_glimpses_do_not_depend_on_the_way_they_are_computed(padding):
    image = rand(1, 3, 30, 40)
    options = {"padding_mode": padding, "fill_value": 0.3}
    alone = glimpse(image, WINDOWS[None], (16, 12), **options)
    mapped = torch.func.vmap(lambda box: glimpse(image, box[None, None], (16, 12), **options)[0, 0])(WINDOWS)
    torch.testing.assert_close(mapped, alone[0], atol=2e-6, rtol=0)
    slopes = torch.func.vmap(torch.func.grad(lambda box: glimpse(image, box[None, None], (16, 12), **options).sum()))
    for box, slope in zip(WINDOWS, slopes(WINDOWS), strict=True):
        own = box.clone().requires_grad_()
        (expected,) = torch.autograd.grad(glimpse(image, own[None, None], (16, 12), **options).sum(), own)
        torch.testing.assert_close(slope, expected, atol=2e-3, rtol=1e-3)


class Glimpses(torch.nn.Module):
    def forward(self, image, points, magnification):
        return glimpse(image, windows_at(points, magnification, (16, 12)), (16, 12))


class Views(torch.nn.Module):
    def forward(self, panorama, pose):
        return perspective(panorama, pose, (12, 8), antialias=False)


def test_an_exported_sensor_takes_other_points():
    sensor = Glimpses()
    image, points, magnification = rand(1, 3, 30, 40), torch.tensor([[[20.0, 15.0]]]), torch.tensor([[0.5]])
    graph = torch.export.export(sensor, (image, points, magnification)).module()
    for at, by in ((points, magnification), (torch.tensor([[[3.0, 29.0]]]), torch.tensor([[1.7]]))):
        torch.testing.assert_close(graph(image, at, by), sensor(image, at, by), atol=2e-6, rtol=0)
    panorama, pose = rand(1, 3, 16, 32), torch.tensor([[[30.0, 10.0, 60.0]]])
    views = Views()
    graph = torch.export.export(views, (panorama, pose)).module()
    other = torch.tensor([[[-170.0, 40.0, 90.0]]])
    torch.testing.assert_close(graph(panorama, other), views(panorama, other))


def test_shapes_are_known_without_values():
    image, panorama = torch.empty(2, 3, 30, 40, device="meta"), torch.empty(2, 3, 16, 32, device="meta")
    points, by = torch.empty(2, 5, 2, device="meta"), torch.empty(2, 5, device="meta")
    assert Glimpses()(image, points, by).shape == (2, 5, 3, 12, 16)
    assert Views()(panorama, torch.empty(2, 3, device="meta")).shape == (2, 3, 8, 12)


def test_views_in_vmap():
    panorama, poses = rand(1, 3, 16, 32), torch.tensor([[0.0, 0.0, 60.0], [170.0, 60.0, 90.0], [-20.0, -80.0, 30.0]])
    alone = perspective(panorama, poses[None], (12, 8), antialias=False)[0]
    view = torch.func.vmap(lambda pose: perspective(panorama, pose[None], (12, 8), antialias=False)[0])
    torch.testing.assert_close(view(poses), alone)
    with pytest.raises(InputError, match="antialias: expected False where the pose is not known"):
        torch.func.vmap(lambda pose: perspective(panorama, pose[None], (12, 8))[0])(poses)

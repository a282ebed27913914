"""Glimpses of pictures, directions and views of panoramas, against OpenCV and SciPy, also in vmap and exported."""

import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck
from torch.nn import functional as F

from semfov.errors import InputError
from semfov.head.scenes import _angle_between
from semfov.sensor import perspective
from semfov.sensor.glimpse import glimpse, window_around, windows_at
from semfov.sensor.perspective import _even_rows
from semfov.sensor.sphere import Camera, Regions, panorama_directions, panorama_points
from semfov.zoom.lattice import Lattice
from tests.refusals import refused
from tests.small import rand

yaws = st.floats(-720, 720)
pitches = st.floats(-90, 90)
fields = st.floats(5, 150)


def camera(yaw, pitch, field, size=(41, 31), dtype=torch.float64):
    return Camera(torch.tensor([yaw, pitch, field], dtype=dtype), size)


@given(yaws, pitches)
def test_rotation_of_a_camera_equals_scipy(yaw, pitch):
    expected = Rotation.from_euler("YX", [yaw, pitch], degrees=True).as_matrix()
    np.testing.assert_allclose(camera(yaw, pitch, 60).rotation, expected, atol=1e-12)


@given(yaws, pitches, fields)
def test_pixels_of_a_camera_to_directions_and_back(yaw, pitch, field):
    points = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 30
    seen = camera(yaw, pitch, field)
    directions = seen.directions(points)
    torch.testing.assert_close(torch.linalg.vector_norm(directions, dim=-1), torch.ones(50, dtype=torch.float64))
    back, inside = seen.points(3 * directions)
    torch.testing.assert_close(back, points, atol=1e-6, rtol=0)
    assert inside.all()


def test_pixels_of_a_panorama_to_directions_and_back(device):
    size = 64, 32
    y, x = torch.meshgrid(torch.arange(32.0), torch.arange(64.0), indexing="ij")
    points = torch.stack([x, y], -1).double().to(device)
    torch.testing.assert_close(panorama_points(panorama_directions(points, size), size), points, atol=1e-9, rtol=0)


def test_directions_of_a_panorama_are_latitude_and_longitude(dtype):
    """+x is 90° to the right, -y is up, and the seam is behind the camera."""
    points = torch.tensor([[511.5, 255.5], [767.5, 255.5], [255.5, 255.5], [-0.5, 255.5], [100, -0.5]], dtype=dtype)
    expected = [[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 0, -1], [0, -1, 0]]
    directions = panorama_directions(points, (1024, 512))
    assert directions.dtype == dtype
    np.testing.assert_allclose(directions, expected, atol=1e-6)


def test_the_centre_of_a_view_has_the_direction_of_yaw_and_pitch():
    """The angle between the centre and the middle of an edge is half the field of view."""
    seen = camera(30, 20, 80, (101, 51))
    middle = seen.directions(torch.tensor([[50.0, 25.0]], dtype=torch.float64))[0]
    lat, lon = math.radians(20), math.radians(30)
    expected = [math.cos(lat) * math.sin(lon), -math.sin(lat), math.cos(lat) * math.cos(lon)]
    np.testing.assert_allclose(middle, expected, atol=1e-12)
    edge = seen.directions(torch.tensor([[-0.5, 25.0]], dtype=torch.float64))[0]
    np.testing.assert_allclose(_angle_between(middle, edge), 40, atol=1e-9)


@given(pitches, pitches)
def test_angles_between_directions_equal_scipy(one, other):
    a, b = (Rotation.from_euler("X", angle, degrees=True) for angle in (one, other))
    ahead = np.array([0.0, 0.0, 1.0])
    expected = math.degrees((a.inv() * b).magnitude())
    found = _angle_between(*(torch.from_numpy(turned.apply(ahead)) for turned in (a, b)))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_regions_contain_their_samples_and_no_points_outside():
    pose = torch.tensor([[179.0, 85.0, 60.0], [0.0, 0.0, 60.0]])
    boxes = torch.tensor([[10.0, 5, 30, 20], [0, 0, 41, 31]])
    regions = Regions(boxes, Camera(pose, (41, 31)))
    samples = regions.samples(5)
    for number in range(2):
        inner = samples[number].unflatten(0, (5, 5))[1:-1, 1:-1].flatten(0, 1)
        assert regions.contain(inner)[number].all()
    assert not regions.contain(-samples[0])[0].any()
    outside = Camera(pose[0], (41, 31)).directions(torch.tensor([[9.0, 10.0], [20.0, 21.0], [31.0, 10.0]]))
    assert not regions.contain(outside)[0].any()


@pytest.mark.slow
@given(yaws, st.floats(-89, 89))
def test_boxes_in_a_panorama_fit_the_region_tightly(yaw, pitch):
    """Checked with all panorama pixels in the region, without its outline (a corner can lie between pixels)."""
    size = 360, 180
    pose = torch.tensor([[yaw, pitch, 70.0]], dtype=torch.float64)
    regions = Regions(torch.tensor([[4.0, 3, 33, 27]], dtype=torch.float64), Camera(pose, (40, 30)))
    y, x = torch.meshgrid(torch.arange(180.0), torch.arange(360.0), indexing="ij")
    pixels = torch.stack([x, y], -1).flatten(0, 1).double()
    inside = regions.contain(panorama_directions(pixels, size))[0]
    x1, y1, x2, y2 = regions.panorama_boxes(size)[0].tolist()
    assert 0 <= x1 <= 360
    assert x2 - x1 <= 360
    held = pixels[inside] + 0.5
    along = (held[:, 0] - x1) % 360
    assert (along <= x2 - x1 + 0.02).all()
    assert ((held[:, 1] >= y1 - 0.02) & (held[:, 1] <= y2 + 0.02)).all()
    assert held[:, 1].min() <= y1 + 2.5
    assert held[:, 1].max() >= y2 - 2.5
    assert along.max() >= x2 - x1 - 4 or x2 - x1 == 360


def test_what_a_camera_does_not_see():
    points, inside = camera(0, 0, 60).points(torch.tensor([[0.0, 0, -1], [1, 0, 0]], dtype=torch.float64))
    assert not inside.any()
    assert points.isinf().all()
    refused("field: expected degrees between 0 and 180", camera, 0, 0, 180)


def remapped(panorama, yaw, pitch, field, size):
    """A view of a panorama `(H, W, 3)`, computed by OpenCV and SciPy only."""
    high, wide = panorama.shape[:2]
    focal = size[0] / 2 / math.tan(math.radians(field / 2))
    u, v = np.meshgrid(np.arange(size[0]) + 0.5 - size[0] / 2, np.arange(size[1]) + 0.5 - size[1] / 2)
    rays = np.stack([u / focal, v / focal, np.ones_like(u)], -1).reshape(-1, 3)
    x, y, z = Rotation.from_euler("YX", [yaw, pitch], degrees=True).apply(rays).T
    longitude, latitude = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    column = (longitude / (2 * np.pi) + 0.5) * wide - 0.5
    row = (0.5 - latitude / np.pi) * high - 0.5
    # Add a row beyond each pole, and wrap the border along x.
    turned = np.roll(panorama, wide // 2, 1)
    whole = np.concatenate([turned[:1], panorama, turned[-1:]])
    whole = np.concatenate([whole[:, -1:], whole, whole[:, :1]], 1)
    at = (n.reshape(size[1], size[0]).astype(np.float32) for n in (column + 1, row + 1))
    return cv2.remap(whole, *at, cv2.INTER_LINEAR)


@pytest.mark.parametrize("pose", [(0, 0, 60), (179, 10, 90), (-77, 88, 50), (400, -90, 100), (12.3, 45.6, 20)])
def test_bilinear_views_equal_those_of_opencv(pose):
    # The image is smooth, because OpenCV rounds coordinates to 1/32 of a pixel.
    directions = panorama_directions(
        torch.stack(torch.meshgrid(torch.arange(128.0), torch.arange(64.0), indexing="xy"), -1), (128, 64)
    )
    image = (0.5 + 0.4 * torch.sin(3 * directions + directions.roll(1, -1))).numpy()
    expected = remapped(image, *pose, (50, 40))
    view = perspective(
        torch.from_numpy(image).permute(2, 0, 1)[None], torch.tensor([[*map(float, pose)]]), (50, 40), antialias=False
    )
    np.testing.assert_allclose(view[0].permute(1, 2, 0), expected, atol=2e-3)


@pytest.mark.parametrize("pose", [(180.0, 0.0, 60.0), (33.0, 90.0, 80.0), (-10.0, -90.0, 80.0), (170.0, 70.0, 100.0)])
def test_views_are_accurate_at_the_poles_and_across_the_seam(pose, device):
    """The panorama is a smooth function of direction; views show that function in every direction."""
    wide, high = 720, 360
    grid = torch.stack(torch.meshgrid(torch.arange(wide), torch.arange(high), indexing="xy"), -1).double()

    def colour(directions):
        return 0.5 + 0.25 * torch.sin(directions @ torch.tensor([[2.0, 1, 0], [0, 2, 1], [1, 0, 2]]).double())

    panorama = colour(panorama_directions(grid, (wide, high))).permute(2, 0, 1)[None].to(device)
    place = torch.tensor(pose, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(torch.arange(60), torch.arange(45), indexing="xy"), -1).double()
    expected = colour(Camera(place, (60, 45)).directions(pixels.flatten(0, 1))).view(45, 60, 3).permute(2, 0, 1)
    for antialias in (False, True):
        view = perspective(panorama, place[None].to(device), (60, 45), antialias=antialias)[0].cpu()
        torch.testing.assert_close(view, expected, atol=4e-4 if antialias else 1e-4, rtol=0)


@pytest.mark.parametrize("pose", [(10.0, 20.0, 60.0), (180.0, 5.0, 70.0), (40.0, 80.0, 60.0)])
@pytest.mark.parametrize("antialias", [False, True])
def test_gradients_in_yaw_pitch_and_field(pose, antialias):
    torch.manual_seed(0)
    panorama = torch.rand(1, 2, 16, 32, dtype=torch.float64)
    place = torch.tensor([pose], dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda p: perspective(panorama, p, (5, 4), antialias=antialias), (place,), eps=1e-7, atol=1e-5)


def test_gradients_in_the_panorama_and_at_a_pole():
    panorama = torch.rand(1, 1, 6, 12, dtype=torch.float64, requires_grad=True)
    pose = torch.tensor([[175.0, 60.0, 80.0]], dtype=torch.float64)
    assert gradcheck(lambda p: perspective(p, pose, (4, 3)), (panorama,))
    panorama = torch.rand(1, 3, 32, 64)
    pose = torch.tensor([[30.0, 90.0, 60.0]], requires_grad=True)
    perspective(panorama, pose, (9, 9)).square().sum().backward()
    assert pose.grad.isfinite().all()
    assert pose.grad.abs().sum() > 0


def test_shrinking_does_not_alias():
    """Stripes finer than the pixels of the view look grey with antialiasing, and not without it."""
    panorama = (torch.arange(2048) % 2).float().expand(1, 1, 1024, 2048)
    pose = torch.tensor([[0.0, 0.0, 90.0]])
    smooth = perspective(panorama, pose, (64, 48))
    assert (smooth - 0.5).abs().max() < 0.06
    assert (perspective(panorama, pose, (64, 48), antialias=False) - 0.5).abs().max() > 0.4


def test_rows_are_averaged_as_by_a_brute_force():
    torch.manual_seed(1)
    panorama = torch.rand(2, 8, 16, dtype=torch.float64)
    found = _even_rows(panorama)
    fine = 4000
    for row in range(8):
        width = min(1 / math.cos((row + 0.5 - 4) / 8 * math.pi), 16)
        for column in range(16):
            at = column + 0.5 + (np.arange(fine) + 0.5 - fine / 2) / fine * width
            mean = panorama[:, row][:, np.floor(at).astype(int) % 16].mean(-1)
            torch.testing.assert_close(found[:, row, column], mean, atol=1e-3, rtol=0)


def test_several_views_of_panoramas_of_even_width():
    panorama = torch.rand(2, 3, 16, 32)
    poses = torch.tensor([[0.0, 0, 60], [90, 30, 40]]).expand(2, 2, 3)
    views = perspective(panorama, poses, (8, 6))
    assert views.shape == (2, 2, 3, 6, 8)
    torch.testing.assert_close(views[1, 1], perspective(panorama[1:], poses[1:, 1], (8, 6))[0])
    with pytest.raises(InputError, match="panorama: expected an even number of columns"):
        perspective(torch.rand(1, 3, 8, 15), torch.zeros(1, 3) + 60, (4, 4))


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


def test_many_windows_equal_a_loop_and_the_fill_value_is_used_beyond_the_border():
    image = torch.cat([picture(seed=1), picture(seed=2)])
    boxes = torch.tensor([[[0.0, 0, 30, 20], [5, 5, 50, 40], [-9, 3, 12, 70]]] * 2).double()
    boxes[1] += 1.5
    together = glimpse(image, boxes, (16, 12))
    assert together.shape == (2, 3, 3, 12, 16)
    for b in range(2):
        for g in range(3):
            torch.testing.assert_close(together[b, g], glimpse(image[b : b + 1], boxes[b, g][None], (16, 12))[0])
    view = glimpse(picture(), torch.tensor([[-200.0, -200, -100, -100]]).double(), (8, 8), padding_mode="fill",
                   fill_value=0.4)  # fmt: skip
    torch.testing.assert_close(view, torch.full_like(view, 0.4))


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

"""Directions, boxes on the sphere, and views of panoramas, against OpenCV and SciPy."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from semfov.errors import InputError
from semfov.head.scenes import _angle_between
from semfov.sensor.perspective import _even_rows, perspective
from semfov.sensor.sphere import Camera, Regions, panorama_directions, panorama_points
from tests.refusals import refused

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

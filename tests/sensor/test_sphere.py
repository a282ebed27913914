"""Directions, pixels of cameras and of panoramas: against SciPy's rotations and closed forms, and round trips."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semfov.head.scenes import _angle_between
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

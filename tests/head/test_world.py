"""Scenes seen through a window: conversion of points, poses that cover the scene, boxes as regions."""

import pytest
import torch

from semfov.head import Flat, Panorama
from semfov.head.views import Views
from semfov.sensor import glimpse, perspective
from tests.refusals import refused


@pytest.fixture(params=["panorama", "flat"])
def world(request):
    torch.manual_seed(0)
    if request.param == "panorama":
        return Panorama(torch.rand(3, 180, 360), (64, 48))
    return Flat(torch.rand(3, 480, 640), (64, 48), degree=4)


def test_points_are_converted_to_the_scene_and_back(world):
    points = torch.rand(40, 2) * 40
    for row in world.poses(60.0):
        there = world.to_scene(points, row[0])
        back, inside = world.to_view(there, row[0])
        torch.testing.assert_close(back, points, atol=2e-3, rtol=0)
        assert inside.all()


def test_every_second_pose_of_every_second_row_tiles_the_scene(world):
    """All of a flat scene, and of a panorama the part that the head can reach."""
    rows = world.poses(60.0)
    tiling = [pose for row in rows[::2] for pose in row[::2]]
    seen = torch.stack([world.to_view(world.centres, pose)[1] for pose in tiling]).any(0)
    if isinstance(world, Flat):
        assert seen.all()
    else:
        latitude = torch.rad2deg(torch.asin(-world.centres[:, 1]))
        assert seen[latitude.abs() < 60].all()


def test_boxes_are_converted_to_places_and_back(world):
    boxes = torch.tensor([[10.0, 5, 30, 25], [40, 20, 64, 48]])
    pose = world.poses(60.0)[1][1]
    places = world.places(boxes, pose)
    for number, (x1, y1, x2, y2) in enumerate(boxes.tolist()):
        inside = torch.tensor([[x1 + 0.5, y1 + 0.5], [x2 - 1.5, y2 - 1.5], [(x1 + x2) / 2, (y1 + y2) / 2]])
        outside = torch.tensor([[x1 - 2, y1], [x1, y1 - 2]])
        assert places.contain(world.to_scene(inside, pose))[number].all()
        assert not places.contain(world.to_scene(outside, pose))[number].any()
    back, _ = world.to_view(places.samples(2).flatten(0, 1), pose)
    corners = back.view(2, 4, 2)[:, [0, 3]].flatten(1) + 0.5
    torch.testing.assert_close(corners, boxes, atol=5e-2, rtol=0)


def test_cells_contain_their_centres_and_panoramas_are_twice_as_wide_as_high(world):
    assert torch.equal(world.scene.cell_of(world.pixels_of(world.centres)), torch.arange(len(world.scene)))
    torch.testing.assert_close(world.pixels_of(world.centres), world.scene.centres, atol=1e-3, rtol=0)
    assert float(world.area.mean()) == pytest.approx(1)
    with pytest.warns(UserWarning, match="twice as wide as high, got 64 × 48 px"):
        Panorama(torch.rand(3, 48, 64), (32, 24))
    Panorama(torch.rand(3, 48, 98), (32, 24))


def test_views_are_perspectives_of_panoramas_and_glimpses_of_flat_scenes():
    torch.manual_seed(0)
    image = torch.rand(3, 90, 180)
    pose = torch.tensor([33.0, 20.0, 60.0])
    expected = perspective(image[None], pose[None], (32, 24))[0]
    world = Panorama(image, (32, 24))
    torch.testing.assert_close(world.view(pose)[0], expected.clamp(0, 1))
    torch.testing.assert_close(world.look_at((33.0, 20.0), 60.0), expected.clamp(0, 1))
    # Without the border pixels, where a glimpse also uses pixels from outside the window.
    torch.manual_seed(0)
    image = torch.rand(3, 120, 160).mul(255).round() / 255
    view = Flat(image, (32, 24), degree=5).look_at((-4.0, 2.0), 16.0)  # 20 px to the left, 10 px up
    expected = glimpse(image[None], torch.tensor([[20.0, 20, 100, 80]]), (32, 24))[0]
    torch.testing.assert_close(view[:, 1:-1, 1:-1], expected[:, 1:-1, 1:-1], atol=1e-5, rtol=0)


def test_angles_of_eye_and_head():
    """Closed forms: poses of a ring differ by equal steps, and the angle from side to side is the field of view."""
    panorama = Panorama(torch.rand(3, 90, 180), (64, 48))
    ring = torch.stack(panorama.poses(60.0)[2])
    assert float(ring[0, 1]) == 0
    torch.testing.assert_close(panorama.turn(ring[0].expand_as(ring), ring)[:4], torch.tensor([0.0, 30, 60, 90]))
    sides = torch.tensor([[-0.5, 23.5], [63.5, 23.5]])
    assert float(panorama.shift(sides[0], sides[1], 60.0)) == pytest.approx(60, abs=1e-3)
    flat = Flat(torch.rand(3, 480, 640), (64, 48), degree=4)
    assert float(flat.shift(sides[0], sides[1], 60.0)) == pytest.approx(60, abs=1e-3)
    assert float(flat.turn(torch.tensor([0.0, 0, 60]), torch.tensor([7.5, 10, 60]))) == pytest.approx(12.5)


def test_a_head_that_turns_to_the_angles_of_a_point_has_it_in_the_middle_of_its_view(world):
    points = world.centres[torch.randint(len(world.centres), (30,), generator=torch.Generator().manual_seed(1))]
    middle = torch.tensor(world.size) / 2 - 0.5
    for point, (pan, tilt) in zip(points, world.angles_of(points).tolist(), strict=True):
        pose = torch.tensor([pan, tilt, 20.0])
        if isinstance(world, Flat) and not (abs(pan) < 70 and abs(tilt) < 52):
            continue  # the window would not fit
        seen, inside = world.to_view(point[None], pose)
        assert inside.all()
        torch.testing.assert_close(seen[0], middle, atol=0.6 if isinstance(world, Flat) else 1e-2, rtol=0)


def test_actions_are_cells_of_a_strip(world):
    views = Views(world)
    assert len(views.grid) == len(views.poses) * 100
    centres = views.grid.centres
    for action in (0, 137, 555, len(views.grid) - 1):
        pose = action // 100
        point = centres[action] - torch.tensor([0, pose * world.size[1]])
        torch.testing.assert_close(point, views.view_grid.centres[action % 100], atol=1e-3, rtol=0)
        expected = world.to_scene(point[None], views.poses[pose])[0]
        torch.testing.assert_close(views.gaze[action], expected, atol=1e-3, rtol=1e-4)


def test_durations_equal_brute_force(world):
    from semfov.head import Speeds

    views, speeds = Views(world, (40.0, 80.0) if isinstance(world, Panorama) else (60.0,)), Speeds()
    here = 7 * 100 + 33
    durations = views.durations(here, speeds)
    generator = torch.Generator().manual_seed(0)
    for action in torch.randint(len(views.grid), (20,), generator=generator).tolist():
        one, other = views.poses[7], views.poses[action // 100]
        points = views.view_grid.centres[[33, action % 100]]
        eye = world.shift(points[0], points[1], float(other[2]))
        expected = speeds.duration(eye, world.turn(one, other), (other[2] / one[2]).log2())
        assert float(durations[action]) == pytest.approx(float(expected), abs=1e-4)
    assert float(durations[here]) == pytest.approx(speeds.look)


def test_windows_beyond_a_picture_are_refused():
    flat = Flat(torch.rand(3, 48, 64), (32, 24), degree=2)
    refused("pose: expected a window inside 64 × 48 pixels", flat.look_at, (-16.0, 0.0), 20.0)
    refused("field: expected a window inside the picture", flat.poses, 60.0)
    refused("fields: expected", Views, flat, (30.0, 20.0))

"""Panoramas made of photographs: what a camera sees of them, and where their objects are."""

import pytest
import torch
from torch.nn import functional as F

from semfov import EmbeddedScenes, InputError
from semfov.head import Panoramas
from semfov.sensor.perspective import perspective

CLASSES = ("person", "cat", "cup")


@pytest.fixture(scope="module")
def scenes():
    return EmbeddedScenes(CLASSES, count=5)


@pytest.mark.slow
def test_a_camera_that_looks_at_a_photograph_sees_it_undistorted(scenes):
    panoramas = Panoramas(scenes, width=1024, count=1)
    panorama = panoramas[0].image[None]
    for patch in panoramas.patches(0):
        seen = perspective(panorama, torch.tensor([patch.pose]), (160, 120))[0]
        photograph = F.interpolate(scenes[patch.scene].image[None], (120, 160), mode="bilinear", antialias=True)[0]
        inner = slice(3, -3)
        apart = (seen - photograph)[:, inner, inner].abs()
        assert apart.mean() < 0.02
        # Another photograph differs much more.
        other = scenes[(patch.scene + 1) % 5].image[None]
        other = F.interpolate(other, (120, 160), mode="bilinear", antialias=True)[0]
        assert (seen - other)[:, inner, inner].abs().mean() > 3 * apart.mean()


def test_regions_match_the_boxes_of_the_photographs(scenes):
    """A camera that looks at a patch sees each object where the photograph has it."""
    panoramas = Panoramas(scenes, width=512, count=2, seed=4)
    regions, labels = panoramas.regions(1), panoramas.annotation(1).labels
    start = 0
    from semfov.sensor.sphere import Camera

    for patch in panoramas.patches(1):
        annotation = scenes.annotation(patch.scene)
        own = regions[torch.arange(start, start + len(annotation.boxes))]
        assert torch.equal(labels[start : start + len(own)], annotation.labels)
        start += len(own)
        corners = own.samples(2)
        camera = Camera(torch.tensor(patch.pose), (640, 480))
        points, _ = camera.points(corners.flatten(0, 1))
        seen = points.view(-1, 4, 2) + 0.5
        scale = torch.tensor([640 / annotation.size[0], 480 / annotation.size[1]]).repeat(2)
        expected = annotation.boxes * scale
        torch.testing.assert_close(torch.cat([seen[:, 0], seen[:, 3]], -1), expected, atol=1e-2, rtol=0)
    assert start == len(regions)


def test_a_seed_repeats_a_panorama_and_uses_each_photograph_once(scenes):
    one, same, other = (Panoramas(scenes, rings=((0.0, 5),), width=256, count=3, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one[2].image, same[2].image)
    assert one.fingerprint == same.fingerprint != other.fingerprint
    assert one.digest(2) == same.digest(2) != one.digest(1)
    assert one.patches(0) != other.patches(0)
    assert sorted(patch.scene for patch in one.patches(0)) == [0, 1, 2, 3, 4]


def test_no_two_photographs_overlap(scenes):
    from semfov.sensor.sphere import Camera, Regions

    patches = Panoramas(scenes, width=256, count=1).patches(0)
    slots = Regions(torch.tensor([p.box for p in patches]), Camera(torch.tensor([p.pose for p in patches]), (640, 480)))
    held = slots.contain(slots.samples(21).flatten(0, 1)).view(len(patches), len(patches), -1)
    for number in range(len(patches)):
        others = torch.cat([held[number, :number], held[number, number + 1 :]])
        assert not others.any()


def test_boxes_of_the_annotation_lie_in_the_panorama(scenes):
    panoramas = Panoramas(scenes, width=1024, count=1)
    annotation = panoramas.annotation(0)
    assert annotation.size == (1024, 512)
    assert (annotation.boxes[:, 2:] > annotation.boxes[:, :2]).all()
    assert (annotation.boxes[:, 0] >= 0).all()
    assert (annotation.boxes[:, 0] <= 1024).all()
    assert panoramas.targets(0) == sorted(set(annotation.labels.tolist()))


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"width": 101}, "width"), ({"slot": 180.0}, "slot"), ({"rings": ((95.0, 1),)}, "rings"), ({"count": 0}, "count")],
)
def test_invalid_settings_are_refused(scenes, settings, message):
    with pytest.raises(InputError, match=message):
        Panoramas(scenes, **settings)

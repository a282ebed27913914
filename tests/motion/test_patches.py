"""Patches of frames that move on their own: each is followed to within a pixel, or left out."""

import cv2
import numpy as np
import pytest

from semfov.motion.frames import reduced_grey
from semfov.motion.patches import PatchFlow
from tests.motion.test_camera import scene

WIDE, HIGH = 30, 50
GROUND_SHIFT = np.array([5, -3])
PLACES = np.array([[80, 60], [240, 60], [400, 60], [80, 220], [240, 220], [400, 220]])
SIZE = np.array([WIDE, HIGH])
BOXES = np.concatenate([PLACES, PLACES + SIZE], -1).astype(np.float64)
CENTRES = (BOXES[:, :2] + BOXES[:, 2:]) / 2
SHIFTS = np.array([[9, 2], [-7, 5], [0, 0], [3, -9], [-4, -4], [6, 6]])  # beside the ground


def frames(shifts, seed=0, patches=None):
    """Two frames of a ground that moves, with a patch at each place that moves beside it."""
    ground = cv2.cvtColor(scene(seed, side=700), cv2.COLOR_RGB2GRAY)
    patches = [textured(seed + 1 + number) for number in range(len(PLACES))] if patches is None else patches
    pair = []
    for moved in (0, 1):
        x, y = 100 - moved * GROUND_SHIFT
        frame = ground[y : y + 360, x : x + 520].copy()
        for patch, place in zip(patches, PLACES + moved * (GROUND_SHIFT + shifts), strict=True):
            paste(frame, patch, *place)
        pair.append(frame)
    return pair


def textured(seed):
    noise = np.random.default_rng(seed).integers(0, 256, (HIGH, WIDE)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def paste(frame, patch, x, y):
    high, wide = patch.shape
    frame[y : y + high, x : x + wide] = patch


def followed(pair, boxes=BOXES, expected=CENTRES + GROUND_SHIFT):
    flow = PatchFlow()
    for frame in pair:
        flow.step(frame)
    return flow.follow(boxes, expected)


@pytest.mark.parametrize("seed", range(3))
def test_each_patch_is_followed_to_within_a_pixel(seed):
    found = followed(frames(SHIFTS, seed))
    assert found.are_followed.all()
    assert np.abs(found.places - (CENTRES + GROUND_SHIFT + SHIFTS)).max() < 1


def test_places_are_those_of_the_frame_where_a_reduced_copy_is_followed():
    """Frames larger than 960 px are reduced."""
    pair = [cv2.resize(frame, (1560, 1080), interpolation=cv2.INTER_LINEAR) for frame in frames(SHIFTS)]
    found = followed(pair, 3 * BOXES, 3 * (CENTRES + GROUND_SHIFT))
    errors = np.abs(found.places - 3 * (CENTRES + GROUND_SHIFT + SHIFTS)).max(-1)
    assert found.are_followed.sum() >= len(PLACES) - 1
    assert errors[found.are_followed].max() < 2


def test_frames_in_colour_are_followed_as_grey_ones():
    pair = frames(SHIFTS)
    grey = followed(pair)
    coloured = followed([cv2.cvtColor(frame, cv2.COLOR_GRAY2RGB) for frame in pair])
    np.testing.assert_allclose(coloured.places, grey.places, atol=0.01)


def test_a_frame_takes_no_time_where_nothing_is_followed(monkeypatch):
    """Neither its copy nor that of the next frame is made, until a box is followed into it."""
    reduced = []
    monkeypatch.setattr(
        "semfov.motion.patches.reduced_grey", lambda *parts: reduced.append(len(parts)) or reduced_grey(*parts)
    )
    flow = PatchFlow()
    for number, frame in enumerate([*frames(SHIFTS), frames(SHIFTS)[0]]):
        flow.step(frame)
        flow.follow(BOXES if number == 2 else BOXES[:0], CENTRES if number == 2 else CENTRES[:0])
        assert len(reduced) == (2 if number == 2 else 0)


def test_a_patch_that_stays_has_not_changed():
    stays = followed(frames(np.zeros_like(SHIFTS)))
    assert stays.changes.max() < 0.1
    hidden = followed(frames(SHIFTS, patches=[np.full((HIGH, WIDE), 120, np.uint8)] * len(PLACES)))
    assert np.isinf(hidden.changes).all()


def test_any_number_of_patches_is_followed():
    pair = frames(SHIFTS)
    one = followed(pair)
    many = followed(pair, np.tile(BOXES, (200, 1)), np.tile(CENTRES + GROUND_SHIFT, (200, 1)))
    assert many.are_followed.all()
    np.testing.assert_allclose(many.places, np.tile(one.places, (200, 1)), atol=0.1)


def test_a_patch_without_texture_is_left_out():
    found = followed(frames(SHIFTS, patches=[np.full((HIGH, WIDE), 120, np.uint8)] * len(PLACES)))
    assert not found.are_followed.any()
    np.testing.assert_array_equal(found.places, CENTRES + GROUND_SHIFT)  # as expected


def test_a_patch_that_is_hidden_in_the_next_frame_is_left_out():
    before, present = frames(SHIFTS)
    for place in PLACES + GROUND_SHIFT + SHIFTS:
        paste(present, textured(99), *place)
    assert not followed([before, present]).are_followed.any()


def test_what_a_border_cuts_is_left_out():
    boxes = BOXES - (PLACES[0, 0] + 3, 0, PLACES[0, 0] + 3, 0)  # the first column reaches over the left border
    found = followed(frames(SHIFTS), boxes, CENTRES + GROUND_SHIFT)
    assert not found.are_followed[[0, 3]].any()


def test_nothing_is_followed_before_two_frames_of_one_size():
    flow = PatchFlow()
    before, present = frames(SHIFTS)
    assert not flow.follow(BOXES, CENTRES).are_followed.any()
    flow.step(before)
    assert not flow.follow(BOXES, CENTRES).are_followed.any()
    flow.step(present[:-2])
    assert not flow.follow(BOXES, CENTRES).are_followed.any()

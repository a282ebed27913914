"""Searches in streams whose scene is lost for some frames, as in the dark, and found again or given up."""

import cv2
import numpy as np
import pytest

from semfov import WindowEye, ZoomAgent
from semfov.settings import StreamSettings
from tests.motion.test_camera import scene
from tests.zoom.test_closer import Sized, evidence

DARK = np.zeros((768, 1024, 3), np.uint8)
PLACE = 600, 400  # the low corner of a red square of 64 px on the ground


@pytest.fixture
def live():
    return ZoomAgent(WindowEye(Sized()), evidence()).stream(1, (), StreamSettings(rate=0.25))


@pytest.fixture(scope="module")
def ground():
    """A ground on which a red square lies."""
    picture = scene(2) // 2 + 40
    x, y = PLACE
    cv2.rectangle(picture, (x, y), (x + 63, y + 63), (255, 0, 0), -1)
    return picture


def search(live, ground, speed):
    """Search until a closer look has found the square; returns the left edge of the next frame."""
    left = 60
    for _ in range(6):
        moment = live.step(part(ground, left))
        left += speed
    assert moment.decision.outcome == "found"
    return left


def part(picture, left):
    return picture[100:868, left : left + 1024].copy()


@pytest.mark.parametrize(("frames", "speed"), [(1, 0), (4, 7)])
def test_a_find_counts_again_when_its_scene_comes_back(live, ground, frames, speed):
    """The square is found in the first frame after the dark, where it is now, without another closer look."""
    left = search(live, ground, speed)
    before = live.moment()
    for _ in range(frames):
        moment = live.step(DARK)
        assert moment.decision.outcome != "found"
        assert moment.closer == ()
    for number in range(3):
        moment = live.step(part(ground, left + speed * number))
        assert not moment.lost
        assert moment.decision.outcome == "found"
        x, y = PLACE[0] - left - speed * number, PLACE[1] - 100
        x1, y1, x2, y2 = moment.decision.box.tolist()
        assert x < (x1 + x2) / 2 < x + 64
        assert y < (y1 + y2) / 2 < y + 64
        assert [look.place for look in moment.closer] == [look.place for look in before.closer]
        assert moment.examined is None


def test_a_scene_that_was_given_up_does_not_come_back_with_another(live, ground):
    """After a cut the camera stands before another scene for longer than it waits, and then the light goes off once."""
    search(live, ground, 0)
    cut = live.moment().looks[-1].seconds
    other = part(scene(9) // 2 + 40, 0)
    is_lost = [live.step(other).lost for _ in range(14)]
    assert is_lost == sorted(is_lost, reverse=True)
    assert sum(is_lost) == 11  # the twelfth frame is the last that is compared with the old scene
    live.step(DARK)
    moment = live.step(other)
    assert not moment.lost  # the other scene is found again
    assert moment.decision.outcome != "found"
    assert moment.closer == ()
    assert len(moment.looks) > 2
    assert min(look.seconds for look in moment.looks) > cut

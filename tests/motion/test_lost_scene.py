"""What is known of a scene that the camera lost."""

from semfov.motion import CameraStep, LostScene, Motion

RIGHT = Motion.similarity(shift=(10, 0))
UP = Motion.similarity(shift=(0, -5))


def moved(places, motion):
    """Move points."""
    x, y = motion.matrix[:2, 2]
    return [(first + x, second + y) for first, second in places]


def test_things_are_carried_along_and_none_is_kept():
    lost = LostScene()
    assert lost.follow([(1, 2)], CameraStep(RIGHT), moved) == [(11, 2)]
    assert lost.things is None


def test_what_is_found_again_is_before_what_came_since():
    lost = LostScene()
    assert lost.follow([(1, 2)], CameraStep(None, waits=True), moved) == []
    assert lost.follow([(7, 7)], CameraStep(RIGHT, waits=True), moved) == [(17, 7)]
    assert lost.follow([(17, 7)], CameraStep(UP, recovered=RIGHT), moved) == [(11, 2), (17, 2)]
    assert lost.things is None


def test_the_first_of_two_lost_scenes_is_found_again_though_nothing_was_known_of_it():
    lost = LostScene()
    lost.follow([], CameraStep(None, waits=True), moved)
    assert lost.follow([(7, 7)], CameraStep(None, waits=True), moved) == []
    assert lost.follow([], CameraStep(None, recovered=RIGHT), moved) == []


def test_what_was_given_up_does_not_come_back():
    lost = LostScene()
    lost.follow([(1, 2)], CameraStep(None, waits=True), moved)
    assert lost.follow([(7, 7)], CameraStep(Motion.still(), gives_up=True), moved) == [(7, 7)]
    assert lost.follow([(7, 7)], CameraStep(None, waits=True), moved) == []
    assert lost.follow([], CameraStep(None, recovered=RIGHT), moved) == [(17, 7)]

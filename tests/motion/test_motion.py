"""Motions between frames: a group of projective maps, whose scale is that of small distances."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import InputError
from semfov.motion import KnownPoses, Motion

numbers = st.floats(-200, 200)


def projective(shift, turn, scale, tilt):
    matrix = Motion.similarity(shift=shift, turn=turn, scale=scale).matrix
    return Motion(matrix + np.array([[0, 0, 0], [0, 0, 0], [tilt, -tilt, 0]]))


pairs = st.tuples(numbers, numbers)
motions = st.builds(projective, pairs, st.floats(-180, 180), st.floats(0.2, 5), st.floats(-1e-4, 1e-4))
points = st.lists(pairs, min_size=1, max_size=5).map(lambda places: torch.tensor(places, dtype=torch.float64))


@given(motions, points)
def test_points_are_mapped_as_by_opencv(motion, places):
    expected = cv2.perspectiveTransform(places.numpy()[None], motion.matrix)[0]
    np.testing.assert_allclose(motion.points(places).numpy(), expected, rtol=1e-9, atol=1e-9)


@given(motions, motions, points)
def test_motions_compose_and_invert(first, second, places):
    both = first.then(second)
    torch.testing.assert_close(both.points(places), second.points(first.points(places)), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(first.inverse().points(first.points(places)), places, rtol=1e-6, atol=1e-6)
    assert first.then(first.inverse()).is_still


@given(motions, points)
def test_scale_is_that_of_a_small_triangle(motion, places):
    step = 1e-3
    right, below = places + torch.tensor([step, 0.0]), places + torch.tensor([0.0, step])
    u, v = (motion.points(each) - motion.points(places) for each in (right, below))
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).abs() / step**2
    torch.testing.assert_close(motion.scale_at(places), area.sqrt(), rtol=1e-4, atol=1e-6)


def test_boxes_move_with_their_centres_and_keep_their_precision():
    motion = Motion.similarity(shift=(5, -3), scale=2)
    boxes = torch.tensor([[[0.0, 0.0, 10.0, 4.0]]])
    assert motion.boxes(boxes).tolist() == [[[5.0, -3.0, 25.0, 5.0]]]
    turned = Motion.similarity(turn=90).boxes(torch.tensor([[8.0, -1.0, 12.0, 1.0]]))
    torch.testing.assert_close(turned, torch.tensor([[-2.0, 9.0, 2.0, 11.0]]))
    assert motion.boxes(boxes).dtype == torch.float32


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_boxes_are_moved_and_told_to_be_ahead_as_their_centres_are(dtype):
    quarter = Motion(np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.1]]))  # to the right
    boxes = torch.tensor([[2.0, 0.0, 4.0, 2.0], [-4.0, 0.0, -2.0, 2.0]], dtype=dtype)
    moved, are_ahead = quarter.boxes_ahead(boxes)
    assert are_ahead.tolist() == quarter.is_ahead((boxes[:, :2] + boxes[:, 2:]) / 2).tolist() == [True, False]
    centre = quarter.points(torch.tensor([[3.0, 1.0]], dtype=dtype))[0]
    torch.testing.assert_close((moved[0, :2] + moved[0, 2:]) / 2, centre)
    assert moved.dtype == dtype
    assert torch.equal(moved, quarter.boxes(boxes))


def test_matrices_of_opencv_are_taken_and_others_refused():
    similarity = cv2.getRotationMatrix2D((10.0, 20.0), 30, 1.5)
    place = torch.tensor([[10.0, 20.0]])
    torch.testing.assert_close(Motion.of(similarity).points(place), place)
    motion = Motion.still()
    assert Motion.of(motion) is motion
    for matrix in (np.zeros((3, 3)), np.full((3, 3), np.nan), np.eye(4), np.diag([1.0, 1.0, 0.0])):
        with pytest.raises(InputError, match="motion: expected a 3 × 3 matrix"):
            Motion.of(matrix)


@given(motions, st.sampled_from([1e-6, 1e-3, -1.0, 1e4]), points)
def test_a_matrix_times_a_number_is_the_same_map(motion, factor, places):
    torch.testing.assert_close(Motion.of(motion.matrix * factor).points(places), motion.points(places))


def test_poses_of_a_head_that_turns_around_are_taken():
    lens = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    camera = KnownPoses()
    for pan in range(0, 361):
        turn = cv2.Rodrigues(np.array([0, np.radians(pan), 0]))[0]
        step = camera.step(lens @ turn @ np.linalg.inv(lens))
        if step.motion is not None:
            centre = step.motion.points(torch.tensor([320.0, 240.0], dtype=torch.float64))
            torch.testing.assert_close(centre, torch.tensor([320 + 600 * np.tan(np.radians(1)), 240]))


@given(st.floats(-170, 170), st.floats(-60, 60))
def test_what_is_behind_a_camera_that_turns_has_no_place_in_its_frame(pan, tilt):
    """K R K⁻¹ of a camera of 640 × 480 px; the truth is the depth of a ray after the rotation."""
    lens = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    turn = cv2.Rodrigues(np.array([0, np.radians(pan), 0]))[0] @ cv2.Rodrigues(np.array([np.radians(tilt), 0, 0]))[0]
    matrix = lens @ turn @ np.linalg.inv(lens)
    places = np.array([[10.0, 20.0], [320.0, 240.0], [600.0, 400.0], [30.0, 470.0]])
    depth = np.linalg.solve(lens, np.c_[places, np.ones(4)].T).T @ turn.T
    clear = np.abs(depth[:, 2]) > 0.05
    if abs(matrix[2, 2]) < 0.01:
        return
    motion = Motion(matrix)
    ahead = motion.is_ahead(torch.from_numpy(places)).numpy()
    np.testing.assert_array_equal(ahead[clear], depth[clear, 2] > 0)
    boxes = motion.boxes(torch.from_numpy(np.c_[places - 2, places + 2]))
    hidden = boxes[torch.from_numpy(clear & (depth[:, 2] <= 0))]
    assert bool((hidden < -1e5).all())


def test_points_on_the_horizon_lie_infinitely_far_without_a_warning():
    """The camera turns so far that the column x = 128 maps to infinity; a box there is behind the camera's plane."""
    motion = Motion([[1, 0, 0], [0, 1, 0], [-1 / 128, 0, 1]])
    assert motion.points(torch.tensor([[128.0, 5.0]])).isinf().all()
    assert motion.scale_at(torch.tensor([[128.0, 5.0]])).isinf().all()
    box = motion.boxes(torch.tensor([[120.0, 10.0, 136.0, 30.0]]))
    assert not motion.shows(torch.tensor([[120.0, 10.0, 136.0, 30.0]])).any()
    assert (box < 0).all()
    # Nested calls, and calls from threads, restore what was set before.
    assert np.geterr()["divide"] == "warn"

"""The film of a flight: poses that close, and what is drawn of the frame, its window and the objects."""

import numpy as np
import pytest
import torch
from PIL import Image

from eval import readme_picture
from eval.flight_film import FilmFrame, flight_frames, fly, round_trip, table_of_photographs
from semfov import ActivePerception
from semfov.motion import Motion

GREEN, DARK_GREEN, AMBER = (0, 220, 160), (0, 150, 115), (255, 191, 0)


def film_frame(left, top, boxes=(), in_view=()):
    """What is known at an upright frame of 60 × 40 px, whose window is its right half."""
    corner = np.array([left, top])
    frame = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0]]) + corner
    window = np.array([[30.0, 0.0], [60.0, 0.0], [60.0, 40.0], [30.0, 40.0]]) + corner
    numbers = list(range(1, len(boxes) + 1))
    boxes = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    return FilmFrame(frame, window, boxes, numbers, torch.tensor(in_view, dtype=torch.bool))


def test_a_round_trip_has_its_points_in_the_middle_and_ends_a_step_before_its_beginning():
    points = [(100.0, 100.0), (200.0, 100.0), (200.0, 200.0), (100.0, 200.0)]
    poses = round_trip(points, (60, 40), 40, turn=5.0)
    middles = [pose.inverse().points(torch.tensor([30.0, 20.0], dtype=torch.float64)).tolist() for pose in poses]
    assert np.allclose([middles[number] for number in (0, 10, 20, 30)], points)
    assert np.allclose(middles[-1], (100.0, 110.0))
    assert np.allclose(poses[0].matrix, Motion.similarity(shift=(-70, -80)).matrix)
    turns = [np.degrees(np.arctan2(pose.matrix[1, 0], pose.matrix[0, 0])) for pose in poses]
    assert max(turns) == pytest.approx(5.0)
    assert min(turns) == pytest.approx(-5.0)


def test_a_film_is_bright_in_the_frame_dim_where_it_was_and_dark_elsewhere():
    picture = np.full((120, 200, 3), 200, np.uint8)
    first, second = (
        np.asarray(frame) for frame in flight_frames(picture, [film_frame(10, 10), film_frame(110, 60)], "cups", 200)
    )
    assert (first[30, 20] == 200).all()
    assert (second[30, 20] == 80).all()  # .4 of it
    assert (second[80, 120] == 200).all()
    assert (second[80, 20] == 24).all()  # .12 of it
    assert tuple(second[80, 140]) == AMBER


def test_objects_are_drawn_where_they_are_brighter_in_view():
    boxes = ((20.0, 30.0, 28.0, 44.0), (120.0, 60.0, 128.0, 90.0))
    (film,) = flight_frames(np.zeros((120, 200, 3), np.uint8), [film_frame(10, 10, boxes, (True, False))], "cups", 400)
    frame = np.asarray(film)
    assert tuple(frame[70, 40]) == GREEN
    assert tuple(frame[150, 240]) == DARK_GREEN
    # Only what is in view has its number above the box.
    assert (frame[46:59, 38:52] > 128).any()
    assert not frame[100:119, 230:260].any()
    assert frame.shape[0] > 240  # a line with the counts is below the picture


def test_the_agent_sees_frames_alone_and_objects_come_in_pixels_of_the_picture():
    picture = table_of_photographs()
    poses = round_trip([(360, 290), (420, 290)], (320, 240), 3, turn=2.0)
    film_frames = [*fly(ActivePerception.recommended(), picture, poses, (320, 240), "person")]
    assert len(film_frames) == 3
    assert np.allclose(film_frames[0].frame, [[200, 170], [520, 170], [520, 410], [200, 410]])
    for view in film_frames:
        assert view.boxes.shape == (len(view.numbers), 4)
        assert view.in_view.shape == (len(view.numbers),)


def test_the_command_writes_a_film(tmp_path, monkeypatch):
    monkeypatch.setattr(readme_picture, "_FLIGHT_FRAMES", 3)
    path = tmp_path / "film.webp"
    assert readme_picture.main(["--flight", "--out", str(path)]) == 0
    with Image.open(path) as film:
        assert film.n_frames == 3
        assert film.size[0] == 640

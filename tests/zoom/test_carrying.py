"""Looks that move along with the camera: what they showed is where the scene is now."""

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from semfov import Detections, Detector, InputError, WindowEye, ZoomAgent
from semfov.detection.scores import Candidates
from semfov.motion import Motion
from semfov.observation.matching import box_iou, inside_frame
from semfov.settings import StreamSettings
from semfov.zoom.carrying import carried, share_shown
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook
from tests.motion.test_camera import scene

LATTICE = Lattice.over((1024, 768), (128, 128))
RED = 1


def look_at(action, boxes=((300.0, 200.0, 340.0, 260.0),)):
    """A look with random hints."""
    window, span = Window.on(LATTICE, action), LATTICE.span(action[0])
    columns, rows = min(span, LATTICE.columns - action[1]), min(span, LATTICE.rows - action[2])
    hints = torch.rand(rows, columns, 3, generator=torch.Generator().manual_seed(0))
    gist = Gist(action[0], action[1:], 1, hints, hints[..., 0] * 5, hints > 0.5)
    count = len(boxes)
    places = torch.tensor(boxes).reshape(1, -1, 4)
    detections = Detections(places, torch.full((1, count, 4), 0.25), torch.ones(1, count).bool())
    return WindowLook(window, detections, torch.zeros(count).bool(), torch.ones(3), gist)


def moved_by(motion, look, lattice):
    """The look after a motion; that of another look beside it changes nothing."""
    alone = carried([look], [motion], lattice)
    others = [look_at((2, 4, 4), ()), look_at((1, 2, 2), [(1.0, 2.0, 3.0, 4.0)] * 3)]
    far = Motion.similarity(shift=(7, -9), turn=5, scale=1.1)
    beside = carried([others[0], look, others[1]], [far, motion, far.inverse()], lattice)
    assert beside[1].window == alone[0].window
    torch.testing.assert_close(beside[1].detections.boxes, alone[0].detections.boxes)
    return alone[0]


def test_a_shift_by_whole_cells_shifts_the_hints():
    wide, high = LATTICE.pitch
    look = look_at((1, 8, 4))
    moved = moved_by(Motion.similarity(shift=(3 * wide, -2 * high)), look, LATTICE)
    assert moved.gist.first == (11, 2)
    rows, columns = moved.gist.scores.shape[:2]
    assert torch.equal(moved.gist.scores, look.gist.scores[:rows, :columns])
    assert torch.equal(moved.gist.found, look.gist.found[:rows, :columns])
    expected = look.detections.boxes + torch.tensor([3 * wide, -2 * high] * 2)
    torch.testing.assert_close(moved.detections.boxes, expected)
    assert moved.window.cells == tuple(cell + by for cell, by in zip(look.window.cells, (3, -2, 3, -2), strict=True))


def test_hints_of_the_whole_fill_the_frame_with_those_of_the_border():
    look = look_at((0, 0, 0))
    moved = moved_by(Motion.similarity(shift=(5 * LATTICE.pitch[0], 0)), look, LATTICE)
    assert moved.gist.scores.shape == look.gist.scores.shape
    assert torch.equal(moved.gist.scores[:, 5:], look.gist.scores[:, :-5])
    assert torch.equal(moved.gist.scores[:, :5], look.gist.scores[:, :1].expand(-1, 5, -1))


def test_a_turn_by_a_right_angle_turns_the_hints():
    square = Lattice.over((1024, 1024), (128, 128))
    hints = torch.rand(square.rows, square.columns, 3, generator=torch.Generator().manual_seed(0))
    look = replace(look_at((0, 0, 0)), gist=Gist(0, (0, 0), 1, hints, hints[..., 0], hints > 0.5))
    middle = square.size[0] / 2
    about = Motion.similarity(shift=(-middle, -middle)).then(Motion.similarity(turn=90))
    moved = moved_by(about.then(Motion.similarity(shift=(middle, middle))), look, square)
    assert torch.equal(moved.gist.scores, hints.rot90(-1, (0, 1)))


def test_magnification_falls_as_the_picture_grows():
    look = look_at((2, 4, 4))
    moved = moved_by(Motion.similarity(scale=2.0), look, LATTICE)
    assert moved.window.fixation[2] == pytest.approx(look.window.fixation[2] / 2)
    torch.testing.assert_close(moved.detections.boxes, look.detections.boxes + torch.tensor([300.0, 200, 340, 260]))


def test_a_look_that_has_left_the_frame_has_no_hints():
    moved = moved_by(Motion.similarity(shift=(5000, 0)), look_at((1, 0, 0)), LATTICE)
    assert moved.gist is None
    assert share_shown(moved.window, LATTICE) == 0
    assert not inside_frame(moved.detections.boxes, LATTICE.size).any()


def test_shares_of_the_frame():
    whole = Window.overview(LATTICE)
    assert share_shown(whole, LATTICE) == 1
    half = moved_by(Motion.similarity(shift=(512, 0)), look_at((0, 0, 0)), LATTICE).window
    assert share_shown(half, LATTICE) == pytest.approx(0.5)


class Patches(Detector):
    """A box around every patch of pure red, as closely as the canvas shows it."""

    def __init__(self):
        super().__init__("patches", ("red", "other"), (256, 256))

    def propose(self, canvas):
        red = ((canvas[0, 0] > 0.75) & (canvas[0, 1:].amax(0) < 0.3)).numpy().astype(np.uint8)
        _, _, patches, _ = cv2.connectedComponentsWithStats(red)
        low = torch.from_numpy(patches[1:, :2]).float()
        boxes = torch.cat([low, low + torch.from_numpy(patches[1:, 2:4])], 1)[None]
        sure = torch.tensor([0.9, 0.05]).expand(1, boxes.shape[1], 2)
        return Candidates(boxes, sure)


def flight(count, speed):
    """Frames of 1024 × 768 px over a ground with eight red squares, and the squares in each, `(N, 4)`."""
    ground = scene(2, side=1600) // 2 + 40
    places = np.random.default_rng(4).integers(100, 1450, (24, 2))
    for x, y in places:
        cv2.rectangle(ground, (int(x), int(y)), (int(x) + 31, int(y) + 31), (255, 0, 0), -1)
    for number in range(count):
        left, top = 60 + speed * number, 300 - speed * number // 3
        low = torch.from_numpy(places - (left, top)).float()
        boxes = torch.cat([low, low + 32], 1)
        whole = ((boxes[:, :2] > 40) & (boxes[:, 2:] < torch.tensor([980.0, 720.0]))).all(-1)
        yield ground[top : top + 768, left : left + 1024].copy(), boxes[whole]


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0, 6, 16])
def test_objects_stay_at_their_places_while_the_camera_moves(speed):
    """After thirty frames, one look each, nearly all squares are known, and few boxes are elsewhere."""
    agent = ZoomAgent(WindowEye(Patches())).eval()
    episode = agent.stream(None, (RED,), StreamSettings(rate=0.25))
    *_, (moment, boxes) = ((episode.step(frame), boxes) for frame, boxes in flight(30, speed))
    overlap = box_iou(boxes, moment.objects.boxes) >= 0.5
    assert overlap.any(1).float().mean() >= 0.85
    inside = ((moment.objects.boxes[:, :2] > 40) & (moment.objects.boxes[:, 2:] < torch.tensor([980.0, 720.0]))).all(-1)
    assert overlap[:, inside].any(0).float().mean() >= 0.85


@pytest.mark.slow
def test_a_cut_ends_what_was_known():
    """Three frames after a cut nothing of the old scene is listed."""
    agent = ZoomAgent(WindowEye(Patches())).eval()
    episode = agent.stream(None, (RED,), StreamSettings(rate=0.25))
    for frame, _ in flight(15, 4):
        moment = episode.step(frame)
    assert len(moment.objects)
    empty = scene(11, side=1100)[:768, :1024] // 2 + 40
    for number in range(3):
        moment = episode.step(np.roll(empty, 4 * number, 1))
    assert len(moment.objects) == 0


@pytest.mark.slow
def test_known_poses_take_the_place_of_the_estimate():
    """A camera that turns about itself over a ground without any texture, where nothing can be followed."""
    agent = ZoomAgent(WindowEye(Patches())).eval()
    episode = agent.stream(None, (RED,), StreamSettings(rate=0.25))
    for number in range(12):
        frame = np.full((768, 1024, 3), 90, np.uint8)
        x, y = 300 + 10 * number, 500 - 7 * number
        cv2.rectangle(frame, (x, y), (x + 39, y + 39), (255, 0, 0), -1)
        moment = episode.step(frame, pose=[[1, 0, 10 * number], [0, 1, -7 * number]])
    assert not moment.lost
    assert len(moment.objects) == 1
    assert float(box_iou(moment.objects.boxes, torch.tensor([[x, y, x + 40.0, y + 40.0]]))) > 0.7


def test_without_opencv_only_a_camera_whose_poses_are_unknown_is_warned_of(monkeypatch):
    """Warnings are errors here: with poses there is none."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    agent = ZoomAgent(WindowEye(Patches())).eval()
    frame = np.full((768, 1024, 3), 90, np.uint8)
    agent.stream(None, (RED,), StreamSettings(rate=0.25)).step(frame, pose=np.eye(3))
    with pytest.warns(UserWarning, match="taken to stand still, unless poses are given"):
        agent.stream(None, (RED,), StreamSettings(rate=0.25)).step(frame)


def test_poses_are_given_for_all_frames_or_none():
    agent = ZoomAgent(WindowEye(Patches())).eval()
    frame = np.full((768, 1024, 3), 90, np.uint8)
    episode = agent.stream(None, (RED,), StreamSettings(rate=0.25))
    episode.step(frame, pose=np.eye(3))
    with pytest.raises(InputError, match="pose: expected a pose of each frame, or of none"):
        episode.step(frame)
